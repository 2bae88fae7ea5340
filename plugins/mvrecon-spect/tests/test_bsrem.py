"""BSREM converges to the minimum found by another method; priors have hand-computed values, correct
derivatives and invariances.
"""

import math

import pytest
import torch

from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.stopping import discrepancy
from mvrecon.methods.classical.total_variation import voxel_steps
from mvrecon.testing import check_method
from mvrecon_spect.methods.bsrem import bsrem
from mvrecon_spect.methods.priors import Prior, log_cosh, prior_of, quadratic, relative_difference
from tests.methods.classical.methods import (
    Dense,
    counted,
    gap,
    projector,
    scale,
    tabulated,
    truth,
)

SHAPE, STEPS = (4, 5, 6), (2.0, 1.0, 1.0)


def prior(**options) -> Prior:
    mask = torch.ones(SHAPE, dtype=torch.bool)
    mask[0, :2] = False
    level = torch.full((1, 1, 1, 1, 1), 0.5, dtype=torch.float64)
    return prior_of(options, level, STEPS, mask)


def volume() -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    x = torch.rand(2, 1, *SHAPE, dtype=torch.float64, generator=random)
    x[..., 2:4, 2:4] = 0
    return x


def anatomy() -> torch.Tensor:
    """Two tissues, one above the other."""
    image = torch.zeros(SHAPE)
    image[:, :, 3:] = 100.0
    return image


def test_the_prior_of_two_voxels_matches_the_formula():
    """Two slices 2 mm apart in voxels of 1 mm: half the weight."""
    pair = (2.0, 1.0, 1.0), torch.ones(2, 1, 1, dtype=torch.bool)
    x = torch.tensor([1.0, 5.0], dtype=torch.float64).reshape(1, 1, 2, 1, 1)
    for potential, cost in (
        (relative_difference(3.0), 16 / (6 + 3 * 4)),
        (quadratic(2.0), 16 / 4),
        (log_cosh(2.0, 0.5), 0.25 * 2 * math.log(math.cosh(4 / (0.5 * 2)))),
    ):
        assert Prior(potential, *pair)(x).item() == pytest.approx(0.5 * cost)
    square = torch.ones(1, 2, 2, dtype=torch.bool)
    R = Prior(relative_difference(0.0), (1.0, 1.0, 1.0), square)
    x = torch.tensor([[1.0, 1.0], [1.0, 3.0]], dtype=torch.float64).reshape(1, 1, 1, 2, 2)
    assert R(x).item() == pytest.approx((2 + 2**-0.5) * 4 / 4, rel=1e-6)


