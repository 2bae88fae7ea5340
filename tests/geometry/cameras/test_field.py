"""The field of a rig: isocentre, automatic grid, and a rig that misses its grid."""

import math

import pytest
import torch

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import (
    auto_grid,
    check_rig_sees,
    common_field,
    full_fan,
    isocentre,
    sees,
)
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned
from mvrecon.geometry.cameras.rigs import circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.methods.classical.orbit import orbit_of
from tests.geometry.cameras.rigs import OPTIONS

PLATE = {"pixels": [64, 96], "pixel_mm": 4.0}
AWAY = torch.tensor([30.0, -20.0, 55.0], dtype=torch.float64)


def moved(rig: Cameras) -> Cameras:
    return rig.moved(torch.eye(3), AWAY)


@pytest.mark.parametrize(
    "rig",
    [
        circular(7, 400.0, 800.0, {**PLATE, "offset_mm": [9.0, 40.0]}),
        parallel(5, PLATE),
        dome(9, 200.0, 70.0, 120.0, PLATE),
    ],
)
def test_principal_rays_meet_at_the_isocentre_wherever_the_rig_is(rig):
    turned = rig.moved(euler_rotation([20.0, 30.0, 40.0]), AWAY)
    assert torch.allclose(isocentre(turned), AWAY, atol=1e-8)


def test_the_field_of_view_of_a_circle_is_the_textbook_cylinder():
    """Radius sid sin(atan(half width / sdd)) and half height (half height / sdd) sid."""
    grid = auto_grid(moved(circular(180, 400.0, 800.0, PLATE)))
    assert grid.spacing == pytest.approx((2.0, 2.0, 2.0))
    assert torch.allclose(grid.centre, AWAY, atol=1e-6)
    radius, height = 400 * math.sin(math.atan(192 / 800)), 64.0
    assert [n * 2.0 for n in grid.size] == pytest.approx([2 * radius] * 2 + [2 * height], abs=2.0)


def test_a_given_size_covers_the_same_field_with_cubic_voxels():
    grid = auto_grid(parallel(30, PLATE), size=(48, 48, 48))
    assert grid.size == (48, 48, 48) and grid.spacing == pytest.approx((8.0,) * 3)


def test_a_shifted_detector_doubles_the_field_seen_by_half_of_the_views():
    rig = circular(180, 400.0, 800.0, {**PLATE, "offset_mm": [0.0, 150.0]})
    assert auto_grid(rig).size[0] < 45 < 150 < auto_grid(rig, seen_by=0.45).size[0]


def test_the_field_of_a_half_fan_is_that_of_the_lines_it_measures():
    """Radius sid sin(atan(reach of the wide side / sdd)); half of the views see farther
    points, too. Rigs that are none stay as they are. Also tried: 36 random half fans of every beam.
    """
    for side in (150.0, -150.0):
        rig = circular(180, 400.0, 800.0, {**PLATE, "offset_mm": [0.0, side]})
        radius = 400 * math.sin(math.atan((192 + 150) / 800))
        grid = auto_grid(full_fan(rig))
        assert grid.size[:2] == (math.ceil(radius),) * 2 and grid.spacing[0] == pytest.approx(2.0)
        assert (
            grid.size[2] == auto_grid(rig).size[2]
            and grid.size[0] < auto_grid(rig, seen_by=0.5).size[0]
        )
    whole = circular(180, 400.0, 800.0, PLATE)
    assert full_fan(whole) is whole


@pytest.mark.parametrize("nudge", [1e-13, -1e-13, 1e-10, -1e-10])
def test_rounding_does_not_decide_the_field(nudge):
    """Of panels three quarters as wide at one side of the axis, of a gap of 15 degrees, and of
    voxels on the edge of a panel. Also tried: other pitches, panels and first angles.
    """
    panel = {"pixels": [4, 56], "pixel_mm": 0.3, "offset_mm": [0.0, 1.2 * (1 + nudge)]}
    assert full_fan(parallel(90, panel, arc_degrees=360.0)).shape[1] == 64
    angles = [(5.0 * k + 10.0) * (1 + nudge) for k in range(72) if k not in (7, 8)]
    panel = {"pixels": [4, 64], "pixel_mm": 1.0, "offset_mm": [0.0, 16.0]}
    assert full_fan(circular(70, 200.0, 300.0, panel, angles=angles)).shape[1] == 96
    grid, field = Grid.centred(33, spacing=1.0), torch.zeros(1, 33, 33, 33, dtype=torch.bool)
    x, y, z = voxel_centres(grid).unbind(dim=-1)
    field[0] = (x.square() + y.square() <= 256) & (z.abs() <= 16)
    rig = parallel(36, {"pixels": [32, 32], "pixel_mm": 1 + nudge})
    rim = (x.square() + y.square() > 256) & (x.square() + y.square() < 260)  # between two angles
    assert torch.equal(common_field(rig, grid) & ~rim, field)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_a_fine_scan_takes_no_square_of_its_views(beam):
    """300 000 views: singular vectors of all views, 720 GB, were made and never used."""
    panel = {"pixels": [2, 96], "pixel_mm": 4.0, "offset_mm": [0.0, 100.0]}
    views = 300_000
    rig = circular(views, 400.0, 800.0, panel) if beam == "cone" else parallel(views, panel)
    assert (full_fan(rig).shape[1] > 96) is (beam == "cone")
    orbit = orbit_of(rig, Grid.centred(4, spacing=1.0))
    assert abs(abs(orbit.axis[2].item()) - 1) < 1e-9


