"""Times and memory of calls whose cost is known."""

import pytest
import torch

from mvrecon_bench.benchmarks.scaling import exponent
from mvrecon_bench.measure import interleaved, once, threads, with_memory


def test_measured_memory_includes_a_known_allocation():
    ballast = torch.ones(2**20)  # what is there before does not count

    def call():
        return torch.ones(25 * 2**20)  # 100 MB in float32

    def brief():
        return float(torch.ones(25 * 2**20).sum())

    for act in (call, brief):
        assert with_memory(act, "cpu")[1] == pytest.approx(100, abs=8)
    assert with_memory(lambda: ballast.sum(), "cpu")[1] < 8


def test_times_are_medians_of_alternate_calls():
    order, clock = [], [0.0]

    def worker(name, *seconds):
        taken = iter(seconds)

        def act():
            order.append(name)
            clock[0] += next(taken)

        return act

    calls = {0: worker("a", 0.02, 0.5, 0.01), 1: worker("b", 0.04, 0.03, 0.06)}
    timings = interleaved(calls, {0: 0.2, 1: 0.2}, 3, "cpu", lambda: clock[0])
    assert order == ["a", "b"] * 3
    assert [(key, round(timing.ms, 9), timing.calls) for key, timing in timings.items()] == [
        (0, 20, 3),
        (1, 40, 3),
    ]
    assert interleaved({0: lambda: None}, {0: 1e-6}, 5, "cpu")[0].calls == 25 - 5
    assert once(lambda: 7, "cpu")[0] == 7


def test_the_number_of_threads_is_restored():
    before = torch.get_num_threads()
    with pytest.raises(RuntimeError), threads(before + 1):
        assert torch.get_num_threads() == before + 1
        raise RuntimeError
    assert torch.get_num_threads() == before


def test_a_fit_recovers_a_known_exponent_and_its_error():
    p, error = exponent([(n, 3.0 * n**1.5) for n in (2.0, 5.0, 11.0)])
    assert p == pytest.approx(1.5) and error == pytest.approx(0, abs=1e-7)
    rng = torch.Generator().manual_seed(0)
    fits = []
    for _ in range(200):
        noise = (0.1 * torch.randn(8, generator=rng)).exp().tolist()
        fits.append(exponent([(2.0**k, 2.0**k * noise[k]) for k in range(8)]))
    p, error = torch.tensor(fits, dtype=torch.float64).T
    assert p.mean().item() == pytest.approx(1, abs=0.01)
    assert error.square().mean().sqrt().item() == pytest.approx(p.std().item(), rel=0.2)
    assert exponent([(2.0, 1.0), (2.0, 3.0)])[0] != exponent([(2.0, 1.0), (2.0, 3.0)])[0]
