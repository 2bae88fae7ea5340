"""The circle of the sources is worked out of the cameras; rigs that have none are refused."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.field import auto_grid, full_fan
from mvrecon.geometry.cameras.rigs import circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.methods.classical.fdk import fbp, fdk
from mvrecon.methods.classical.orbit import orbit_of
from mvrecon.methods.classical.redundancy import redundancy_weights
from mvrecon.operators.drr import Drr
from mvrecon.operators.operator import Scaled
from mvrecon.operators.radon import Radon
from tests.methods.classical.filtered.scans import (
    CONES,
    FAN,
    FANS,
    LINE,
    RAYS,
    SLICE,
    VALUE,
    VOLUME,
    cylinder,
    views_of,
)


def test_axis_isocentre_and_radius_are_those_of_the_scanner():
    turn, shift = euler_rotation([10.0, 30.0, 5.0]), torch.tensor([7.0, 80.0, -9.0]).double()
    rig = circular(40, 400.0, 600.0, FAN, arc_degrees=200.0).moved(turn, shift)
    orbit = orbit_of(rig, SLICE)
    assert orbit.radius == pytest.approx(400.0)
    assert torch.allclose(orbit.centre, shift)
    assert (orbit.axis @ turn[:, 2]).abs().item() == pytest.approx(1.0)
    steps = orbit.angles.diff().remainder(360.0)
    assert torch.allclose(torch.minimum(steps, 360 - steps), torch.full((39,), 5.0).double())


def test_jittered_sources_have_their_mean_circle():
    torch.manual_seed(0)
    rig = CONES["full"]
    shaken = replace(rig, source=rig.source + torch.randn_like(rig.source))
    orbit = orbit_of(shaken, VOLUME)
    assert orbit.radius == pytest.approx(400.0, abs=0.5)
    assert orbit.centre.norm() < 0.5 and orbit.axis[2].abs() > 0.99999


def test_repeated_views_share_their_weights():
    twice = FANS["full"][list(range(240)) * 2]
    once, both = redundancy_weights(FANS["full"], SLICE), redundancy_weights(twice, SLICE)
    assert torch.allclose(both.weights[:240] + both.weights[240:], once.weights)
    assert once.weights.sum().item() == pytest.approx(torch.pi)


SPHERE = dome(20, 300.0, 200.0, 180.0, {"pixels": [8, 8], "pixel_mm": 9.0})
SIDEWAYS = replace(FANS["full"], u=FANS["full"].v, v=-FANS["full"].u, shape=(100, 1))
REFUSED = {
    "dome": (fdk, SPHERE, "sources on a circle, .* use sirt"),
    "80 pinholes": (
        fdk,
        dcspect80(pixels=[4, 4]),
        "sources on a circle, .* 80 sources .* use sirt",
    ),
    "two": (fdk, CONES["full"][:2], "at least three sources on a circle, got 2"),
    "short of fan": (fdk, CONES["full"][:50], "% of the lines .* are not measured"),
    "limited": (fbp, parallel(60, LINE, arc_degrees=120.0, **RAYS), "33.3% of the lines"),
    "two close": (
        fbp,
        parallel(2, LINE, arc_degrees=20.0, **RAYS),
        "of the lines .* are not measured",
    ),
    "one": (fbp, parallel(1, LINE, **RAYS), "two directions at least, got 1 views"),
    "cone": (fbp, CONES["full"], "got a cone beam of 32 rows; use fdk"),
    "beside": (
        fdk,
        circular(60, 400.0, 600.0, {**FAN, "offset_mm": [0.0, 120.0]}),
        "the axis of rotation is projected",
    ),
    "rows along the axis": (fdk, SIDEWAYS, "exchange rows and columns"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_rig_without_a_rotation_axis_is_refused(kind: str):
    """A rig that FBP or FDK is not made for is refused with the reason, and with what will do."""
    method, rig, message = REFUSED[kind]
    A = (Radon if rig.parallel else Drr)(VOLUME, rig)
    with pytest.raises(ValueError, match=message):
        method(A, torch.zeros(1, 1, *A.range_shape))


def test_weighted_integrals_views_with_nan_and_unknown_scans_are_refused():
    """FDK refuses weighted operators, and views that are not finite or too few."""
    A = Drr(VOLUME, CONES["full"])
    views = torch.zeros(1, 1, *A.range_shape)
    spoilt = views.clone()
    spoilt[0, 0, 5, 1, 2] = torch.nan
    with pytest.raises(ValueError, match="needs plain line integrals"):
        fdk(Scaled(A, torch.full(A.range_shape, 2.0)), views)
    with pytest.raises(ValueError, match="Expected views"):
        fdk(A, views[:, :, :-1])
    with pytest.raises(ValueError, match="got 1 of"):
        fdk(A, spoilt)
    with pytest.raises(ValueError, match="Expected weights_from as a rig of 120 views"):
        fdk(A, views, weights_from=CONES["short"])
    with pytest.raises(ValueError, match="of floating point"):
        fdk(A, views.int())


@pytest.mark.parametrize("height", [60.0, 150.0])
def test_tilted_rays_lose_the_cosine_of_their_tilt_and_this_is_said(height: float):
    """Laminography of a ball: the sources are above it, and the detectors below."""
    rig = circular(90, 400.0, 600.0, {"pixels": [64, 64], "pixel_mm": 3.0})
    up = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    tilted = replace(rig, source=rig.source + up, origin=rig.origin - up / 2)
    grid = Grid.centred(16, spacing=4.0)
    size = torch.full((1, 3), 25.0)
    ball = Solids("ellipsoid", torch.zeros(1, 3), torch.eye(3)[None], size, torch.ones(1))
    loss = 1 - 400 / math.hypot(400, height)
    with pytest.warns(UserWarning, match=f"compact objects {loss:.1%} low"):
        x = fdk(Drr(grid, tilted), views_of(Phantom((ball,)), tilted))
    assert x[0, 0, 6:10, 6:10, 6:10].mean().item() == pytest.approx(1 - loss, abs=0.01)


def test_voxels_beside_the_common_slab_of_a_helix_are_named():
    """Sources rise by 36 mm in a turn; a long cylinder reads low where views miss its rays."""
    rig = CONES["full"]
    up = torch.linspace(-18.0, 18.0, len(rig), dtype=torch.float64)[:, None] * torch.eye(3)[2]
    helix = replace(rig, source=rig.source + up, origin=rig.origin + up)
    tall = Grid.centred(size=(24, 24, 24), spacing=4.4)
    with pytest.warns(UserWarning, match="above or below the rows .* by up to .*0%"):
        x = fdk(Drr(tall, helix), views_of(cylinder(), helix))
    assert x[0, 0, 12, 12, 12] == pytest.approx(VALUE, rel=0.01)
    assert x[0, 0, -1, 12, 12] < 0.7 * VALUE


SHORT_CONES = {
    "whole turn": ({}, {}),
    "raised": ({"offset_mm": [20.0, 0.0]}, {}),
    "half fan": ({"offset_mm": [0.0, 100.0]}, {}),
    "short scan": ({}, {"arc_degrees": 250.0}),
}


@pytest.mark.parametrize("kind", SHORT_CONES)
def test_an_automatic_grid_warns_of_its_rows_where_the_object_extends_beyond_them(kind: str):
    """A box as high as the field at the isocentre has voxels that rows of near sources do not
    reach, but every object that all views see whole: a ball that touches the field keeps its value
    to its top without a warning, a long cylinder is read low there, and this is said.
    """
    panel, arc = SHORT_CONES[kind]
    plate = {"pixels": [24, 48], "pixel_mm": 10.0} | panel
    rig = circular(90, 400.0, 800.0, plate, **arc)
    grid = auto_grid(full_fan(rig))
    reach = plate.get("offset_mm", [0.0])[0]
    radius = 0.95 * 400 * math.sin(math.atan((120 - abs(reach)) / 800))
    size, turn = torch.full((1, 3), radius), torch.eye(3)[None]
    ball = Solids("ellipsoid", torch.zeros(1, 3), turn, size, torch.tensor([VALUE]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        x = fdk(Drr(grid, rig), views_of(Phantom((ball,)), rig))[0, 0]
    centres = voxel_centres(grid)
    top = (centres.norm(dim=-1) < 0.9 * radius) & (centres[..., 2].abs() > 0.6 * radius)
    assert x[top].mean().item() == pytest.approx(VALUE, rel=0.04)
    with pytest.warns(UserWarning, match="above or below the rows .* extends beyond these rows"):
        x = fdk(Drr(grid, rig), views_of(cylinder(height=600.0), rig))[0, 0]


@pytest.mark.parametrize(
    ("part", "beyond"),
    [
        (("ellipsoid", (90.0, 0.0, 55.0), (12.0, 12.0, 12.0), VALUE), True),
        (("cylinder", (80.0, 0.0, 0.0), (8.0, 8.0, 200.0), VALUE), True),
        (("cylinder", (60.0, 0.0, 0.0), (20.0, 20.0, 200.0), VALUE / 5), True),
        (("ellipsoid", (90.0, 0.0, 0.0), (12.0, 12.0, 12.0), VALUE), False),
        (("ellipsoid", (60.0, 0.0, 20.0), (5.0, 5.0, 5.0), 3 * VALUE), False),
    ],
)
@pytest.mark.parametrize(
    "flat",
    [
        0.0,
        0.02,
        torch.linspace(0.05, 0.0, 90)[:, None, None],
        torch.linspace(0.05, 0.0, 96),
        torch.linspace(0.02, 0.07, 96),
    ],
)
def test_a_part_beyond_the_rows_of_some_views_is_named_beside_a_body_within_them(
    part, beyond, flat
):
    """A small or weak part beside a body, which other views see within their rows; a flat
    field that is off by 2 %, or that drifts by 5 % over views or columns, is no such part, also of
    a body that absorbs little. Also tried: parts at 30 to 60 mm, drifts that grow, that swing, and
    over rows.
    """
    rig = circular(90, 400.0, 800.0, {"pixels": [48, 96], "pixel_mm": 5.0})
    shape, at, size, value = part
    turn = torch.eye(3)[None]
    body = Solids(
        "ellipsoid", torch.zeros(1, 3), turn, torch.full((1, 3), 45.0), torch.tensor([VALUE])
    )
    other = Solids(shape, torch.tensor([at]), turn, torch.tensor([size]), torch.tensor([value]))
    grid = auto_grid(full_fan(rig))
    for scale in (1.0, 0.2) if isinstance(flat, float) and flat else (1.0,):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fdk(Drr(grid, rig), scale * views_of(Phantom((body, other)), rig) + flat)
        assert any("above or below the rows" in str(one.message) for one in caught) == beyond


@pytest.mark.parametrize("photons", [30.0, 100.0, 1000.0])
@pytest.mark.parametrize("beyond", [False, True])
def test_noise_of_few_photons_is_no_part_beyond_the_rows(photons, beyond):
    """In none of four series of random numbers; a body that is so high is named in all."""
    rig = circular(60, 200.0, 300.0, {"pixels": [24, 48], "pixel_mm": 1.6})
    size, at, turn = torch.full((1, 3), 6.0), torch.tensor([[3.0, -2.0, 0.0]]), torch.eye(3)[None]
    if beyond:
        size[0, 2] = 60.0
    body = Solids("ellipsoid", at, turn, size, torch.tensor([VALUE]))
    light = photons * (-views_of(Phantom((body,)), rig)).exp()
    grid = Grid.centred(size=(24, 24, 40), spacing=2.0)
    for seed in range(4):
        counts = torch.poisson(light, torch.Generator().manual_seed(seed)).clamp(min=0.5)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fdk(Drr(grid, rig), -(counts / photons).log())
        assert any("above or below the rows" in str(one.message) for one in caught) == beyond


@pytest.mark.parametrize("views", [12, 90])
@pytest.mark.parametrize("noise", [0.01, 0.03, 0.1])
def test_noise_is_no_object_beyond_the_rows_and_hides_none(views, noise):
    """Noise of up to twice the greatest line integral of a ball that all views see whole. Also
    tried: Poisson noise of 30 to 1e5 photons, and balls of a twentieth of the value.
    """
    rig = circular(views, 400.0, 800.0, {"pixels": [48, 96], "pixel_mm": 5.0})
    grid, turn = auto_grid(rig), torch.eye(3)[None]
    size, value = torch.full((1, 3), 45.0), torch.tensor([noise / 180.0])
    ball = Phantom((Solids("ellipsoid", torch.zeros(1, 3), turn, size, value),))
    for seed in range(3):
        noisy = noise * torch.randn(1, 1, views, 48, 96, generator=generator(seed, views))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "Too few views")  # for other reasons
            fdk(Drr(grid, rig), views_of(ball, rig) + noisy)
    long = views_of(cylinder(height=600.0), rig)
    with pytest.warns(UserWarning, match="above or below the rows"):
        fdk(Drr(grid, rig), long + long.max() / 20 * noisy / noise)


@pytest.mark.parametrize("kind", ["fan", "parallel"])
def test_rolled_detectors_keep_a_cylinder_and_magnify_a_ball_and_this_is_said(kind: str):
    """Rows at 12 degrees against the plane of the sources, for cone and parallel beams alike."""
    panel, roll = {"pixels": [64, 64], "pixel_mm": 3.0}, math.radians(12.0)
    rig = (
        circular(90, 400.0, 600.0, panel)
        if kind == "fan"
        else parallel(90, panel | {"pixel_mm": 2.0}, **RAYS)
    )
    u = math.cos(roll) * rig.u + math.sin(roll) * rig.v
    v = math.cos(roll) * rig.v - math.sin(roll) * rig.u
    origin = rig.detector_centre - u * (rig.shape[1] - 1) / 2 - v * (rig.shape[0] - 1) / 2
    shift = origin - rig.origin
    source = rig.source + shift if rig.parallel else rig.source
    rolled = replace(rig, origin=origin, source=source, u=u, v=v)
    grid = Grid.centred(16, spacing=4.0)
    method, A = (fbp, Radon(grid, rolled)) if rig.parallel else (fdk, Drr(grid, rolled))
    size = torch.full((1, 3), 25.0)
    ball = Phantom(
        (Solids("ellipsoid", torch.zeros(1, 3), torch.eye(3)[None], size, torch.ones(1)),)
    )
    gain = 1 / math.cos(roll) - 1
    with pytest.warns(UserWarning, match=f"compact objects {gain:.1%} high"):
        x = method(A, views_of(ball, rolled))
        y = method(A, views_of(cylinder(), rolled))
    assert x[0, 0, 6:10, 6:10, 6:10].mean().item() == pytest.approx(1 + gain, abs=5e-3)
    assert y[0, 0, 6:10, 6:10, 6:10].mean().item() == pytest.approx(VALUE, rel=5e-3)


@pytest.mark.parametrize("way", ["rolled", "tilted"])
@pytest.mark.parametrize("degrees", [3.0, 6.0])
def test_flat_objects_read_higher_by_rolled_rows_and_lower_by_tilted_rays(way: str, degrees: float):
    """Ellipsoids five times as wide as high, in the warning's closed forms; also tried: 1, 2.5 and
    5 times, 1 to 12 degrees, parallel beams. A compact object's error alone, 0.1 to 0.5 %, used to
    give no warning.
    """
    rig = circular(90, 400.0, 600.0, {"pixels": [64, 64], "pixel_mm": 2.4})
    axis = rig.u if way == "tilted" else torch.linalg.cross(rig.u, rig.v)
    x, y, z = torch.nn.functional.normalize(axis, dim=1).unbind(dim=1)
    o = torch.zeros_like(x)
    about = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).view(-1, 3, 3)
    R = torch.linalg.matrix_exp(math.radians(degrees) * about)
    names = ("source", "origin", "u", "v")
    rig = replace(rig, **{name: (R @ getattr(rig, name)[..., None])[..., 0] for name in names})
    slope = 5 * math.tan(math.radians(degrees))
    expected = (1 + slope**2) ** (0.5 if way == "rolled" else -0.5) - 1
    size = torch.tensor([[35.0, 35.0, 7.0]])
    flat = Solids("ellipsoid", torch.zeros(1, 3), torch.eye(3)[None], size, torch.ones(1))
    grid = Grid.centred(size=(24, 24, 1), spacing=(2.0, 2.0, 1.0))
    with pytest.warns(UserWarning, match=f"5 times as wide as high {abs(expected):.0%}"):
        x = fdk(Drr(grid, rig), views_of(Phantom((flat,)), rig))
    assert x[0, 0, 0, 8:16, 8:16].mean().item() - 1 == pytest.approx(expected, abs=0.012)


@pytest.mark.parametrize("kind", ["fan", "parallel"])
@pytest.mark.parametrize("rows", [1, 2, 5])
def test_slices_up_to_the_edge_of_the_outermost_rows_keep_their_value(kind: str, rows: int):
    """Slices thinner than the rows; the outermost ones read 4 to 42 % low. Beyond the rows, as of a
    rolled row, a warning is given, also of single rows (up to 90 % low without one).
    """
    panel = {"pixels": [rows, 100], "pixel_mm": 1.5 if kind == "fan" else 1.2}
    rig = circular(180, 400.0, 600.0, panel) if kind == "fan" else parallel(90, panel, **RAYS)
    method, operator = (fdk, Drr) if kind == "fan" else (fbp, Radon)
    height = rows * (1.0 if kind == "fan" else 1.2)
    grid = Grid.centred(size=(24, 24, 8), spacing=(2.0, 2.0, height / 8))
    ball = replace(cylinder(20.0).parts[0], centres=torch.zeros(1, 3))
    x = method(operator(grid, rig), views_of(Phantom((ball,)), rig))
    assert (x[0, 0, :, 9:15, 9:15] / VALUE - 1).abs().max() < 0.01
    tall = Grid.centred(size=(24, 24, 8), spacing=(2.0, 2.0, height / 5))
    with pytest.warns(UserWarning, match="above or below the rows"):
        method(operator(tall, rig), views_of(Phantom((ball,)), rig))