@pytest.mark.parametrize("arc", [200.0, 220.0, 300.0])
@pytest.mark.parametrize("shape", ["square", "tall", "tilted", "offset"])
def test_a_detector_of_one_row_has_one_slice_that_all_of_its_views_see(arc, shape):
    """An arc's field is not centred on the isocentre; two slices would lie at the row's edges.

    Also tried: full turns of 9 views, whole and half fans.
    """
    pitch = [4.2 if shape == "tall" else 4.0, 4.0]
    offset = [0.0, 6.0 if shape == "offset" else 0.0]
    rig = circular(
        60, 400.0, 600.0, {"pixels": [1, 32], "pixel_mm": pitch, "offset_mm": offset}, arc
    )
    if shape == "tilted":
        errors = Misalignment.none(len(rig))
        errors.tilt_degrees[:, 2] = 1.5
        rig = misaligned(rig, errors)
    grid = auto_grid(rig)
    assert grid.shape[0] == 1 and grid.spacing == pytest.approx((400 / 600 * 4.0,) * 3, rel=1e-3)
    across = (voxel_centres(grid) - grid.centre).norm(dim=-1)
    assert sees(rig, voxel_centres(grid)[across < 20.0]).all()


def test_exactly_the_points_of_the_field_of_view_are_visible():
    rig = circular(8, 400.0, 800.0, PLATE)
    points = torch.tensor([[0.0, 0, 0], [0, 0, 63], [0, 0, 65], [-500, 0, 0]]).double()
    assert sees(rig, points).all(dim=0).tolist() == [True, True, False, False]
    assert not sees(rig, points)[0, 3]  # in line with the detector, but behind it


def test_the_common_field_of_dcspect80_contains_its_ball_and_little_more():
    """All 80 pinholes see the ball of 78.41 mm; on its surface one detector ends."""
    grid = Grid.centred(size=(44, 40, 36), spacing=5.0, centre=(3.0, -2.0, 1.0))
    away = voxel_centres(grid).norm(dim=-1)
    field = common_field(dcspect80(pixels=[16, 16]), grid)[0]
    assert field[away < 78.4].all() and not field[away > 125].any()
    assert not field[(78.4 < away) & (away < 85)].all()


def test_the_common_field_of_a_rotated_grid_is_visible_to_every_camera():
    rig = circular(5, 400.0, 800.0, {**PLATE, "offset_mm": [20.0, 30.0]})
    affine = Grid.centred(24, spacing=6.0).affine.clone()
    affine[:3] = (
        torch.cat([euler_rotation([10.0, 20.0, 30.0]).to(affine), AWAY[:, None] / 3], 1) @ affine
    )
    grid = Grid((24, 24, 24), affine)
    seen = sees(rig, voxel_centres(grid).reshape(-1, 3)).all(dim=0).reshape(1, 24, 24, 24)
    assert seen.any() and not seen.all() and torch.equal(common_field(rig, grid), seen)


def test_an_empty_common_field_is_refused():
    """A loss over the voxels that all cameras see is refused where there is none."""
    rig = circular(8, 400.0, 800.0, PLATE)
    with pytest.raises(ValueError, match="a voxel that all of 8 cameras see, got none"):
        common_field(rig, Grid.centred(4, spacing=1.0, centre=(0, 0, 70)))


def test_a_rig_that_misses_its_grid_is_refused():
    """A rig of which no view meets the grid is refused, with where both are in mm."""
    rig = circular(**OPTIONS["circular"])
    assert check_rig_sees(rig, Grid.centred(8, spacing=1.0)).all()
    with pytest.raises(ValueError, match="5 views that all miss it.*z 496 to 504 mm.*meet at"):
        check_rig_sees(rig, Grid.centred(8, spacing=1.0, centre=(0, 0, 500)))


def test_no_grid_is_chosen_without_a_field_of_view():
    """A grid is not guessed from one view, nor where views see nothing in common."""
    with pytest.raises(ValueError, match="at least two directions"):
        auto_grid(circular(1, 400.0, 800.0, PLATE))
    with pytest.raises(ValueError, match="voxels, the detector's shorter side, got 2 x 2 x 64"):
        auto_grid(circular(8, 400.0, 800.0, {**PLATE, "offset_mm": [0.0, 189.0]}))
    with pytest.raises(ValueError, match="to see the isocentre"):
        auto_grid(circular(8, 400.0, 800.0, {**PLATE, "offset_mm": [0.0, 300.0]}))


def test_parallel_beams_see_as_far_as_their_panel_is_wide():
    """Of pixels as the unit of length, say: 3000 columns of 1 mm. Also tried: 1400 columns, panels
    aside over a full turn, a stack of rows, whole and half of the views.
    """
    rig = parallel(6, {"pixels": [1, 3000], "pixel_mm": 1.0}, arc_degrees=180.0)
    assert auto_grid(rig, size=(100, 100, 1)).spacing[0] == pytest.approx(30.0, rel=0.16)
    assert sees(rig[[0]], torch.tensor([[1400.0, 0.0, 0.0], [-9000.0, 20.0, 0.0]])).all()
    short = parallel(6, {"pixels": [1, 3000], "pixel_mm": 1.0}, depth_mm=800.0)
    assert not sees(short[[0]], torch.tensor([[1400.0, 0.0, 0.0]])).any()
