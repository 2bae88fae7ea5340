import math

import pytest
import torch
from omegaconf import OmegaConf

from mvrecon.apps.config import conf_dir, to_plain
from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.rigs import Detector, arc, circular, dome, parallel, sinogram_rig
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation
from tests.geometry.cameras.rigs import DETECTOR, OPTIONS, same

CENTRE = torch.tensor([4.0, 2.5], dtype=torch.float64)  # (u, v) of the middle of 6 x 9 pixels
OFFSET = {**DETECTOR, "offset_mm": [5.0, -7.0]}


def azimuth(cameras):
    return torch.rad2deg(torch.atan2(cameras.source[:, 1], cameras.source[:, 0])) % 360


def doubles(*values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("name", ["circular", "arc", "dome", "dcspect80", "parallel"])
def test_the_target_is_seen_in_the_middle_of_the_detector(name):
    options = OPTIONS[name] | ({} if name == "dcspect80" else {"detector": DETECTOR})
    uvz = CAMERAS.build(name, **options).project(torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(uvz[:, :2], CENTRE.expand(len(uvz), 2), rtol=0, atol=1e-10)


def test_a_shifted_detector_shows_the_target_shifted_in_the_opposite_direction():
    cameras = circular(
        5, 400.0, 800.0, OFFSET
    )  # 5 mm down, 7 mm to the left, of pixels 2 mm high and 3 mm wide
    uv = cameras.project(torch.zeros(3, dtype=torch.float64))[:, :2]
    torch.testing.assert_close(
        uv, (CENTRE + doubles(7 / 3, -5 / 2)).expand(5, 2), rtol=0, atol=1e-10
    )


def test_cone_beam_magnifies_by_sdd_over_sid():
    cameras = circular(6, 400.0, 1000.0, DETECTOR)
    up = cameras.project(doubles(0, 0, 10))
    torch.testing.assert_close(
        up[:, 1], CENTRE[1] - torch.full((6,), 10 * 1000 / 400 / 2.0, dtype=torch.float64)
    )
    torch.testing.assert_close(up[:, 2], torch.full((6,), 400.0, dtype=torch.float64))


def test_a_pinhole_scales_by_focal_over_distance_and_inverts_its_image():
    cameras = dome(9, 200.0, 50.0, 120.0, DETECTOR, target=(1.0, 2.0, 3.0))
    across = cameras.u / 3.0 * 10  # 10 mm to the camera's right
    uvz = torch.stack(
        [one.project(doubles(1, 2, 3) + a)[0] for one, a in zip(cameras, across, strict=True)]
    )
    torch.testing.assert_close(
        uvz[:, 0], CENTRE[0] - torch.full((9,), 10 * 50 / 200 / 3.0, dtype=torch.float64)
    )
    torch.testing.assert_close(uvz[:, 2], torch.full((9,), -200.0, dtype=torch.float64))


def test_a_circle_runs_counter_clockwise_without_repeated_views():
    torch.testing.assert_close(
        azimuth(circular(4, 400.0, 800.0, DETECTOR, start_degrees=10.0)), doubles(10, 100, 190, 280)
    )
    half = circular(4, 400.0, 800.0, DETECTOR, arc_degrees=180.0)
    torch.testing.assert_close(azimuth(half), doubles(0, 45, 90, 135))
    torch.testing.assert_close(
        azimuth(circular(2, 400.0, 800.0, DETECTOR, angles=[7.0, 300.0])), doubles(7, 300)
    )
    torch.testing.assert_close(
        half.source.norm(dim=-1), torch.full((4,), 400.0, dtype=torch.float64)
    )


def test_the_first_camera_of_a_circle_is_on_x_with_rows_along_y():
    first = circular(4, 400.0, 800.0, DETECTOR)[0]
    for name, vector in {
        "source": (400, 0, 0),
        "u": (0, 3, 0),
        "v": (0, 0, -2),
        "origin": (-400, -12, 5),
    }.items():
        torch.testing.assert_close(getattr(first, name), doubles(vector), rtol=0, atol=1e-12)


def test_an_arc_has_a_camera_at_both_ends():
    torch.testing.assert_close(
        azimuth(arc(4, 400.0, 800.0, DETECTOR, 90.0, 45.0)), doubles(45, 75, 105, 135)
    )
    assert same(arc(1, 400.0, 800.0, DETECTOR), circular(1, 400.0, 800.0, DETECTOR))
    with pytest.raises(ValueError, match="ends of an arc of 360.0 degrees are one camera"):
        arc(8, 400.0, 800.0, DETECTOR, 360.0)


def test_parallel_rays_are_parallel_and_perpendicular_to_the_detector():
    cameras = parallel(4, DETECTOR, depth_mm=300.0)
    start, end = cameras.rays()
    ray = end - start
    torch.testing.assert_close(ray, ray[:, :1, :1].expand_as(ray), rtol=0, atol=1e-10)
    a = torch.deg2rad(doubles(0, 45, 90, 135))
    outwards = torch.stack([a.cos(), a.sin(), 0 * a], dim=-1)
    torch.testing.assert_close(ray[:, 0, 0], -300 * outwards, rtol=0, atol=1e-10)
    torch.testing.assert_close(
        ((start + end) / 2 * outwards[:, None, None]).sum(-1), 0 * start[..., 0], rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("name", ["circular", "arc", "dome", "dcspect80"])
def test_central_rays_leave_the_source(name):
    cameras = CAMERAS.build(name, **OPTIONS[name])
    start, end = cameras.rays()
    torch.testing.assert_close(
        start, cameras.source[:, None, None].expand_as(start), rtol=0, atol=0
    )
    torch.testing.assert_close(
        cameras.project(end[0])[0, ..., 2].flatten(), cameras.distance[0].expand(54)
    )


def test_a_dome_covers_a_sphere_evenly():
    target = doubles(1, 2, 3)
    cameras = dome(500, 200.0, 50.0, 360.0, DETECTOR, target=(1.0, 2.0, 3.0))
    outwards = (cameras.source - target) / 200
    torch.testing.assert_close(outwards.norm(dim=-1), torch.ones(500, dtype=torch.float64))
    assert outwards.mean(dim=0).norm() < 0.01  # even over the sphere: first and second moments
    torch.testing.assert_close(
        outwards.mT @ outwards / 500, torch.eye(3, dtype=torch.float64) / 3, rtol=0, atol=0.01
    )
    nearest = (outwards @ outwards.T - 2 * torch.eye(500)).amax(dim=0).arccos()
    assert nearest.min() > 0.6 * nearest.max()  # no clusters
    cap = dome(100, 200.0, 50.0, 60.0, DETECTOR).source / 200
    assert cap[:, 2].min() > math.cos(math.radians(30)) and cap[:, 2].min() < math.cos(
        math.radians(29)
    )


@pytest.mark.parametrize(("extent", "side"), [("behind", 1), ("segment", -1), ("ahead", -1)])
def test_the_extent_of_a_dome_determines_the_side_of_its_detector(extent, side):
    cameras = dome(5, 200.0, 50.0, 90.0, DETECTOR, extent=extent)
    middle = cameras.origin + 4 * cameras.u + 2.5 * cameras.v
    torch.testing.assert_close(middle, cameras.source * (1 + side * 50 / 200), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_views": 0}, "n_views must be positive, got 0"),
        ({"sid": -1.0}, "sid must be positive, got -1.0"),
        ({"sdd": math.nan}, "sdd must be positive, got nan"),
        ({"sdd": 300.0}, "sdd > sid, got sdd 300.0 and sid 400.0"),
        ({"angles": [0.0, 1.0]}, "rig of 5 views needs 5 angles, got 2"),
        (
            {"detector": {"pixels": [6, 0], "pixel_mm": 1.0}},
            r"positive whole pixels .* got pixels \(6, 0\)",
        ),
        ({"detector": {"pixels": [6.5, 2], "pixel_mm": 1.0}}, "positive whole pixels"),
        (
            {"detector": {"pixels": 6, "pixel_mm": -1.0}},
            r"positive pixel_mm, .* pixel_mm \(-1.0, -1.0\)",
        ),
        (
            {"detector": {"pixels": [6, 6, 6], "pixel_mm": 1.0}},
            r"pixels must be one number or two .* got \[6, 6, 6\]",
        ),
        (
            {"detector": {"pixels": 6, "pixel_mm": "1"}},
            "pixel_mm must be one number or two .* got '1'",
        ),
        (
            {"detector": {"pixels": 6, "pixel_mm": 1.0, "offset_mm": [0, math.inf]}},
            "offset_mm must be one number or two",
        ),
    ],
)
def test_invalid_numbers_are_refused(options, message):
    """A rig given by numbers that make no sense is refused, with the number and its range."""
    with pytest.raises(ValueError, match=message):
        CAMERAS.build("circular", **(OPTIONS["circular"] | options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"pixels": 6, "pixel": 1.0},
            "no option 'pixel'; did you mean 'pixels'. Known: offset_mm, pixel_mm, pixels",
        ),
        ({"pixels": 6}, "needs pixel_mm, got only"),
        (6, "must be a mapping of pixels, pixel_mm, offset_mm, got 6"),
    ],
)
def test_invalid_detector_options_are_named(options, message):
    with pytest.raises(TypeError, match=message.replace("?", r"\?")):
        Detector.of(options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"aperture_degrees": 400.0}, "at most 360"),
        ({"radius": 0.0}, "radius"),
        ({"focal": -5.0}, "focal"),
    ],
)
def test_invalid_domes_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        CAMERAS.build("dome", **(OPTIONS["dome"] | options))


