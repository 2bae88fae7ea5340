"""SIRT converges to the solution determined by the views."""

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.sirt import sirt, sirt_weights

GRID = Grid.centred(size=(8, 7, 6), spacing=2.0)
RIG = circular(9, 60.0, 100.0, {"pixels": [9, 11], "pixel_mm": 2.5}, start_degrees=5.0)


@pytest.fixture
def A():
    return PROJECTORS.build("drr", grid=GRID, cameras=RIG)


def weighted(A, x, y, R):
    return (R * (y - A(x)).square()).sum(dim=(1, 2, 3, 4))


def test_every_iteration_lowers_the_weighted_residual(A):
    torch.manual_seed(0)
    y = A(torch.rand(2, 1, *GRID.shape))
    R, _ = sirt_weights(A)
    residuals = [weighted(A, sirt(A, y, n, nonnegative=False), y, R) for n in (0, 1, 2, 4, 8, 16)]
    for earlier, later in zip(residuals, residuals[1:], strict=False):
        assert (later < earlier).all()


def test_momentum_replaces_many_iterations(A):
    torch.manual_seed(0)
    y = A(torch.rand(1, 1, *GRID.shape))
    R, _ = sirt_weights(A)
    fast, slow = sirt(A, y, 12, momentum=True), sirt(A, y, 24)
    assert weighted(A, fast, y, R) < weighted(A, slow, y, R)


def test_it_recovers_a_volume_that_the_views_determine(A):
    torch.manual_seed(1)
    truth = torch.rand(1, 1, *GRID.shape)
    x = sirt(A, A(truth), 300)
    assert (A(x) - A(truth)).norm() < 5e-3 * A(truth).norm()
    assert (x - truth).norm() < 0.25 * truth.norm()


def test_the_truth_is_a_fixed_point(A):
    truth = torch.rand(1, 1, *GRID.shape)
    assert torch.allclose(sirt(A, A(truth), 3, start=truth), truth, atol=1e-5)


def test_nothing_is_negative_unless_allowed(A):
    y = -torch.ones(1, 1, 9, 9, 11)
    assert not sirt(A, y, 2).any() and (sirt(A, y, 2, nonnegative=False) < 0).any()


def test_a_batch_equals_its_cases(A):
    y = torch.rand(2, 2, 9, 9, 11)
    whole = sirt(A, y, 3)
    # several volumes travel side by side, which sums in another order: the last digits alone may
    # differ
    torch.testing.assert_close(
        whole[1:, :1], sirt(A, y[1:, :1].contiguous(), 3), rtol=1e-5, atol=1e-6
    )
    assert torch.equal(whole, sirt(A, y, 3, weights=sirt_weights(A)))


def test_weights_invert_the_sums_and_are_zero_if_empty():
    far = Grid.centred(size=(30, 7, 6), spacing=8.0)
    A = PROJECTORS.build("drr", grid=far, cameras=RIG)
    R, C = sirt_weights(A)
    rows = A(torch.ones(1, 1, *far.shape))
    assert (C == 0).any() and R.isfinite().all() and C.isfinite().all()
    assert torch.allclose((R * rows)[R > 0], torch.ones(()))


def test_gradients_flow_through_sirt():
    A = PROJECTORS.build(
        "drr",
        grid=Grid.centred(size=(3, 3, 2), spacing=2.0),
        cameras=circular(2, 60.0, 100.0, {"pixels": [2, 3], "pixel_mm": 3.0}),
    )
    y = torch.rand(1, 1, 2, 2, 3, dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(lambda y: sirt(A, y, 2, nonnegative=False), (y,))


def test_the_logarithm_of_no_intensity_is_refused(A):
    """Views with logarithms of no or negative intensity are refused with their number."""
    views = A(torch.rand(1, 1, *GRID.shape))
    views[0, 0, 1, 2, :2] = torch.tensor([0.0, -1.0]).log()
    with pytest.raises(ValueError, match="must be finite, got 2 of"):
        sirt(A, views, 1)
