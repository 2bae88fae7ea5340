"""The relative difference prior: its value by hand, its derivative, and what it is invariant to."""

import pytest
import torch

from mvrecon.methods.classical.bsrem import RelativeDifference

SHAPE, STEPS = (4, 5, 6), (2.0, 1.0, 1.0)


def prior(**options) -> RelativeDifference:
    mask = torch.ones(SHAPE, dtype=torch.bool)
    mask[0, :2] = False
    return RelativeDifference(STEPS, mask, **options)


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


def test_two_voxels_cost_what_the_formula_says():
    """Two slices 2 mm apart in voxels of 1 mm: half the weight."""
    R = RelativeDifference((2.0, 1.0, 1.0), torch.ones(2, 1, 1, dtype=torch.bool), gamma=3.0)
    x = torch.tensor([1.0, 5.0], dtype=torch.float64).reshape(1, 1, 2, 1, 1)
    assert R(x).item() == pytest.approx(0.5 * 16 / (6 + 3 * 4))
    R = RelativeDifference((1.0, 1.0, 1.0), torch.ones(1, 2, 2, dtype=torch.bool), gamma=0.0)
    x = torch.tensor([[1.0, 1.0], [1.0, 3.0]], dtype=torch.float64).reshape(1, 1, 1, 2, 2)
    assert R(x).item() == pytest.approx((2 + 2**-0.5) * 4 / 4, rel=1e-6)


@pytest.mark.parametrize("gamma", [0.0, 2.0, 10.0])
@pytest.mark.parametrize("guided", [False, True])
def test_the_derivative_is_that_of_autograd(gamma, guided):
    R = prior(gamma=gamma, anatomy=anatomy() if guided else None)
    x = volume().clamp_min(1e-3).requires_grad_()
    (slope,) = torch.autograd.grad(R(x).sum(), x)
    torch.testing.assert_close(R.gradient(x.detach()), slope, rtol=1e-10, atol=1e-12)


def test_it_is_homogeneous_and_between_zeros_it_has_no_slope():
    R, x = prior(), volume()
    torch.testing.assert_close(R(7 * x), 7 * R(x))
    torch.testing.assert_close((R.gradient(x) * x).flatten(1).sum(dim=1), R(x))
    assert R.gradient(x).isfinite().all() and not R.gradient(torch.zeros_like(x)).any()
    assert not R.gradient(x)[:, :, 0, :2].any()  # outside the mask


def test_its_curvature_times_the_value_is_bounded_by_the_weights():
    """What the step of BSREM relies on, by Gershgorin's circles of x^(1/2) H x^(1/2)."""
    R = prior()
    x = volume().clamp_min(1e-3)[:1]
    hessian = torch.autograd.functional.hessian(lambda v: R(v).sum(), x).reshape(120, 120)
    root = x.flatten().sqrt()
    scaled = root[:, None] * hessian * root
    bound = 2 * R.weights(x).flatten()
    norms = torch.linalg.eigvalsh(scaled / (bound[:, None] * bound).sqrt().clamp_min(1e-9))
    assert -1e-9 < norms.min() and norms.max() <= 1


def test_ct_takes_away_the_cost_of_an_edge_that_it_shows():
    edge = (1 + anatomy()[None, None]).double()
    plain, guided = prior(), prior(anatomy=anatomy(), similar=7)
    assert plain(edge).item() > 1 and guided(edge).item() == 0
    # within a tissue all neighbours are equal, and all count
    inner = edge.clone()
    inner[..., 2, 2, 1] = 3.0
    assert guided(inner).item() == pytest.approx(plain(torch.where(edge > 1, 1, inner)).item())


@pytest.mark.parametrize(
    "options",
    [
        {"gamma": -1.0},
        {"gamma": torch.inf},
        {"similar": 0},
        {"anatomy": torch.zeros(4, 5, 5)},
        {"anatomy": torch.full(SHAPE, torch.nan)},
    ],
)
def test_a_prior_that_cannot_be_is_refused(options):
    """The relative difference prior refuses a negative gamma, no neighbours, and an anatomy of
    another shape or with NaN.
    """
    with pytest.raises(ValueError, match="Expected a finite"):
        prior(**options)
