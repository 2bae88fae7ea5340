"""Responses by the angle of incidence, and measured ones, against closed forms and Monte Carlo."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mvrecon.apps.config import absolute_paths
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.projector import Spect
from mvrecon_spect.operators.response import measured

LENGTH, FWHM = 70.0, 2 * math.sqrt(2 * math.log(2))
CRYSTAL = {"angles": True, "crystal_mm": 5.0, "attenuation_per_mm": 0.25}


def pinhole(pixels: int = 601, side: float = 120.0) -> Cameras:
    """A pinhole in the origin that looks along z, and a wide detector behind it."""
    pitch, exact = side / pixels, {"dtype": torch.float64}
    corner = -(pixels - 1) / 2 * pitch
    return Cameras(
        torch.zeros(1, 3, **exact),
        torch.tensor([[corner, corner, -LENGTH]], **exact),
        torch.tensor([[pitch, 0, 0]], **exact),
        torch.tensor([[0, pitch, 0]], **exact),
        (pixels, pixels),
        extent="behind",
    )


def image(degrees: float, depth: float, diameter: float = 2.3, **options):
    """Counts, mean along u in mm from the foot, and variances along u and v, of a point source."""
    grid = Grid.centred(
        1, spacing=0.02, centre=(-depth * math.tan(math.radians(degrees)), 0, depth)
    )
    camera = pinhole()
    y = Spect(grid, camera, diameter, blur=True, **options)(torch.ones(1, 1, 1, 1, 1).double())[
        0, 0, 0
    ]
    place = (torch.arange(len(y)) - (len(y) - 1) / 2).double() * camera.u.norm()
    moments = []
    for profile in (y.sum(dim=0), y.sum(dim=1)):
        mean = (profile * place).sum() / profile.sum()
        spread = (profile * (place - mean) ** 2).sum() / profile.sum() - camera.u.norm() ** 2 / 12
        moments += [mean.item(), spread.item()]
    return y.sum().item(), *moments


@pytest.mark.parametrize("degrees", [0.0, 12.0, 25.0, 35.0])
def test_photons_stop_in_the_crystal_as_in_a_monte_carlo(degrees):
    """Smear, shift and losses by the depth of interaction, over those of a thin crystal."""
    generator, tangent = torch.Generator().manual_seed(0), math.tan(math.radians(degrees))
    way = -torch.rand(2_000_000, generator=generator).double().log() / 0.25
    depth = way * math.cos(math.radians(degrees))
    stops = depth < 5
    normal = -torch.rand(2_000_000, generator=generator).double().log() / 0.25
    at = depth[stops] - normal[normal < 5].mean()
    thin, thick = image(degrees, 150.0), image(degrees, 150.0, response=CRYSTAL)
    assert thick[0] / thin[0] == pytest.approx(stops.double().mean().item(), rel=3e-3)
    assert thick[1] - thin[1] == pytest.approx(at.mean().item() * tangent, abs=0.01)
    assert thick[2] - thin[2] == pytest.approx(at.var().item() * tangent**2, abs=0.01)
    assert thick[4] == pytest.approx(thin[4], rel=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 35.0])
def test_an_oblique_ray_penetrates_the_rim_as_the_closed_form(degrees):
    """Half of the rays pass at d_re (Metzler & Accorsi); radially less than tangentially."""
    rim, opening = 1 / 2.0, 110.0
    edge = math.tan(math.radians(opening / 2))
    angle = math.radians(degrees)
    tangential = 2.3 + math.log(2) * rim * edge * math.cos(angle)
    radial = 2.3 + math.log(2) * rim * (edge - math.tan(angle) ** 2 / edge) * math.cos(angle)
    options = {"collimator_mu": 2.0, "opening_degrees": opening}
    response = {**CRYSTAL, "attenuation_per_mm": 100.0}  # stops photons at once
    _, _, u, _, v = image(degrees, 150.0, response=response, **options)
    m = LENGTH / 150
    assert math.sqrt(16 * v) == pytest.approx(tangential * (1 + m), rel=3e-3)
    assert math.sqrt(16 * u) == pytest.approx(radial * (1 + m), rel=5e-3)


@pytest.mark.parametrize("degrees", [0.0, 10.0, 19.5])
@pytest.mark.parametrize(("opening", "diameter"), [(40.0, 1.0), (40.0, 2.3), (44.0, 0.5)])
def test_angles_beyond_the_acceptance_change_no_efficiency(degrees, opening, diameter):
    """Of detectors whose corners are at 50 degrees, far beyond the cone of the edge."""
    rim, edge = math.tan(math.radians(opening / 2)) / 2.7, math.tan(math.radians(opening / 2))
    angle = math.radians(degrees)
    both = math.cos(angle) * (2 - math.tan(angle) ** 2 / edge**2)
    response = {**CRYSTAL, "attenuation_per_mm": 100.0}
    known = {"diameter": diameter, "response": response, "acceptance_degrees": 20.0}
    thick = image(degrees, 150.0, **known, collimator_mu=2.7, opening_degrees=opening)
    assert thick[0] / image(degrees, 150.0, **known)[0] == pytest.approx(
        (diameter + rim * both) / diameter, rel=1e-3
    )


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"opening_degrees": 50.0}, True),
        ({"opening_degrees": 50.0, "acceptance_degrees": 30.0}, True),
        ({"opening_degrees": 50.0, "acceptance_degrees": 25.0}, False),
        ({"opening_degrees": 60.0}, False),
        ({"opening_degrees": 50.0, "collimator_mu": None}, False),
    ],
    ids=str,
)
def test_voxels_beside_the_cone_of_the_edge_are_told(recwarn, options, told):
    """Of a grid that is seen up to 28 degrees from the axis, before detectors up to 50 degrees."""
    grid = Grid.centred(11, spacing=5.0, centre=(0, 0, 90))
    Spect(grid, pinhole(51), **{"collimator_mu": 3.0, **options})
    assert any("the edge blocks rays" in str(w.message) for w in recwarn) == told


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_measured_response_has_the_widths_of_its_table(tmp_path, encoding):
    """Rows from a known response; also at depths and angles between the rows. Excel marks UTF-8."""
    path = tmp_path / "psf.csv"

    def widths(depth, degrees):
        m, t = LENGTH / depth, math.tan(math.radians(degrees)) ** 2
        return 0.5 + 0.3 * (1 + m) ** 2, 0.5 + 0.3 * (1 + m) ** 2 + 1.7 * t

    rows = ["depth_mm,angle_degrees,fwhm_radial_mm,fwhm_tangential_mm,efficiency"]
    for depth in (100, 150, 220):
        for degrees in (0, 15, 30):
            v, u = widths(depth, degrees)
            share = 1 - 0.2 * math.tan(math.radians(degrees)) ** 2
            rows.append(f"{depth},{degrees},{FWHM * u**0.5},{FWHM * v**0.5},{share}")
    path.write_text("\n".join(rows), encoding=encoding)
    for depth, degrees in ((120.0, 0.0), (180.0, 22.0), (100.0, 30.0)):
        v, u = widths(depth, degrees)
        seen, thin = image(degrees, depth, response=path), image(degrees, depth)
        assert (seen[2], seen[4]) == pytest.approx((u, v), rel=5e-3)
        share = 1 - 0.2 * math.tan(math.radians(degrees)) ** 2
        assert seen[0] / thin[0] == pytest.approx(share, rel=1e-3)


def table(path: Path, *rows: tuple[float, ...], more: str = "") -> Path:
    """A table of depths, angles, and radial and tangential FWHM, and further columns."""
    head = f"depth_mm,angle_degrees,fwhm_radial_mm,fwhm_tangential_mm{more}"
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]))
    return path


@pytest.mark.parametrize("apart", [1e-5, 0.01, 0.5])
def test_depths_that_hardly_differ_make_no_slope(tmp_path, apart):
    """Of one source before many pinholes, whose depths and angles differ by rounding or by a
    little: widths, with noise, are those of one depth, at another depth as well.
    """
    noise = torch.randn(2, 20, generator=torch.Generator().manual_seed(0)) * 0.03
    rows = [
        (150 + apart * k / 20, apart * (k % 5), 3 + u, 3 + v)
        for k, (u, v) in enumerate(noise.T.tolist())
    ]
    path = table(tmp_path / "psf.csv", *rows)
    for depth in (120.0, 150.0, 185.0):
        _, _, u, _, v = image(0.0, depth, response=path)
        assert (FWHM * u**0.5, FWHM * v**0.5) == pytest.approx((3, 3), rel=0.02)


def test_a_table_of_one_angle_has_both_of_its_widths(tmp_path):
    """The radial one was taken to be the tangential one, unless there was another angle."""
    path = table(tmp_path / "psf.csv", (150, 25, 4.0, 3.0), (200, 25, 3.5, 2.5))
    for depth, radial, tangential in ((150.0, 4.0, 3.0), (200.0, 3.5, 2.5)):
        _, _, u, _, v = image(25.0, depth, response=path)
        assert (FWHM * u**0.5, FWHM * v**0.5) == pytest.approx((radial, tangential), rel=5e-3)


WIDE = Grid.centred(size=(60, 60, 2), spacing=5.0, centre=(0, 0, 120))


@pytest.mark.parametrize(
    ("rows", "more"),
    [
        ([(220, 0, 3, 3), (180, 0, 2, 2)], ""),  # a line through these is negative at 120 mm
        ([(300, 0, 3, 3, 1), (300, 10, 3, 3, 0.9), (300, 30, 3, 3, 0.1)], ",efficiency"),
    ],
)
def test_polynomials_have_fewer_terms_where_they_were_not_positive(tmp_path, rows, more):
    """In the whole field of the detector, whatever the noise of a table. Also tried: tables of
    noisy images of one source, of several and of a line, with and without a crystal.
    """
    response = measured(table(tmp_path / "psf.csv", *rows, more=more), Hole(), pinhole(41), WIDE)
    A = Spect(WIDE, pinhole(41), blur=True, response=tmp_path / "psf.csv")
    sharp = Spect(WIDE, pinhole(41))
    x = torch.zeros(1, 1, *WIDE.shape)
    x[..., 30, 45], x[..., 45, 45] = 1, 1  # on the edge of the field, and at its corner
    seen, thin = A(x)[0, 0, 0], sharp(x)[0, 0, 0]
    assert seen.isfinite().all() and seen.min() >= 0 and seen.sum() > 0.05 * thin.sum()
    assert response.detector[0] > 0 and seen.max() < 0.9 * thin.max()


def test_widths_that_end_beside_the_detector_make_no_nan(tmp_path):
    """Of voxels at up to 70 degrees, where the fitted variances are negative: gradients in poses,
    the reference and the compiled kernels.
    """
    rows = "100,0,4,4\n60,0,5,5\n100,20,3.6,3.2\n60,20,4.6,4.2\n"
    head = "depth_mm,angle_degrees,fwhm_radial_mm,fwhm_tangential_mm"
    (tmp_path / "psf.csv").write_text(f"{head}\n{rows}")
    grid, rig = Grid.centred(size=(10, 30, 30), spacing=5.0, centre=(0, 0, 60)), pinhole(24, 48.0)
    options = {"blur": True, "response": tmp_path / "psf.csv"}
    x = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(0)).double()
    y = Spect(grid, rig, 2.3, **options)(x)
    moving = replace(rig, source=rig.source.clone().requires_grad_())
    z = Spect(grid, moving, 2.3, **options)(x)
    torch.testing.assert_close(z.detach(), y)
    z.square().sum().backward()
    assert moving.source.grad.isfinite().all() and moving.source.grad.any()


@pytest.mark.parametrize("angle", [12.5, 15.0, 17.0, 20.0])
def test_rounding_does_not_decide_the_terms_of_a_response(tmp_path, angle):
    """Two depths at one angle off the axis determine the radial variances there alone, which then
    differ from the tangential ones by tan^2: not by a rank that the last bit of an angle decides.
    """
    grid, rig, hole = Grid.centred(9, spacing=2.0, centre=(0, 0, 80)), pinhole(24, 48.0), Hole(2.3)
    values = []
    for _ in range(12):
        rows = [(100, 0, 4, 4), (60, 0, 5, 5), (100, angle, 3.6, 3.2), (60, angle, 4.6, 4.2)]
        values.append(measured(table(tmp_path / "psf.csv", *rows), hole, rig, grid).values)
        angle = math.nextafter(angle, 90)
    values = torch.tensor(values)
    torch.testing.assert_close(values, values[:1].expand_as(values), rtol=1e-9, atol=1e-9)
    response = measured(tmp_path / "psf.csv", hole, rig, grid)
    assert not any(response.radial[2:])
    for depth, difference in ((100, 3.6**2 - 3.2**2), (60, 4.6**2 - 4.2**2)):
        radial = response.radial[0] + response.radial[1] * LENGTH / depth
        tangent2 = math.tan(math.radians(angle)) ** 2
        assert radial * tangent2 * FWHM**2 == pytest.approx(difference, rel=1e-9)


@pytest.mark.parametrize("efficiency", [-1.0, 0.0, math.nan, math.inf])
def test_tables_without_a_positive_fit_are_refused(tmp_path, efficiency):
    path = table(tmp_path / "psf.csv", (120, 0, 3, 3, efficiency), more=",efficiency")
    with pytest.raises(ValueError, match="expected (positive efficiencies|finite, positive mm)"):
        Spect(WIDE, pinhole(41), blur=True, response=path)
    narrow = table(tmp_path / "narrow.csv", (120, 0, 3, 3), (120, 20, 2, 3))  # none at 50 degrees
    with pytest.raises(ValueError, match="expected positive widths"):
        Spect(WIDE, pinhole(41), blur=True, response=narrow)


def test_a_grid_far_beyond_the_depths_of_a_table_is_told(tmp_path, recwarn):
    path = table(tmp_path / "psf.csv", (140, 0, 3, 3), (180, 0, 2.8, 2.8))
    for depth, told in ((130, False), (150, False), (200, False), (90, True), (260, True)):
        recwarn.clear()
        grid = Grid.centred(2, spacing=1.0, centre=(0, 0, depth))
        Spect(grid, pinhole(9), 2.3, blur=True, response=path)
        assert any("are extrapolated" in str(w.message) for w in recwarn) is told


def test_efficiencies_are_those_of_the_hole_of_their_law(tmp_path):
    """The area of another hole, or of one with penetration, is refused. Also tried: rectangles."""
    area = math.pi * 3.0**2 / 4
    path = table(tmp_path / "psf.csv", (150, 0, 3, 3, 0.8, area), more=",efficiency,area_mm2")
    seen, thin = image(0.0, 150.0, 3.0, response=path), image(0.0, 150.0, 3.0)
    assert seen[0] / thin[0] == pytest.approx(0.8, rel=1e-6)
    for diameter, edge in ((2.3, {}), (3.0, {"collimator_mu": 3.0}), ((3.0, 3.0), {})):
        with pytest.raises(ValueError, match="expected the hole of its efficiencies"):
            image(0.0, 150.0, diameter, response=path, **edge)


@pytest.mark.parametrize(
    ("response", "told"),
    [
        ("none", "'geometric' or a table"),
        ({"angles": True}, "crystal_mm"),
        ({**CRYSTAL, "crystal_mm": -1.0}, "positive crystal_mm"),
        ({**CRYSTAL, "attenuation_per_mm": 0.0}, "positive attenuation_per_mm"),
    ],
)
def test_impossible_responses_are_refused(response, told):
    with pytest.raises(ValueError, match=told):
        image(0.0, 150.0, response=response)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("depth_mm,fwhm_mm\n1,2", "expected a table of"),
        ("", "expected a table of"),
        ("depth_mm,angle_degrees,fwhm_radial_mm,fwhm_tangential_mm\n1,0,x,1", "expected numbers"),
        ("depth_mm,angle_degrees,fwhm_radial_mm,fwhm_tangential_mm\n-1,0,1,1", "positive mm"),
    ],
)
def test_impossible_tables_are_refused(tmp_path, text, told):
    (tmp_path / "psf.csv").write_text(text)
    with pytest.raises(ValueError, match=told):
        image(0.0, 150.0, response=tmp_path / "psf.csv")


def test_a_response_needs_blur():
    with pytest.raises(ValueError, match="blur=True"):
        Spect(Grid.centred(4, spacing=2.0, centre=(0, 0, 100)), pinhole(9), response=CRYSTAL)


def test_the_word_geometric_is_no_path_and_a_table_is_one():
    for response, found in (
        ("geometric", "geometric"),
        ("a.csv", str(Path("a.csv").absolute())),
    ):
        projector = {"name": "spect", "blur": True, "response": response}
        settings = absolute_paths({"projector": projector}, ReconstructSettings)
        assert settings["projector"]["response"] == found
