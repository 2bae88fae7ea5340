"""What every registered reconstructor promises, for a projector and for a plain matrix."""

import inspect

import pytest
import torch
import yaml

from mvrecon.config import conf_dir
from mvrecon.parts import RECONSTRUCTORS
from tests.reconstruct.methods import NAMES, PROMISES, Dense, gap, projector, run, truth

OPERATORS = {"projector": projector, "matrix": Dense}
LINEAR = [name for name in NAMES if PROMISES[name].linear is not None]
#: Those that never increase the residual, weighted by R or not.
MONOTONE = {
    "sirt": {"momentum": False, "nonnegative": False},
    "cgls": {},
    "tikhonov": {"weight": 0.0},
}


@pytest.fixture(params=OPERATORS)
def A(request):
    return OPERATORS[request.param]()


def test_every_method_has_promises():
    assert set(NAMES) == set(PROMISES)


@pytest.mark.parametrize("name", NAMES)
def test_consistent_views_are_explained(name, A):
    y = A(truth(A))
    assert (y - A(run(name, A, y))).norm() < PROMISES[name].rate * y.norm()


@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_method_is_linear(name, A):
    torch.manual_seed(0)
    options = {"iterations": 5, **(PROMISES[name].linear or {})}
    one, other = A(truth(A)), torch.randn(1, 1, *A.range_shape, dtype=torch.float64)
    if name in ("cgls", "tikhonov"):  # a Krylov space depends on the views until it is exhausted
        options["iterations"] = 400
    whole = run(name, A, 2 * one - other, **options)
    parts = 2 * run(name, A, one, **options) - run(name, A, other, **options)
    assert gap(A(whole), A(parts)) < 1e-8


@pytest.mark.parametrize("name", NAMES)
def test_a_multiple_of_the_views_gives_that_multiple_of_the_volume(name, A):
    y = A(truth(A))
    weighted = {"weight": 1e-3} if PROMISES[name].penalised else {}
    scaled = {"weight": 0.02 * 1e-3} if PROMISES[name].penalised else {}
    one = run(name, A, y, iterations=5, **weighted)
    assert gap(run(name, A, 0.02 * y, iterations=5, **scaled), 0.02 * one) < 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_is_its_cases(name, A):
    x = truth(A, batch=3)
    x[1] *= 1e3
    x[2] = 0
    x[2, ..., 2, 2] = 1
    y = A(x)
    whole = run(name, A, y, iterations=6)
    for n in range(3):
        assert gap(whole[n], run(name, A, y[n : n + 1], iterations=6)[0]) < 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_outside_its_support_a_volume_is_zero_and_inside_it_explains_the_views(name, A):
    support = torch.zeros(A.domain_shape, dtype=torch.bool)
    support[1:4, 1:4, 2:5] = True
    y = A(truth(A) * support)
    x = run(name, A, y, support=support)
    assert not x[..., ~support].any() and x[..., support].any()
    assert (y - A(x)).norm() < PROMISES[name].rate * y.norm()


@pytest.mark.parametrize("name", NAMES)
def test_a_start_that_is_the_solution_stays(name, A):
    x = truth(A)
    weightless = {"weight": 0.0} if "weight" in PROMISES[name].options else {}
    assert gap(run(name, A, A(x), iterations=4, start=x, **weightless), x) < 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_it_goes_on_from_a_start(name, A):
    y = A(truth(A))
    start = run(name, A, y)
    assert (y - A(run(name, A, y, iterations=2, start=start))).norm() < 1.01 * (y - A(start)).norm()


@pytest.mark.parametrize("name", NAMES)
def test_a_monitor_sees_every_iterate_with_its_residual_and_ends_the_run(name, A):
    y = A(truth(A)) + 0.1
    seen = []

    def monitor(iterate):
        seen.append(iterate.number)
        assert gap(iterate.residual + A(iterate.volume), y) < 1e-12
        return iterate.number == 4

    x = run(name, A, y, iterations=9, monitor=monitor)
    assert seen == [1, 2, 3, 4] and torch.equal(x, run(name, A, y, iterations=4))
    seen.clear()
    run(name, A, y, iterations=3, monitor=monitor)
    assert seen == [1, 2, 3]


