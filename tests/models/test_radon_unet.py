"""The pathway by ideal projections: its two ends are exact, and its networks learn from either."""

import pytest
import torch

from mvrecon.engine.on_rig import OnRig
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.losses import ReconstructionLoss
from mvrecon.models.radon_unet import RadonUNet
from mvrecon.parts import CAMERAS, PROJECTORS
from mvrecon.projectors.radon import Radon
from tests.models.rig import small_projector


def blob(grid: Grid, voxels: float) -> torch.Tensor:
    """A Gaussian that has fallen to 1 / e at so many voxels from the grid's centre, [1 1 d h w]."""
    index = grid.to_index(voxel_centres(grid)) - grid.centre_index
    return (-(index / voxels).square().sum(-1)).exp()[None, None].float()


def oblique() -> torch.nn.Module:
    """Voxels of 2 x 1.5 x 3 mm, turned and moved, and a rig that sees them."""
    grid = Grid.centred(size=(24, 32, 9), spacing=(2.0, 1.5, 3.0), centre=(4, 5, 6))
    turn = euler_rotation([30.0, 40.0, 10.0])
    grid = grid.moved(turn, torch.zeros(3))
    detector = {"pixels": [12, 12], "pixel_mm": 12.0}
    cameras = CAMERAS.build("circular", n_views=2, sid=200.0, sdd=400.0, detector=detector)
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)


@pytest.mark.parametrize("rig", [lambda: small_projector(2, size=24), oblique])
@torch.no_grad()
def test_filtered_back_projection_of_the_true_projections_is_the_volume(rig):
    """With all of its mass, and an error of second order in the voxel size, 2.5 % where it is 4.5
    voxels wide; also where voxels are not square and the grid is turned in the world.
    """
    A, errors = rig(), []
    model = RadonUNet(A, widths=[4])
    for voxels in (2.25, 4.5):
        truth = blob(A.grid, voxels)
        volume = model.backprojected(model.radon(truth))
        assert volume.sum().item() == pytest.approx(truth.sum().item(), rel=0.005)
        errors.append(((volume - truth).norm() / truth.norm()).item())
    assert errors[1] < 0.025 and errors[1] < 0.3 * errors[0]


@torch.no_grad()
def test_half_a_circle_holds_the_whole_one():
    """A facing view is the mirror image: projections from both sides say what those of one say."""
    A = small_projector(2)
    x, half = torch.rand(1, 1, *A.grid.shape), RadonUNet(A, angles=16, widths=[4])
    assert len(half.corrected_cameras) == 8
    views = half.radon(x)
    facing = RadonUNet(A, angles=32, widths=[4]).radon(x)[:, :, ::2]
    torch.testing.assert_close(facing, views)


@torch.no_grad()
def test_untrained_it_gives_the_start_by_its_projections():
    A = small_projector()
    model = RadonUNet(A, widths=[4, 6], angles=24).eval()
    out = model(A(torch.rand(2, 1, *A.grid.shape)))
    torch.testing.assert_close(out.corrected_views[0], model.radon(out.start), rtol=1e-4, atol=1e-4)
    volume = model.backprojected(out.corrected_views[0]).clamp_min(0)
    torch.testing.assert_close(out.volume, volume, rtol=1e-4, atol=1e-4)
    assert out.corrected_views[0].shape == (2, 1, 12, 12, 17) and out.volume.shape[1:] == (
        1,
        12,
        12,
        12,
    )


@pytest.mark.parametrize("weights", [{"volume": 0.0, "corrected_views": 10.0}, {"volume": 1.0}])
def test_both_networks_learn_from_projections_alone_and_end_to_end(weights):
    """The loss in projections is against the truth's own, by the projector radon; it is zero for
    them alone.
    """
    A, torch_seed = small_projector(), torch.manual_seed(0)
    model = RadonUNet(A, widths=[4, 6], angles=24)
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=torch_seed)
    truth = torch.rand(1, 1, *A.grid.shape)
    radon = OnRig(A, model, {"name": "drr"}, {"name": "radon_unet"}).corrected
    assert type(radon) is Radon
    loss = ReconstructionLoss(1.0, **weights)
    batch = {"volume": truth, "views": A(truth), "true_views": radon(truth)}
    out = model(batch["views"])
    terms = loss(out, batch)
    terms["total"].backward()
    assert all(p.grad is not None and p.grad.any() for p in model.parameters())
    if weights["volume"] == 0:
        assert terms["total"].item() == pytest.approx(10 * terms["corrected_views"].item())
        out.corrected_views = (model.radon(truth),)
        assert loss(out, batch)["corrected_views"].item() < 1e-12


@pytest.mark.parametrize("options", [{"angles": 7}, {"angles": 2}, {"features": 0}])
def test_projections_that_there_are_not_are_refused(options):
    """A model of ideal projections refuses an odd number of angles, fewer than 4, and no
    feature.
    """
    with pytest.raises(ValueError, match="even number of angles"):
        RadonUNet(small_projector(2), **options)
