"""A camera is skipped only if none of its rays meets the box; depth ranges cover what it sees."""

from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras, Extent
from mvrecon.geometry.cameras.field import seen_depth_range, views_that_see
from mvrecon.geometry.cameras.rigs import circular, dome
from mvrecon.geometry.grid import Box, Grid
from mvrecon.geometry.rigid import random_rotation
from tests.geometry.cameras.rigs import random_cameras

KINDS = [
    ("segment", False),
    ("behind", False),
    ("ahead", False),
    ("line", False),
    ("segment", True),
    ("line", True),
]


def random_rig(seed: int, extent: Extent, parallel: bool) -> Cameras:
    """Five cameras in random poses, with fields of view of about 30 degrees."""
    thin = random_cameras(5, seed, "behind" if extent == "behind" else "ahead")
    origin = thin.origin - 3 * (4 * thin.u + 3 * thin.v)
    return replace(
        thin, origin=origin, u=4 * thin.u, v=4 * thin.v, extent=extent, parallel=parallel
    )


def random_grid(seed: int, cameras: Cameras) -> Grid:
    """Voxels of any size and shape, turned and sheared, in or beside the field of the first
    camera.
    """
    rng = torch.Generator().manual_seed(1000 + seed)
    affine = torch.eye(4, dtype=torch.float64)
    shear = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(
        3, 3, generator=rng, dtype=torch.float64
    ).triu(1)
    size = 1 + 6 * torch.rand(3, generator=rng, dtype=torch.float64)
    affine[:3, :3] = random_rotation(rng) @ shear @ size.diag()
    rows, columns = cameras.shape
    u, v, w = (
        2 * torch.rand(3, generator=rng, dtype=torch.float64) - 0.5
    )  # of the detector and of the distance to it
    w = -w if cameras.extent == "behind" else w
    place = torch.stack([u * columns, v * rows, w * cameras.distance[0]])
    affine[:3, 3] = cameras[0].unproject(place[None])[0]
    return Grid((5, 8, 11), affine)


def stretches(cameras: Cameras, grid: Grid, across: int = 41):
    """Parameters w [m rays 2] at which rays over each detector, including its edges, enter and
    leave the box.
    """
    rows, columns = cameras.shape
    v, u = (torch.linspace(-0.5, n - 0.5, across, dtype=torch.float64) for n in (rows, columns))
    uv = torch.cartesian_prod(u, v).expand(len(cameras), -1, 2)
    ends = [
        torch.cat([uv, z.expand(uv.shape[1], -1).T[..., None]], dim=-1)
        for z in (0 * cameras.distance, cameras.distance)
    ]
    start, end = (grid.to_index(cameras.unproject(uvz)) for uvz in ends)
    sizes = torch.tensor(grid.shape[::-1], dtype=torch.float64)
    faces = torch.stack([-0.5 - start, sizes - 0.5 - start]) / (end - start)
    least, most = cameras.ray_extent
    enter = faces.amin(dim=0).amax(dim=-1).clamp_min(least)
    leave = faces.amax(dim=0).amin(dim=-1).clamp_max(most)
    return enter, leave


@pytest.mark.parametrize(("extent", "parallel"), KINDS)
def test_cameras_are_skipped_if_and_almost_only_if_no_ray_meets_the_box(extent, parallel):
    visible, hit = [], []
    for seed in range(40):
        cameras = random_rig(seed, extent, parallel)
        grid = random_grid(seed, cameras)
        enter, leave = stretches(cameras, grid)
        visible.append(views_that_see(cameras, grid, margin=0))
        hit.append((enter <= leave).any(dim=1))
    visible, hit = torch.cat(visible), torch.cat(hit)
    assert hit.any() and not hit.all()
    assert visible[hit].all()
    assert (visible & ~hit).sum() <= 0.02 * len(
        visible
    )  # the box's corner between two of the rays that were tried


@pytest.mark.parametrize(("extent", "parallel"), KINDS)
def test_depths_are_those_of_the_rays_inside_the_box(extent, parallel):
    compared = 0
    for seed in range(20):
        cameras = random_rig(seed, extent, parallel)
        grid = random_grid(seed, cameras)
        enter, leave = stretches(cameras, grid)
        met = enter <= leave
        some = met.any(dim=1)
        near = torch.where(met, enter, torch.inf).amin(dim=1) * cameras.distance
        far = torch.where(met, leave, -torch.inf).amax(dim=1) * cameras.distance
        low, high = seen_depth_range(cameras, grid).T
        assert (low <= near + 1e-9)[some].all() and (high >= far - 1e-9)[some].all()
        voxel = max(grid.spacing)
        assert (low > near - voxel)[some].all() and (high < far + voxel)[some].all()
        whole = cameras.depth_range(grid)
        assert (low >= whole[:, 0]).all() and (high <= whole[:, 1]).all()
        compared += int((some & (high - low < 0.9 * (whole[:, 1] - whole[:, 0]))).sum())
    assert compared >= 10  # views that see much less than the whole box


def one_camera(**changes) -> Cameras:
    """At (0, 0, -100), looking along +z at a detector of 20 x 20 mm, 200 mm away: 0.1 mm wide per
    mm of depth.
    """
    vectors = {
        "source": [0.0, 0, -100],
        "origin": [-9.5, -9.5, 100],
        "u": [1.0, 0, 0],
        "v": [0.0, 1, 0],
    }
    return Cameras(
        **{name: torch.tensor([vector]) for name, vector in vectors.items()},
        shape=(20, 20),
        **changes,
    )