@pytest.mark.parametrize("name", MONOTONE)
def test_the_residual_never_increases(name, A):
    torch.manual_seed(0)
    y = A(truth(A)) + torch.randn(1, 1, *A.range_shape, dtype=torch.float64)
    weights = 1 if name == "cgls" else 1 / A(torch.ones_like(truth(A))).clamp_min(1e-12)
    sizes = []

    def monitor(iterate):
        sizes.append((weights * iterate.residual.square()).sum().item())

    run(name, A, y, **{"iterations": 15, **MONOTONE[name]}, monitor=monitor)
    assert all(later <= earlier for earlier, later in zip(sizes, sizes[1:], strict=False))
    assert sizes[-1] < sizes[0]


@pytest.mark.door
@pytest.mark.parametrize("name", NAMES)
def test_views_or_a_start_that_do_not_fit_are_refused(name):
    """A reconstructor refuses views with NaN or of another shape, a start or a support of another
    shape, and an option that it does not have.
    """
    A = Dense()
    y = A(truth(A))
    bad = y.clone()
    bad[0, 0, 1, 2, 3] = torch.nan
    for views, options in (
        (bad, {}),
        (y[..., 1:], {}),
        (y[:, :, 1:], {}),
        (y, {"start": truth(A)[..., 1:]}),
        (y, {"start": truth(A) * torch.nan}),
        (y, {"support": torch.ones(5, 5, 6, dtype=torch.bool)}),
        (y, {"support": torch.ones(4, 5, 6)}),
    ):
        with pytest.raises(ValueError, match="[Ee]xpected|must be finite"):
            run(name, A, views, **options)
    with pytest.raises(TypeError, match="no option 'suport'.*did you mean 'support'"):
        run(name, A, y, suport=None)


@pytest.mark.parametrize("name", sorted({*NAMES} - {"sirt", "tikhonov"}))
def test_a_gradient_that_would_silently_be_zero_is_refused(name):
    """With views that require a gradient, methods without one say so, and are silent where none is
    recorded.
    """
    A = Dense()
    views = A(truth(A)).requires_grad_()
    with pytest.raises(ValueError, match=f"without gradient for {name}"):
        run(name, A, views, iterations=2)
    with torch.no_grad():
        assert torch.equal(
            run(name, A, views, iterations=2), run(name, A, views.detach(), iterations=2)
        )


@pytest.mark.parametrize("penalty", ["gradient", "identity"])
def test_the_gradient_of_tikhonov_is_that_of_its_minimum(penalty, A):
    """It is linear: a change of the views times the gradient is the change of the functional."""
    torch.manual_seed(0)
    views = A(truth(A, batch=2)).requires_grad_()
    support = torch.ones(A.domain_shape, dtype=torch.bool)
    support[:2, :2] = False
    options = {"iterations": 300, "weight": 0.3, "penalty": penalty, "support": support}
    slope = torch.randn(2, 1, *A.domain_shape, dtype=torch.float64)
    x = run("tikhonov", A, views, **options)
    (gradient,) = torch.autograd.grad((slope * x).sum(), views)
    change = torch.randn_like(views)
    after = run("tikhonov", A, views.detach() + change, **options)
    expected = (slope * (after - x)).sum()
    assert ((gradient * change).sum() - expected).abs() < 1e-8 * expected.abs()
    with pytest.raises(ValueError, match="weight above 0"):
        run("tikhonov", A, views, weight=0.0)


@pytest.mark.parametrize("name", NAMES)
def test_the_precision_of_the_views_is_kept(name, A):
    y = A(truth(A))
    exact, short = run(name, A, y, iterations=3), run(name, A, y.float(), iterations=3)
    assert exact.dtype == torch.float64 and short.dtype == torch.float32
    assert 1e-12 < gap(short, exact) < 1e-3


@pytest.mark.parametrize("name", NAMES)
def test_the_file_of_a_method_gives_its_defaults(name):
    settings = yaml.safe_load((conf_dir() / "reconstructor" / f"{name}.yaml").read_text())
    parameters = inspect.signature(RECONSTRUCTORS.get(name)).parameters.values()
    options = {p.name: p.default for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD}
    options = {option: value for option, value in list(options.items())[2:] if option != "weights"}
    assert settings == {"name": name, **options}
