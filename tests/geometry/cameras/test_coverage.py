"""How much of a grid a rig sees, and detectors fitted to a grid."""

import math
import re
import warnings

import pytest
import torch

import mvrecon as mv
from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.coverage import (
    check_coverage,
    coverage,
    covering_pixels,
    fit_detector,
    fitted,
)
from mvrecon.geometry.cameras.field import auto_grid, full_fan, half_fan, sees
from mvrecon.geometry.cameras.formats import rtk_xml
from mvrecon.geometry.cameras.rigs import arc, circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid, voxel_centres

PLATE = {"pixels": [48, 48], "pixel_mm": 5.5}
PATIENT = {"size": [64, 64, 64], "spacing": 6.0}
HALF = {"pixels": [48, 96], "pixel_mm": 4.0, "offset_mm": [0.0, 130.0]}


def test_shares_are_those_of_the_voxels_that_parallel_beams_see():
    """Beams along x and y on a square of half the grid's width see a square cross of it: together
    a quarter of its area, both a half of its edge, in half of its height; in closed form.
    """
    grid = Grid.centred(32, spacing=1.0)
    rig = parallel(2, {"pixels": [16, 16], "pixel_mm": 1.0})
    shares = coverage(rig, grid)
    assert shares.every == pytest.approx(0.5**3)
    assert shares.half == pytest.approx(0.5 * 0.75) and shares.none == pytest.approx(1 - 0.375)


@pytest.mark.parametrize("every", [2, 3, 7])
def test_views_that_miss_the_grid_count_wherever_they_are_in_the_order(every):
    """Every second of 130 views, or every third or seventh, has its detector aside."""
    grid, plate = Grid.centred(16, spacing=1.0), {"pixels": [40, 40], "pixel_mm": 1.0}
    rig = circular(130, 200.0, 300.0, plate)
    aside = torch.zeros(130, 2, dtype=torch.float64)
    aside[::every] = 500.0
    shares = coverage(rig.shifted(aside), grid)
    assert (coverage(rig, grid).every, shares.every, shares.none) == (1.0, 0.0, 0.0)
    assert shares.half == 1.0


def test_shares_of_a_body_weigh_its_mass():
    grid = Grid.centred(32, spacing=1.0)
    rig = parallel(2, {"pixels": [16, 16], "pixel_mm": 1.0})
    body = torch.zeros(grid.shape)
    body[15:17, 15:17, 15:17], body[0, 0, 0] = 1.0, 8.0
    assert coverage(rig, grid, body).every == pytest.approx(0.5)
    assert coverage(rig, grid, body).none == pytest.approx(0.5)


def test_a_field_of_a_third_of_the_grid_is_reported_with_the_detector_that_would_do():
    """The default rig, of a field of 132 mm, for a patient's grid of 384 mm. As many pixels of the
    named pitch, and the named number of pixels, see the whole inscribed cylinder.
    """
    rig, grid = circular(12, 400.0, 800.0, PLATE, arc_degrees=180.0), Grid.centred(**PATIENT)
    seen = sees(rig, voxel_centres(grid).reshape(-1, 3)).sum(dim=0)
    exact = [(seen == 12).double().mean().item(), (seen == 0).double().mean().item()]
    shares = coverage(rig, grid)
    assert [shares.every, shares.none] == pytest.approx(exact, abs=0.005)
    with pytest.warns(UserWarning, match=f"{shares.none:.1%} by none") as told:
        check_coverage(rig, grid)
    assert "269 x 160 pixels" in str(told[0].message) and "30.9 x 30.9" in str(told[0].message)
    for plate in ({**PLATE, "pixels": [269, 160]}, {**PLATE, "pixel_mm": 30.9}):
        check_silent(circular(12, 400.0, 800.0, plate, arc_degrees=180.0), grid)


def test_the_extent_of_a_cylinder_in_cone_beams_is_the_textbook_one():
    """Of a cylinder of the radius r and half height h about the axis: sdd tan(asin(r / sid)) to the
    side, and sdd h / (sid - r) up and down.
    """
    grid = Grid.centred(size=[20, 20, 10], spacing=10.0)
    rig = circular(180, 400.0, 800.0, {"pixels": [40, 60], "pixel_mm": [2.0, 3.0]})
    v, u = covering_pixels(rig, grid)
    assert u == pytest.approx(2 * 800 * math.tan(math.asin(100 / 400)) / 3.0, rel=2e-3)
    assert v == pytest.approx(2 * 800 * 50 / (400 - 100) / 2.0, rel=2e-3)


