"""Group normalisation and SiLU of CUDA devices, compiled by g++ and run in main memory, against
torch's own.
"""

from types import SimpleNamespace

import pytest
import torch

from mvrecon.kernels import self_test
from mvrecon.kernels.norms import cuda, ops, reference, trial
from mvrecon.kernels.operator import choose_backend
from tests.kernels.cuda.scenes import difference
from tests.kernels.cuda.waits import Waits

#: Items, channels and places: of more blocks than one, of two axes, of groups of one value.
SHAPES = [(2, 12, 7, 6, 9), (3, 8, 5, 31), (1, 4, 1, 1), (2, 16, 30, 31)]
PRECISIONS = [(torch.float64, 1e-11), (torch.float32, 3e-6)]
HALVES = [(torch.float16, 3e-6), (torch.bfloat16, 3e-6)]
EPS, GROUPS = 1e-5, 4


def scene(shape, dtype: torch.dtype, mean: float = 0.5):
    """Features with channels last in memory, a layer's scale and shift, a change of the answer."""
    torch.manual_seed(0)
    x = (mean + torch.randn(shape)).to(dtype)
    layer = torch.randn(2, shape[1], dtype=torch.float64).to(reference.wide(x).dtype)
    return reference.channels_last(x), layer, torch.randn(shape).to(layer)


def answers(module, x, layer, y) -> dict[str, torch.Tensor]:
    """The answer, and its derivatives by the features and by the layer."""
    answer, sums = module.normalised(x, *layer, GROUPS, EPS)
    change, back = module.change(x, y, *layer, sums, GROUPS, EPS)
    return {"answer": answer, "by x": change, "by the layer": back.sum(dim=0).flip(0)}


def torch_s(x, layer, y) -> dict[str, torch.Tensor]:
    """The same by torch's own operations in float64."""
    x, layer = (one.double().clone().requires_grad_() for one in (x, layer))
    answer = reference.plain(x, *layer, GROUPS, EPS)
    by_x, by_layer = torch.autograd.grad((answer * y.double()).sum(), (x, layer))
    return {"answer": answer.detach(), "by x": by_x, "by the layer": by_layer}


@pytest.mark.parametrize("shape", SHAPES[:2] + SHAPES[3:], ids=str)
@pytest.mark.parametrize(("dtype", "bound"), PRECISIONS + HALVES)
@pytest.mark.parametrize("module", [cuda, reference], ids=["kernels", "reference"])
def test_values_and_derivatives_are_those_of_torch(module, shape, dtype, bound, host):
    """In half precision of what is stored, arithmetic in float32."""
    x, layer, y = scene(shape, dtype)
    expected = torch_s(x, layer, y)
    got = answers(module, x, layer, y)
    errors = {name: difference(got[name], expected[name]) for name in expected}
    assert max(errors.values()) < bound, errors


@pytest.mark.parametrize("module", [cuda, reference], ids=["kernels", "reference"])
def test_a_group_of_one_value_keeps_the_shift_alone(module, host):
    x, layer, y = scene((1, 4, 1, 1), torch.float64)
    got = answers(module, x, layer, y)
    silu = torch.nn.functional.silu(layer[1])
    torch.testing.assert_close(got["answer"].flatten(), silu)
    assert not got["by x"].any()


def test_a_great_mean_costs_no_digits(host):
    """Features of 1000 +- 1, of which float32 holds the spread to 6e-5."""
    x, layer, y = scene((2, 8, 9, 40, 11), torch.float32, mean=1000.0)
    x[:, :, 0, 0] = 0.0  # a thread's first value is no mean
    got, expected = answers(cuda, x, layer, y), torch_s(x, layer, y)
    for name in expected:
        assert difference(got[name], expected[name]) < 3e-5, name


def test_a_long_item_is_summed_by_many_threads_and_the_same_in_every_run(host, monkeypatch):
    x, layer, y = scene((1, 8, 40, 200), torch.float32)
    first, again = (answers(cuda, x, layer, y) for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    rows = cuda.layer_of(cuda.rows_of(x), GROUPS, EPS).rows
    assert rows == 500
    monkeypatch.setattr(cuda, "THREADS", 64)
    few = answers(cuda, x, layer, y)
    assert cuda.layer_of(cuda.rows_of(x), GROUPS, EPS).rows == 8
    for name in first:
        assert difference(few[name], first[name]) < 3e-6


def test_an_item_that_is_not_finite_spoils_its_group_alone(host):
    x, layer, y = scene(SHAPES[0], torch.float32)
    x[1, 4, 2, 2, 2] = float("inf")
    got = answers(cuda, x, layer, y)["answer"]
    spoilt = got.isnan().flatten(2).all(dim=2)
    assert spoilt[1, 3:6].all() and spoilt.sum() == 3 and got[0].isfinite().all()


def test_nothing_gives_nothing(host):
    for shape in ((0, 8, 3, 3), (2, 8, 0, 3)):
        got = answers(cuda, *scene(shape, torch.float32))
        assert got["answer"].shape == got["by x"].shape == shape
        assert not got["by the layer"].any()


def test_two_kernels_forwards_and_two_backwards_with_channels_last_and_no_wait(host):
    x, layer, y = scene(SHAPES[0], torch.bfloat16)
    y = reference.channels_last(y)
    with Waits() as waits:
        got = answers(cuda, x, layer, y)
    assert waits.names == [] and set(host.streams) == {7} and host.modules == 1
    assert host.launches == ["sum_features", "normalise", "sum_changes", "change_features"]
    order = torch.channels_last_3d
    assert all(got[name].is_contiguous(memory_format=order) for name in ("answer", "by x"))


def test_the_operator_has_two_derivatives_and_is_opaque_to_the_compiler():
    """The second one is torch's."""
    x, layer, _ = scene((2, 8, 3, 4), torch.float64)
    inputs = (x.requires_grad_(), *layer.requires_grad_())

    def act(x, scale, shift):
        return ops.normalised_silu(x, scale, shift, GROUPS, EPS)

    assert torch.autograd.gradcheck(act, inputs)
    assert torch.autograd.gradgradcheck(act, inputs)
    torch.library.opcheck(ops._normalised, (*inputs, GROUPS, EPS))
    compiled = torch.compile(act, backend="aot_eager", fullgraph=True)
    gradients = [
        torch.autograd.grad(one(*inputs).square().sum(), inputs) for one in (act, compiled)
    ]
    for one, two in zip(*gradients, strict=True):
        torch.testing.assert_close(one, two)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.float16])
def test_it_checks_itself(dtype, host, monkeypatch):
    """A wrong derivative is not used, and the reason tells which."""
    assert self_test.failure("cpu", "norm", dtype, trial.differences) is None
    self_test.forget()
    right = cuda.change
    monkeypatch.setattr(cuda, "change", lambda *all: [1.001 * one for one in right(*all)])
    why = self_test.failure("cpu", "norm", dtype, trial.differences)
    assert "its derivative differs from the reference by 1.0e-03" in str(why)


def test_without_kernels_torch_normalises(host):
    """Where the kernels cannot be started, `auto` takes torch's normalisation."""
    x = SimpleNamespace(device=torch.device("cuda:0"), shape=(1, 8, 4, 4), dtype=torch.float32)
    host.failure["cuLaunchKernel"] = 222
    assert choose_backend(x, "auto", "norm", trial.differences) == "reference"
