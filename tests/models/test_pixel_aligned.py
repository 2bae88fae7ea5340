"""Features of views at voxels: in the right place, and for any rig in any order."""

import pytest
import torch

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import voxel_centres
from mvrecon.parts import MODELS, PROJECTORS
from tests.models.rig import small_projector, small_rig

SMALL = {
    "dif_net": {"widths": [4, 6], "features": 4},
    "svct": {"widths": [4, 6], "features": 4, "decoder": [4, 6]},
}


@torch.no_grad()
def test_a_ramp_over_columns_arrives_as_the_column_of_each_voxel_s_projection():
    grid, cameras = small_rig(pixels=24)
    A = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    model = MODELS.build("dif_net", projector=A, **SMALL["dif_net"])
    ramp = torch.arange(24.0).expand(1, len(cameras), 1, 24, 24)
    assert isinstance(cameras, Cameras)
    column = cameras.project(voxel_centres(grid).reshape(-1, 3))[..., 0]
    column = column.reshape(1, len(cameras), 1, *grid.shape).float()
    inside = (column > 0) & (column < 23)
    assert inside.float().mean() > 0.9
    assert torch.allclose(model.at_voxels(ramp, grid)[inside], column[inside], atol=1e-3)


@pytest.mark.parametrize("name", SMALL)
@torch.no_grad()
def test_the_order_of_the_cameras_changes_nothing_and_weights_fit_any_rig(name):
    grid, cameras = small_rig()
    order = [2, 0, 3, 1]
    A, B = (PROJECTORS.build("drr", grid=grid, cameras=c) for c in (cameras, cameras[order]))
    torch.manual_seed(0)
    model = MODELS.build(name, projector=A, **SMALL[name])
    views = A(torch.rand(1, 1, *grid.shape))
    volume = model(views).volume
    for projector, seen in ((B, views[:, :, order]), (small_projector(3, pixels=7), None)):
        other = MODELS.build(name, projector=projector, **SMALL[name])
        other.load_state_dict(model.state_dict())
        if seen is not None:
            assert torch.allclose(other(seen).volume, volume, atol=1e-5 * volume.abs().max())