def check_silent(rig, grid, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_coverage(rig, grid, **options)


@pytest.mark.parametrize(
    ("rig", "grid"),
    [
        (circular(8, 400.0, 800.0, PLATE, arc_degrees=180.0), Grid.centred(32, spacing=4.0)),
        (arc(9, 400.0, 800.0, PLATE, arc_degrees=60.0), Grid.centred(32, spacing=4.0)),
        (parallel(32, {**PLATE, "pixel_mm": 4.0}), Grid.centred(32, spacing=4.0)),
        (dcspect80(pixels=[16, 16]), Grid.centred(64, spacing=2.5)),
        (dome(16, 200.0, 70.0, 180.0, {**PLATE, "pixel_mm": 1.0}), Grid.centred(32, spacing=4.0)),
        (FAN := circular(90, 400.0, 800.0, HALF), auto_grid(FAN, seen_by=0.5)),
    ],
)
def test_usual_rigs_are_not_warned_of(rig, grid):
    """Corners outside the field, few angles, pinholes that each see a part, a half fan."""
    check_silent(rig, grid)


def test_a_helical_scan_is_not_warned_of():
    """Each voxel is seen by a small share of the views, but all by about as many."""
    turns, count = 4, 160
    rigs = circular(count, 400.0, 800.0, PLATE, arc_degrees=360.0 * turns)
    rise = torch.linspace(-260.0, 260.0, count, dtype=torch.float64)[:, None]
    up = torch.cat([torch.zeros(count, 2, dtype=torch.float64), rise], dim=1)
    rig = type(rigs)(rigs.source + up, rigs.origin + up, rigs.u, rigs.v, rigs.shape)
    grid = Grid.centred(size=[30, 30, 100], spacing=4.0)
    assert coverage(rig, grid).half < 0.1
    check_silent(rig, grid)


def test_a_body_outside_of_the_field_is_warned_of_in_a_grid_that_is_well_seen():
    grid = Grid.centred(32, spacing=4.0)
    body = torch.zeros(grid.shape)
    body[:2] = body[-2:] = 1.0  # at both ends of the axis, of which the field is cut to a cone
    rig = circular(8, 400.0, 800.0, {**PLATE, "pixels": [42, 48]})
    check_silent(rig, grid)
    with pytest.warns(UserWarning, match="mass of the first 1 case"):
        check_coverage(rig, grid, bodies=[body])


def test_no_fitted_detector_is_advised_where_none_sees_the_grid():
    """A grid beside the source's circle: the advice was to choose a detector that there is not."""
    grid = Grid.centred(16, spacing=4.0, centre=(400.0, 0.0, 0.0))
    with pytest.warns(UserWarning, match="No detector of this rig sees") as told:
        check_coverage(circular(8, 400.0, 800.0, PLATE), grid)
    assert "=fit" not in str(told[0].message)


RIGS = {
    "circular": {"n_views": 12, "sid": 1000.0, "sdd": 1500.0},
    "arc": {"n_views": 7, "sid": 1000.0, "sdd": 1500.0, "arc_degrees": 120.0},
    "parallel": {"n_views": 12},
    "dome": {"n_views": 16, "radius": 500.0, "focal": 70.0, "aperture_degrees": 160.0},
}


@pytest.mark.pairwise(
    name=RIGS,
    detector=[
        {"pixels": [48, 40], "pixel_mm": "fit"},
        {"pixels": 48, "pixel_mm": "fit", "offset_mm": [0.0, 25.0]},
        {"pixels": "fit", "pixel_mm": [5.5, 4.0]},
        "fit",
    ],
)
def test_a_fitted_detector_sees_the_inscribed_cylinder_and_hardly_more(name, detector):
    """On a grid of unequal sides: as many pixels as given see it, at a pitch at most 1 % too
    wide; or the fewest pixels do.
    """
    box = {"size": [48, 40, 56], "spacing": [6.0, 8.0, 5.0]}
    made = fitted({"name": name, **RIGS[name], "detector": detector}, box)
    rig, grid = CAMERAS.from_config(made), Grid.centred(**box)
    index = voxel_centres(grid) / (torch.tensor(grid.size) * torch.tensor(grid.spacing) / 2)
    inside = index[..., :2].square().sum(-1) <= 1
    assert sees(rig, voxel_centres(grid)[inside]).all()
    needed = covering_pixels(rig, grid)
    if detector != "fit" and detector["pixel_mm"] == "fit":
        assert 0.99 < max(n / m for n, m in zip(needed, rig.shape, strict=True)) <= 1
        exact = fit_detector(rig, grid)
        ratios = zip(covering_pixels(exact, grid), exact.shape, strict=True)
        assert max(n / m for n, m in ratios) == pytest.approx(1)
        assert torch.allclose(exact.detector_centre, rig.detector_centre)
    else:
        assert rig.shape == tuple(math.ceil(n - 1e-6) for n in needed)
    check_silent(rig, grid)


def test_detector_fit_has_pixels_of_a_voxel_at_the_centre():
    made = fitted({"name": "circular", **RIGS["circular"], "detector": "fit"}, PATIENT)
    assert made["detector"]["pixel_mm"] == pytest.approx(6.0 * 1.5)


@pytest.mark.parametrize("name", RIGS)
def test_one_slice_is_fitted_by_a_fan(name):
    """One row of pixels as wide as a voxel, or as tall as a thicker slice takes on its axis, and
    the whole slice of cameras that look down on it. A grid of two slices is a cone's.
    """
    box = {"size": [48, 40, 1], "spacing": 6.0}
    made = fitted({"name": name, **RIGS[name], "detector": "fit"}, box)
    rig, centres = CAMERAS.from_config(made), voxel_centres(Grid.centred(**box))
    inside = (centres[..., :2] / torch.tensor([144.0, 120.0])).square().sum(-1) <= 1
    assert sees(rig, centres[inside]).all()
    assert rig.shape[0] > 20 if name == "dome" else rig.shape[0] == 1
    thick = {**box, "spacing": [6.0, 6.0, 30.0]}
    made = fitted({"name": name, **RIGS[name], "detector": "fit"}, thick)
    assert name == "dome" or made["detector"]["pixels"][0] == 5
    made = fitted({"name": name, **RIGS[name], "detector": "fit"}, {**box, "size": [48, 40, 2]})
    assert name == "dome" or made["detector"]["pixels"][0] == (2 if name == "parallel" else 3)


def test_a_source_inside_of_the_grid_has_no_fitting_detector():
    camera = {"name": "circular", "n_views": 8, "sid": 150.0, "sdd": 900.0, "detector": "fit"}
    with pytest.raises(ValueError, match="behind the source"):
        fitted(camera, PATIENT)


def test_rigs_from_files_take_a_fitted_detector_where_it_does_not_move_them(tmp_path):
    """A table of angles and RTK's geometry; not matrices, which have each pixel in its place."""
    rig = circular(12, 1000.0, 1500.0, {"pixels": [48, 48], "pixel_mm": 10.0})
    rtk_xml.write(rig, tmp_path / "rig.xml", "IEC")
    (tmp_path / "rig.csv").write_text("angle_degrees\n" + "\n".join(map(str, range(0, 360, 30))))
    rows = rig.matrix.reshape(-1, 4).tolist()
    (tmp_path / "rig.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    table = {"name": "angles", "path": f"{tmp_path}/rig.csv", "sid_mm": 1000.0, "sdd_mm": 1500.0}
    xml = {"name": "rtk_xml", "path": f"{tmp_path}/rig.xml", "world": "IEC"}
    for camera in (table, xml):
        made = fitted({**camera, "detector": {"pixels": 48, "pixel_mm": "fit"}}, PATIENT)
        expected = fitted({"name": "circular", **RIGS["circular"], "detector": "fit"}, PATIENT)
        assert made["detector"]["pixel_mm"] == 14.9
        assert fitted({**camera, "detector": "fit"}, PATIENT)["detector"] == expected["detector"]
    with pytest.raises(ValueError, match="pixel_mm of the detector of the camera 'matrices'"):
        camera = {"name": "matrices", "path": f"{tmp_path}/rig.txt"}
        fitted({**camera, "detector": {"pixels": 48, "pixel_mm": "fit"}}, PATIENT)


def half_fans(angles, make, *lengths):
    """Half fans, or half acquisitions of parallel beams, at these angles."""
    return make(len(angles), *lengths, detector=HALF, angles=angles)


#: Angles of complete turns that are not even: exposures, exactly repeated or by a coarse encoder,
#: clusters, lost neighbours, both ends of the turn; and of arcs.
TURN = [2.0 * k for k in range(180)]
AROUND = {
    "exposures": [a for a in TURN for _ in range(4)],
    "encoder": [a + 0.01 * k for a in TURN for k in range(3)],
    "clusters": [6.0 * k + 0.4 * n for k in range(60) for n in range(5)],
    "lost": TURN[:50] + TURN[54:],
    "both ends": [*TURN, 360.0],
    "turns": [3.0 * k for k in range(300)],
    "fine": [0.045 * k for k in range(8000)],
    "fine, lost": [0.045 * k for k in range(8000) if not 1000 < k < 1200],
}
ARCS = {
    "fine over 340": [0.045 * k for k in range(7556)],
    "340 degrees": TURN[:171],
    "exposures over 220": [a for a in TURN[:111] for _ in range(4)],
}


@pytest.mark.parametrize("beam", [(circular, 400.0, 800.0), (parallel,)])
@pytest.mark.parametrize("name", [*AROUND, *ARCS])
def test_a_half_fan_covers_all_directions_however_uneven(name, beam):
    """The complete field is that of an even turn. Also tried: 8 to 24 directions, one measured
    each time once to five times.
    """
    rig, whole = half_fans({**AROUND, **ARCS}[name], *beam), half_fans(TURN, *beam)
    assert half_fan(rig) == (name in AROUND)
    if name in AROUND:
        grid, expected = (auto_grid(full_fan(each)) for each in (rig, whole))
        assert grid.size == pytest.approx(expected.size, abs=1)


@pytest.mark.parametrize(
    ("rig", "expected"),
    [
        (circular(90, 400.0, 800.0, HALF), True),
        (circular(90, 400.0, 800.0, {**HALF, "offset_mm": [0.0, -130.0]}), True),
        (parallel(90, HALF, arc_degrees=360.0), True),
        (circular(90, 400.0, 800.0, {**HALF, "offset_mm": [0.0, 8.0]}), False),
        (circular(90, 400.0, 800.0, HALF, arc_degrees=200.0), False),
        (circular(90, 400.0, 800.0, {**PLATE, "offset_mm": [60.0, 0.0]}), False),
        (circular(90, 400.0, 800.0, PLATE), False),
        (dcspect80(pixels=[16, 16]), False),
    ],
)
def test_a_half_fan_is_an_offset_detector_all_around(rig, expected):
    assert half_fan(rig) == expected
    turned = rig.moved(torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), torch.ones(3))
    assert half_fan(turned) == expected


@pytest.mark.parametrize("rows", [1, 24, 25])
@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_rays_beside_the_middle_of_a_single_slice_are_named(rows, beam):
    """Joseph's rays through the face between two slices have half of a single slice's integral, by
    the length of its chord; at the centre that the warning names they have all of it.
    """
    grid = mv.Grid.centred(size=(16, 16, 1), spacing=1.6)
    panel = {"pixels": [rows, 24], "pixel_mm": 3.2 if beam == "cone" else 1.6}
    rig = mv.circular(1, 400.0, 800.0, panel) if beam == "cone" else mv.parallel(1, panel)

    def share(grid):
        A = mv.Drr(grid, rig) if beam == "cone" else mv.Radon(grid, rig)
        return A(torch.ones(1, 1, *grid.shape)).amax().item() / (16 * 1.6)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_coverage(rig, grid)
    texts = [str(one.message) for one in caught if "one slice" in str(one.message)]
    assert len(texts) == (rows == 24)
    assert share(grid) == pytest.approx(0.5 if texts else 1.0, abs=0.02)
    for text in texts:
        place = [float(x) for x in re.search(r"centre \[(.*?)\]", text)[1].split(",")]
        assert share(mv.Grid.centred(size=(16, 16, 1), spacing=1.6, centre=place)) > 0.98