KINDS = [
    {"gamma": 0.0},
    {"gamma": 2.0},
    {"gamma": 10.0},
    {"name": "quadratic"},
    {"name": "log_cosh", "delta": 0.3},
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("guided", [False, True])
def test_the_derivative_equals_that_of_autograd(kind, guided):
    R = prior(**kind, anatomy=anatomy()) if guided else prior(**kind)
    x = volume().clamp_min(1e-3).requires_grad_()
    (slope,) = torch.autograd.grad(R(x).sum(), x)
    torch.testing.assert_close(R.gradient(x.detach()), slope, rtol=1e-10, atol=1e-12)


def test_the_prior_is_homogeneous_with_zero_slope_between_zeros():
    R, x = prior(), volume()
    torch.testing.assert_close(R(7 * x), 7 * R(x))
    torch.testing.assert_close((R.gradient(x) * x).flatten(1).sum(dim=1), R(x))
    assert R.gradient(x).isfinite().all() and not R.gradient(torch.zeros_like(x)).any()
    assert not R.gradient(x)[:, :, 0, :2].any()  # outside the mask


def test_priors_with_a_level_are_jointly_homogeneous_and_agree_near_it():
    """A difference of 1 % at the level costs the same by all three, in any unit."""
    pair = (1.0, 1.0, 1.0), torch.ones(1, 1, 2, dtype=torch.bool)
    for level in (1e-3, 40.0):
        x = level * torch.tensor([0.995, 1.005], dtype=torch.float64).reshape(1, 1, 1, 1, 2)
        potentials = relative_difference(), quadratic(level), log_cosh(level, 0.1)
        costs = [Prior(potential, *pair)(x).item() / level for potential in potentials]
        assert costs == pytest.approx([0.01**2 / 2] * 3, rel=0.02)
        # beyond delta the log-cosh costs delta for each level, the square ever more
        far = level * torch.tensor([1.0, 3.0], dtype=torch.float64).reshape(1, 1, 1, 1, 2)
        slopes = [Prior(potential, *pair).gradient(far)[..., 1].item() for potential in potentials]
        assert slopes[1:] == pytest.approx([2.0, 0.1])


@pytest.mark.parametrize("kind", KINDS)
def test_the_curvature_times_the_value_is_bounded(kind):
    """What the step of BSREM relies on, by Gershgorin's circles of x^(1/2) H x^(1/2)."""
    R = prior(**kind)
    x = volume().clamp_min(1e-3)[:1]
    every = torch.autograd.functional.hessian(lambda v: R(v).sum(), x, vectorize=True)
    hessian = every.reshape(120, 120)
    root, bound = x.flatten().sqrt(), R.bound(x).flatten()
    scaled = root[:, None] * hessian * root
    norms = torch.linalg.eigvalsh(scaled / (bound[:, None] * bound).sqrt().clamp_min(1e-9))
    assert -1e-9 < norms.min() and norms.max() <= 1


def test_an_edge_visible_in_ct_is_not_penalised():
    edge = (1 + anatomy()[None, None]).double()
    plain, guided = prior(), prior(anatomy=anatomy(), similar=7)
    assert plain(edge).item() > 1 and guided(edge).item() == 0
    # within a tissue all neighbours are equal, and all count
    inner = edge.clone()
    inner[..., 2, 2, 1] = 3.0
    assert guided(inner).item() == pytest.approx(plain(torch.where(edge > 1, 1, inner)).item())


@pytest.mark.parametrize("similar", [1, 7, 20])
def test_rounding_does_not_choose_among_equal_neighbours(similar):
    """Of an anatomy in Hounsfield units, and of one in 1/mm."""
    rng = torch.Generator().manual_seed(0)
    x = torch.rand(1, 1, *SHAPE, generator=rng)
    for unit in (1000.0, 0.0096):
        exact = unit * (1 + anatomy().float())
        near = exact * (1 + 1e-7 * torch.randn(SHAPE, generator=rng))
        one, other = (prior(anatomy=f, similar=similar).gradient(x) for f in (exact, near))
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize(
    "options",
    [
        {"gamma": -1.0},
        {"gamma": torch.inf},
        {"similar": 0},
        {"name": "log_cosh", "delta": 0.0},
        {"name": "huber"},
        {"anatomy": torch.zeros(4, 5, 5)},
        {"anatomy": torch.full(SHAPE, torch.nan)},
    ],
)
def test_an_invalid_prior_is_refused(options):
    """Priors refuse another name, a gamma or delta out of its range, no neighbours, and an anatomy
    of another shape or with NaN.
    """
    with pytest.raises(ValueError, match="Expected"):
        prior(**options)


@pytest.mark.parametrize(
    ("make", "weight", "kind"),
    [
        (Dense, 0.02, {}),
        (tabulated, 0.3, {}),
        (tabulated, 0.1, {"name": "quadratic"}),
        (Dense, 0.1, {"name": "log_cosh", "delta": 1.0}),
    ],
)
def test_bsrem_converges_to_the_minimum_of_another_method(make, weight, kind):
    """L-BFGS of torch on the square root of the volume, with autograd's gradients."""
    A = make()
    counts, added = counted(A), 0.5
    x = bsrem(A, counts, 100, weight, subsets=3, background=added, prior=kind)
    L = PoissonLikelihood(A, counts, added, skip_zero_bins=False)
    seen = L.sensitivity(torch.float64)[0, 0] > 0
    level = counts.sum() / L.sensitivity(torch.float64).sum()
    R = prior_of(kind, level.reshape(1, 1, 1, 1, 1), voxel_steps(A), seen)
    strength = weight * scale(A, counts)

    root = mlem(A, counts, 5, added).sqrt().requires_grad_()
    search = torch.optim.LBFGS([root], max_iter=200, line_search_fn="strong_wolfe", history_size=30)

    def objective() -> torch.Tensor:
        search.zero_grad()
        volume = root.square() * seen
        value = (L(volume) + strength * R(volume)).sum()
        value.backward()
        return value

    search.step(objective)
    other = root.detach().square() * seen
    values = [(L(v) + strength * R(v)).item() for v in (x, other)]
    assert values[0] - values[1] < 1e-5 * abs(values[1])
    assert gap(x, other) < 2e-2
    assert gap(A(x), A(other)) < 3e-3


def test_the_objective_is_reported_and_decreases_in_each_iteration():
    A, values = tabulated(), []
    bsrem(
        A,
        counted(A),
        12,
        0.05,
        1,
        background=0.2,
        monitor=lambda iterate: values.append(iterate.objective.item()),
    )
    assert len(values) == 12
    assert all(b < a for a, b in zip(values, values[1:], strict=False))


def test_a_larger_weight_reduces_noise_at_any_count_level():
    A = tabulated()
    views = A(torch.ones(1, 1, *A.domain_shape, dtype=torch.float64))
    for level in (5.0, 500.0):
        counts = torch.poisson(
            level / views.mean() * views, generator=torch.Generator().manual_seed(4)
        )
        spreads = []
        for weight in (1e-3, 0.02, 0.3):
            x = bsrem(A, counts, 30, weight)
            seen = x > 0
            spreads.append((x[seen].std() / x[seen].mean()).item())
        assert spreads[0] > spreads[1] > spreads[2] and spreads[2] < 0.1


def test_it_keeps_the_contract_of_methods():
    check_method("bsrem", projector(), iterations=4)


@pytest.mark.parametrize("make", [tabulated, Dense])
def test_it_explains_consistent_views(make):
    A = make()
    views = A(truth(A))
    x = bsrem(A, views, 100, 1e-5)
    assert gap(A(x), views) < 2e-2


@pytest.mark.pairwise(
    name=["relative_difference", "quadratic", "log_cosh"], dtype=[torch.float32, torch.float64]
)
def test_the_volume_scales_with_the_counts(dtype, name):
    A, shown, factors = tabulated(), {}, [2.0**n for n in (-100, -60, 40)]
    counts, added = counted(A).to(dtype), 0.5
    for factor in (1.0, *factors):
        values = shown[factor] = []

        def monitor(iterate, values=values, factor=factor):
            values.append(iterate.objective.item() / factor)

        options = {"background": added * factor, "prior": {"name": name}}
        shown[factor, "x"] = bsrem(A, factor * counts, 5, 0.03, **options) / factor
        bsrem(A, factor * counts, 5, 0.03, monitor=monitor, **options)
    for factor in factors:
        assert torch.equal(shown[1.0, "x"], shown[factor, "x"])
        # the likelihood of a multiple differs by a constant
        ordinary, scaled = (
            torch.tensor(shown[key], dtype=torch.float64).diff() for key in (1.0, factor)
        )
        assert gap(scaled, ordinary) < (1e-3 if dtype == torch.float32 else 1e-6)


def test_noise_stops_each_sample_of_a_batch_as_if_alone():
    A = tabulated()
    x = truth(A, batch=3)
    x[0], x[1] = 0.1 * x[0], 1
    views = A(x)
    monitor = discrepancy(0.02 * views.max().item())
    whole = bsrem(A, views, 30, 1e-5, monitor=monitor)
    for n in range(3):
        assert gap(whole[n], bsrem(A, views[n : n + 1], 30, 1e-5, monitor=monitor)[0]) < 1e-9


def test_invalid_options_are_refused():
    A = Dense()
    counts = counted(A)
    with pytest.raises(ValueError, match="weight"):
        bsrem(A, counts, weight=-1.0)
    with pytest.raises(TypeError, match="gama"):
        bsrem(A, counts, prior={"gama": 2.0})
    with pytest.raises(ValueError, match="requires it"):
        bsrem(A, counts.clone().requires_grad_())