@pytest.mark.parametrize(
    ("centre", "extent", "sees"),
    [
        ((0, 0, 0), "segment", True),
        ((0, 0, -120), "segment", False),  # behind the source
        ((0, 0, -120), "line", True),
        ((0, 0, -120), "ahead", False),
        ((0, 0, 120), "segment", False),  # beyond the detector
        ((0, 0, 120), "ahead", True),
        ((8.9, 0, 0), "segment", True),  # half a field of 5 mm and half a box of 4 mm
        ((9.1, 0, 0), "segment", False),
        ((0, -9.1, 0), "segment", False),
        ((0, 9.1, 0), "ahead", False),
        ((0, 0, 99.98), "segment", True),
        ((0, 0, 100.02), "segment", False),
        ((0, 0, -100.02), "segment", False),
        ((0, 0, -100), "segment", True),  # the source inside the box
    ],
)
def test_boxes_beside_behind_and_beyond_are_visible_according_to_the_extent(centre, extent, sees):
    grid = Grid.centred(size=(4, 4, 1), spacing=(2.0, 2.0, 0.02), centre=centre)
    assert views_that_see(one_camera(extent=extent), grid, margin=0).tolist() == [sees]


def test_a_camera_that_faces_away_sees_nothing():
    rig = circular(6, 400.0, 800.0, {"pixels": 8, "pixel_mm": 10.0})
    grid = Grid.centred((8, 8, 8), 10.0)
    back = (
        2 * rig.source - rig.origin - 7 * rig.u
    )  # the detector behind the source, its columns turned round
    assert views_that_see(rig, grid).all()
    assert not views_that_see(replace(rig, origin=back - 7 * rig.v, v=-rig.v, u=rig.u), grid).any()


def test_a_rig_sees_its_grid_and_only_some_cameras_see_a_corner():
    cameras = dome(16, 200.0, 70.0, 180.0, {"pixels": [48, 48], "pixel_mm": 0.3})
    grid = Grid.centred((32, 32, 32), 4.0)
    assert views_that_see(cameras, grid).all()
    corner = grid.cropped(Box((0, 0, 0), (8, 8, 8)))
    visible = views_that_see(cameras, corner)
    assert not visible.all()
    A = PROJECTORS.build("drr", grid=corner, cameras=cameras, backend="reference")
    views = A(torch.ones(1, 1, 8, 8, 8))[0, 0]
    assert torch.equal(visible, views.flatten(1).any(dim=1))


def test_the_margin_is_the_support_of_the_interpolation():
    grid = Grid.centred(
        (4, 4, 4), 4.0, centre=(14.2, 0.0, 0.0)
    )  # from 6.2 mm on, 1.2 mm beside the field's edge
    camera = one_camera()
    assert not views_that_see(camera, grid, margin=0) and views_that_see(camera, grid)
    assert PROJECTORS.build("drr", grid=grid, cameras=camera, backend="reference")(
        torch.ones(1, 1, 4, 4, 4)
    ).any()


@pytest.mark.parametrize("name", ["circular", "parallel"])
def test_a_view_of_the_whole_box_has_its_full_depth_range(name):
    cameras = CAMERAS.build(
        name,
        n_views=7,
        detector={"pixels": 40, "pixel_mm": 6.0},
        **({"sid": 400.0, "sdd": 800.0} if name == "circular" else {}),
    )
    grid = Grid.centred(size=(7, 8, 9), spacing=(10.0, 9.0, 8.0), centre=(3.0, 2.0, 1.0))
    torch.testing.assert_close(
        seen_depth_range(cameras, grid), cameras.depth_range(grid), rtol=1e-12, atol=0
    )


def test_a_narrow_view_has_only_the_depth_range_of_its_field():
    # a square box of side 80 mm on edge, seen along its diagonal: depth is lost in proportion to
    # the field's width
    grid = Grid.centred((40, 40, 40), 2.0)
    camera = CAMERAS.build(
        "parallel", n_views=1, detector={"pixels": [4, 10], "pixel_mm": 2.0}, start_degrees=45.0
    )
    middle, half = 500.0, 80.0 / 2**0.5
    torch.testing.assert_close(
        camera.depth_range(grid)[0], torch.tensor([middle - half, middle + half]).double()
    )
    torch.testing.assert_close(
        seen_depth_range(camera, grid)[0], torch.tensor([middle - half, middle + half]).double()
    )
    aside = camera.moved(torch.eye(3), 30.0 * torch.nn.functional.normalize(camera.u[0], dim=0))
    depth = half - 20.0  # at 30 mm less half of a field of 20 mm
    torch.testing.assert_close(
        seen_depth_range(aside, grid)[0], torch.tensor([middle - depth, middle + depth]).double()
    )


def test_a_blind_view_keeps_the_depths_of_the_box():
    grid = Grid.centred((4, 4, 4), 2.0, centre=(50.0, 0.0, 0.0))
    torch.testing.assert_close(
        seen_depth_range(one_camera(), grid), one_camera().depth_range(grid), rtol=0, atol=0
    )
