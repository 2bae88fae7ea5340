"""Ideal projections: both ends are exact, and the networks learn from either."""

import pytest
import torch

from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.methods.classical.fdk import fbp
from mvrecon.training.losses import ReconstructionLoss
from mvrecon_baselines.radon_unet import RadonUNet, half_circle


def blob(grid: Grid, voxels: float) -> torch.Tensor:
    """A Gaussian that has fallen to 1 / e at so many voxels from the grid's centre, [1 1 d h w]."""
    index = grid.to_index(voxel_centres(grid)) - grid.centre_index
    return (-(index / voxels).square().sum(-1)).exp()[None, None].float()


def oblique() -> Grid:
    """Voxels of 2 x 1.5 x 3 mm, rotated and moved."""
    grid = Grid.centred(size=(24, 32, 9), spacing=(2.0, 1.5, 3.0), centre=(4, 5, 6))
    return grid.moved(euler_rotation([30.0, 40.0, 10.0]), torch.zeros(3))


@pytest.mark.parametrize("grid", [Grid.centred(24, spacing=2.0), oblique()], ids=str)
def test_fbp_of_the_true_projections_is_the_volume(grid):
    """With all of its mass, and an error of second order in the voxel size, 2.5 % where it is 4.5
    voxels wide; also where voxels are not square and the grid is rotated.
    """
    A, errors = half_circle(grid), []
    for voxels in (2.25, 4.5):
        truth = blob(grid, voxels)
        volume = fbp(A, A(truth))
        assert volume.sum().item() == pytest.approx(truth.sum().item(), rel=0.005)
        errors.append(((volume - truth).norm() / truth.norm()).item())
    assert errors[1] < 0.025 and errors[1] < 0.3 * errors[0]


def test_half_a_circle_determines_the_full_circle():
    """A facing view is the mirror image: views 0, 2, ... of 32 are those of 16 angles."""
    grid = Grid.centred(12, spacing=2.0)
    x, A = torch.rand(1, 1, *grid.shape), half_circle(grid, 16)
    assert len(A.cameras) == 8
    torch.testing.assert_close(half_circle(grid, 32)(x)[:, :, ::2], A(x))


@torch.no_grad()
def test_untrained_it_returns_the_fbp_of_the_initial_projections(cone):
    A = cone()
    out = RadonUNet(4, widths=[4, 6], angles=24, precision="float32").eval()(
        A(torch.rand(2, 1, *A.grid.shape)), A
    )
    torch.testing.assert_close(out.completed, out.dense(out.start), rtol=1e-4, atol=1e-4)
    volume = fbp(out.dense, out.completed).clamp_min(0)
    torch.testing.assert_close(out.volume, volume, rtol=1e-4, atol=1e-4)
    assert out.completed.shape == (2, 1, 12, 12, 17) and out.volume.shape[1:] == (1, 12, 12, 12)


@pytest.mark.parametrize("weights", [{"volume": 0.0, "completed_views": 10.0}, {"volume": 1.0}])
def test_both_networks_learn_from_projections_and_end_to_end(weights, cone):
    """The projection loss compares with the true projections and is zero only for them."""
    A, random = cone(), torch.manual_seed(0)
    method = RadonUNet(4, widths=[4, 6], angles=24)
    for parameter in method.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=random)
    truth = torch.rand(1, 1, *A.grid.shape)
    loss = ReconstructionLoss(1.0, **weights)
    batch = {"volume": truth, "views": A(truth)}
    out = method(batch["views"], A)
    terms = loss(out, batch)
    terms["total"].backward()
    assert all(p.grad is not None and p.grad.any() for p in method.parameters())
    if weights["volume"] == 0:
        assert terms["total"].item() == pytest.approx(10 * terms["completed_views"].item())
        out.completed = out.dense(truth)
        assert loss(out, batch)["completed_views"].item() < 1e-12


@pytest.mark.parametrize("options", [{"angles": 7}, {"angles": 2}, {"features": 0}])
def test_invalid_numbers_of_projections_are_refused(options):
    """A method of ideal projections refuses an odd number of angles, fewer than 4, and no
    feature.
    """
    with pytest.raises(ValueError, match="even number of angles"):
        RadonUNet(2, **options)


def test_a_wrong_number_of_cameras_is_refused(cone):
    """A network whose channels are cameras refuses another number of them."""
    A = cone()
    with pytest.raises(ValueError, match="Expected 3 cameras, got 4"):
        RadonUNet(3, widths=[4])(torch.ones(1, 1, *A.range_shape), A)
