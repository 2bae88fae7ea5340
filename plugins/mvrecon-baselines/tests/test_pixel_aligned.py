"""Features of views at voxels: at the right place, and for any order of the cameras."""

import pytest
import torch

from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.grid import voxel_centres
from mvrecon.methods.method import Reconstruction, build_method
from mvrecon.operators.drr import Drr
from mvrecon_baselines.pixel_aligned import at_voxels, edges

SMALL = {
    "dif_net": {"widths": [4, 6], "features": 4},
    "svct": {"widths": [4, 6], "features": 4, "decoder": [4, 6]},
}


def test_features_of_a_column_ramp_are_the_projected_columns_of_the_voxels(cone):
    A = cone(pixels=24)
    ramp = torch.arange(24.0).expand(1, len(A.cameras), 1, 24, 24)
    column = A.cameras.project(voxel_centres(A.grid).reshape(-1, 3))[..., 0]
    column = column.reshape(1, len(A.cameras), 1, *A.grid.shape).float()
    inside = (column > 0) & (column < 23)
    assert inside.float().mean() > 0.9
    features = at_voxels(ramp, A.cameras, A.grid)
    assert torch.allclose(features[inside], column[inside], atol=1e-3)


@pytest.mark.parametrize("name", SMALL)
@torch.no_grad()
def test_results_do_not_depend_on_the_camera_order(name, cone):
    torch.manual_seed(0)
    A, order = cone(), [2, 0, 3, 1]
    method = build_method({"name": name, **SMALL[name]})
    views = A(torch.rand(1, 1, *A.grid.shape))
    volume = method(views, A).volume
    again = method(views[:, :, order], Drr(A.grid, A.cameras[order])).volume
    assert torch.allclose(again, volume, atol=1e-5 * volume.abs().max())


@pytest.mark.parametrize("name", SMALL)
def test_explicit_rays_are_refused(name, cone):
    """Features of views at voxels refuse explicit rays, which have no image."""
    A = cone()
    start, end = A.cameras.rays()
    B = Drr(A.grid, ExplicitRays(start, end))
    with pytest.raises(ValueError, match="with cameras, .* explicit rays"):
        build_method({"name": name, **SMALL[name]})(torch.ones(1, 1, *B.range_shape), B)


def test_the_loss_of_edges_ignores_offsets_and_counts_differences_inside_the_support():
    truth, ramp = torch.zeros(1, 1, 4, 4, 4), torch.arange(4.0).expand(1, 1, 4, 4, 4)
    batch = {"volume": truth}
    assert edges(Reconstruction(truth + 1), batch, 2.0) == 0
    assert edges(Reconstruction(ramp), batch, 2.0).item() == pytest.approx(0.25 / 3)
    spike = ramp.clone()
    spike[..., 3] += 100
    support = torch.ones_like(truth, dtype=torch.bool)
    support[..., 3] = False
    assert edges(Reconstruction(spike, support=support), batch, 2.0).item() == pytest.approx(
        0.25 / 3
    )
