from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.field import seen_depth_range
from mvrecon.geometry.grid import voxel_centres
from mvrecon.geometry.lattice import depth_edges
from mvrecon.methods.learned.view_frames import Frusta
from tests.kernels.warps.scenes import depth_index
from tests.methods.learned.rig import small_rig


def test_depth_bins_tile_the_range_and_index_is_its_inverse():
    z_range = torch.tensor([[80.0, 120.0], [-120.0, -80.0]], dtype=torch.float64)
    edges = depth_edges(z_range, 10)
    assert torch.allclose(edges[:, [0, -1]], z_range)
    expected = torch.arange(10, dtype=torch.float64).expand(2, 10)
    centres = (edges[:, 1:] + edges[:, :-1]) / 2
    assert torch.allclose(depth_index(centres, edges), expected)


def test_lift_conserves_every_ray_integral():
    grid, cameras = small_rig()
    frusta = Frusta.of(grid, cameras, 12)
    views = torch.rand(2, 3, len(cameras), *cameras.shape)
    sees = frusta.chord.reshape(1, 1, len(cameras), *cameras.shape) > 0
    assert torch.allclose(frusta.integrate(frusta.spread(views)), views * sees, rtol=1e-5)
    assert sees.any() and not sees.all()


def test_frustum_chord_is_the_length_of_the_ray_in_the_box():
    grid, cameras = small_rig(n_views=1, size=12, pixels=13)
    chord = Frusta.of(grid, cameras, 240).chord[0, 0, 0]
    assert chord[6, 6].item() == pytest.approx(
        24.0, rel=1e-3
    )  # the central ray crosses 12 voxels of 2 mm


def test_warp_of_a_linear_field_is_exact_where_seen():
    """Trilinear sampling reproduces a linear function of position; here of the position in the
    frustum.
    """
    grid, cameras = small_rig()
    frusta = Frusta.of(grid, cameras, 12)
    depth, v, u = frusta.shape
    ramp = torch.arange(depth, dtype=torch.float32)[:, None, None].expand(depth, v, u)
    world = frusta.to_volume(ramp.expand(1, len(cameras), 1, -1, -1, -1))
    uvz = cameras.project(voxel_centres(grid))
    edges = depth_edges(cameras.depth_range(grid), depth)
    expected = depth_index(uvz[..., 2], edges).float()
    inner = frusta.visible[:, 0] & (expected > 0) & (expected < depth - 1)
    inner &= (uvz[..., 0] > 0) & (uvz[..., 0] < u - 1) & (uvz[..., 1] > 0) & (uvz[..., 1] < v - 1)
    assert inner.any()
    assert torch.allclose(world[0, :, 0][inner], expected[inner], atol=2e-4)


def test_world_to_frustum_to_volume_converges_to_second_order():
    errors = []
    for size in (12, 24, 48):
        grid, cameras = small_rig(n_views=3, size=size, pixels=2 * size)
        frusta = Frusta.of(grid, cameras, 2 * size)
        r2 = voxel_centres(grid).float().square().sum(-1)
        blob = torch.exp(-r2 / (2 * (0.3 * size) ** 2))[None, None, None]
        back = frusta.to_volume(frusta.to_frusta(blob))[:, :, :, 1:-1, 1:-1, 1:-1]
        errors.append((back - blob[..., 1:-1, 1:-1, 1:-1]).abs().max().item())
    assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3.5


def test_pinholes_lift_like_any_other_camera():
    grid, _ = small_rig()
    cameras = CAMERAS.build(
        "dome",
        n_views=3,
        radius=100.0,
        focal=40.0,
        aperture_degrees=60.0,
        detector={"pixels": [9, 9], "pixel_mm": 2.0},
    )
    frusta = Frusta.of(grid, cameras, 8)
    views = torch.rand(1, 1, 3, 9, 9) * (frusta.chord.reshape(1, 1, 3, 9, 9) > 0)
    assert (frusta.step > 0).all() and views.any()
    assert torch.allclose(frusta.integrate(frusta.spread(views)), views, rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_casting_the_module_keeps_its_geometry_exact(dtype):
    grid, cameras = small_rig()
    frusta = torch.rand(1, len(cameras), 1, 12, *cameras.shape)
    expected = Frusta.of(grid, cameras, 12).to_volume(frusta)
    assert torch.equal(Frusta.of(grid, cameras, 12).to(dtype).to_volume(frusta), expected)


def test_warps_compile_into_one_graph():
    grid, cameras = small_rig()
    frusta = Frusta.of(grid, cameras, 12)
    volumes = torch.rand(1, 1, 2, *grid.shape)
    compiled = torch.compile(
        lambda x: frusta.to_volume(frusta.to_frusta(x)), fullgraph=True, backend="aot_eager"
    )
    assert torch.equal(compiled(volumes), frusta.to_volume(frusta.to_frusta(volumes)))


def test_a_shared_volume_equals_one_per_camera():
    grid, cameras = small_rig()
    frusta, volume = Frusta.of(grid, cameras, 12), torch.rand(2, 1, 3, *grid.shape)
    each = frusta.to_frusta(volume.expand(-1, len(cameras), -1, -1, -1, -1))
    assert torch.equal(frusta.to_frusta(volume), each) and each.any()


def test_nothing_behind_a_source_inside_the_grid_is_occupied_or_visible():
    grid, cameras = small_rig(n_views=1)
    inner = replace(cameras, source=0.05 * cameras.source)
    frusta = Frusta.of(grid, inner, 12)
    planes = depth_edges(inner.depth_range(grid), 12)[0]
    z = (planes[1:] + planes[:-1]) / 2
    assert (
        (z < 0).any()
        and (depth_edges(seen_depth_range(inner, grid), 12) >= 0).all()
        and frusta.occupied.any()
    )
    behind = inner.project(voxel_centres(grid))[0, ..., 2] < 0
    assert behind.any() and frusta.visible.any() and not frusta.visible[0, 0][behind].any()