@pytest.mark.parametrize("name", sorted(OPTIONS))
def test_the_shipped_settings_see_a_ball_of_50_mm_about_the_origin(name):
    settings = to_plain(OmegaConf.load(conf_dir() / "camera" / f"{name}.yaml"))  # type: ignore[arg-type]
    cameras = CAMERAS.from_config(settings)
    directions = torch.randn(
        200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    uvz = cameras.project(50 * torch.nn.functional.normalize(directions, dim=-1))
    rows, columns = cameras.shape
    assert (uvz[..., :2] > -0.5).all() and (uvz[..., :2] < doubles(columns, rows) - 0.5).all()
    least, most = (w * cameras.distance[:, None] for w in cameras.ray_extent)
    assert (uvz[..., 2] > least).all() and (uvz[..., 2] < most).all()


@pytest.mark.parametrize(("width", "height", "mm"), [(30, 40, 1.0), (60, 80, 0.1), (50, 120, 0.3)])
def test_rounding_adds_no_column_to_the_diagonal_of_a_slice(width, height, mm):
    """Of slices whose diagonal is a whole number of voxels, however the grid is turned."""
    grid, columns = Grid.centred(size=(width, height, 2), spacing=mm), math.hypot(width, height)
    for turn in range(0, 90, 7):
        R = euler_rotation([float(turn), 20.0, -turn / 2])
        assert sinogram_rig(grid.moved(R, torch.zeros(3)), 8).shape == (2, columns)
