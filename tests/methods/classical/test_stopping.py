"""When to stop: noise, the L-curve, and views that were left out."""

import pytest
import torch

from mvrecon.methods.classical.least_squares import cgls, tikhonov
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.classical.stopping import Curve, combined, corner, discrepancy, held_out
from tests.methods.classical.methods import NAMES, gap, run, tabulated, truth
from tests.methods.classical.test_total_variation import slice_operator


@pytest.fixture
def noisy():
    """A smooth volume, an operator, its views with noise, and the noise's sigma."""
    torch.manual_seed(0)
    A = slice_operator(16)
    axis = torch.linspace(-1, 1, 24, dtype=torch.float64)
    x = torch.exp(-4 * (axis[:, None].square() + axis.square()))[None, None, None]
    y = A(x)
    sigma = 0.03 * y.max()
    return x, A, y + sigma * torch.randn_like(y), sigma.item()


def chi(A, x, y, sigma):
    return ((y - A(x)) / sigma).square().mean()


def test_a_run_stops_when_the_noise_explains_the_residual(noisy):
    _, A, y, sigma = noisy
    curve = Curve()
    x = cgls(A, y, 50, monitor=combined(curve, discrepancy(sigma)))
    n = len(curve.residuals)
    assert 1 < n < 50 and chi(A, x, y, sigma) <= 1 < chi(A, cgls(A, y, n - 1), y, sigma)
    views = torch.full_like(y, sigma)
    views[:, :, ::2] = torch.inf
    some = cgls(A, y, 50, monitor=discrepancy(views))
    assert chi(A, some, y, sigma) < 10 and ((y - A(some)) / views).square().mean() <= 0.5


def test_a_curve_records_residual_and_norm(noisy):
    _, A, y, _ = noisy
    curve = Curve()
    x = sirt(A, y, 5, monitor=curve)
    assert len(curve.residuals) == len(curve.norms) == 5
    assert curve.norms[-1] == x.norm().item()
    assert abs(curve.residuals[-1] - (y - A(x)).norm().item()) < 1e-9


@pytest.mark.parametrize("turn", [1, -1])
def test_the_corner_of_an_l_curve_is_found(turn):
    residuals = [100.0, 30.0, 10.0, 3.0, 1.0, 0.97, 0.95, 0.93]
    norms = [1.0, 1.05, 1.1, 1.2, 1.4, 4.0, 12.0, 40.0]
    point = corner(residuals[::turn], norms[::turn])
    assert residuals[::turn][point] == 1.0


def test_held_out_views_choose_a_better_iteration_than_the_last(noisy):
    truth, A, y, _ = noisy
    choice = held_out(cgls, A, y, options={"iterations": 40}, patience=8)
    assert 1 <= choice.iterations[0] < 40 and choice.weights is None
    assert torch.equal(choice.volume, cgls(A, y, choice.iterations[0]))
    assert gap(choice.volume, truth) < 0.7 * gap(cgls(A, y, 40), truth)


def test_held_out_views_choose_a_weight(noisy):
    truth, A, y, _ = noisy
    weights = [1e-2, 0.3, 3.0]
    options = {"iterations": 30}
    choice = held_out(tikhonov, A, y, weights, options=options, every=4)
    errors = [gap(tikhonov(A, y, 30, weight), truth) for weight in weights]
    assert choice.weights == [weights[errors.index(min(errors))]] == [0.3]
    assert [t.weight for t in choice.trials] == weights
    assert gap(choice.volume, truth) <= 1.2 * min(errors)


@pytest.mark.parametrize("name", NAMES)
def test_noise_stops_each_sample_of_a_batch_as_if_alone(name):
    A, x = tabulated(), truth(tabulated(), batch=3)
    x[0], x[1] = 0.1 * x[0], 1
    views = A(x)
    options = {"iterations": 30, "monitor": discrepancy(0.02 * views.max().item())}
    alone = [run(name, A, y[None], **options) for y in views]
    whole = run(name, A, views, **options)
    for n in range(3):
        assert gap(whole[n], alone[n][0]) < 1e-9
    options["monitor"] = curve = Curve()
    run(name, A, views, **options)
    steps = len(curve.residuals)
    last = run(name, A, views, iterations=steps)
    assert any(not torch.equal(x[0], end) for x, end in zip(alone, last, strict=True))


@pytest.mark.parametrize(("method", "weights"), [(cgls, None), (tikhonov, [1e-2, 0.3, 3.0])])
def test_each_sample_of_a_batch_is_stopped_as_if_alone(noisy, method, weights):
    _, A, y, sigma = noisy
    torch.manual_seed(1)
    batch = torch.cat([y, y + 4 * sigma * torch.randn_like(y)])
    seen = []
    options = {"iterations": 20, "monitor": lambda iterate: seen.append(iterate.number)}
    whole = held_out(method, A, batch, weights, patience=4, options=options)
    assert seen.count(1) >= 2 + len(whole.trials)
    choices = set()
    for n, views in enumerate(batch):
        alone = held_out(method, A, views[None], weights, patience=4, options={"iterations": 20})
        assert alone.iterations == [whole.iterations[n]]
        assert weights is None or alone.weights == [whole.weights[n]]
        assert gap(alone.volume[0], whole.volume[n]) < 1e-9
        choices.add((alone.iterations[0], str(alone.weights)))
    assert len(choices) == 2


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: discrepancy(0.0), "positive sigma, got 0"),
        (lambda: corner([1.0, 2.0], [1.0, 2.0]), "three points or more, got 2"),
        (lambda: corner([1.0, 0.0, 1.0], [1.0, 2.0, 3.0]), "above 0"),
        (lambda: held_out(cgls, slice_operator(2), torch.ones(1, 1, 2, 1, 40), every=1), "every=1"),
        (lambda: held_out(cgls, slice_operator(2), torch.ones(1, 1, 2, 1, 40), []), "a weight"),
    ],
)
def test_invalid_stopping_rules_are_refused(act, message):
    """A stopping rule refuses a sigma of zero, an L-curve without a corner, and a choice without
    views that judge or weights to compare.
    """
    with pytest.raises(ValueError, match=message):
        act()
