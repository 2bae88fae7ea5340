"""The response of a pinhole and its detector to a point source, as data.

The image of a point at the depth h in front of the pinhole, with the detector at the distance l
behind it, has three independent parts: the image of the hole, of the width d (1 + m) with m = l /
h; the detector's resolution; and the depth at which photons stop in the crystal, which smears
images along the tangent of the angle to the axis.
"""

import csv
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import text_of
from mvrecon.core.registry import check_options
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_spect.kernels.reference import COLUMNS
from mvrecon_spect.operators.hole import Hole

#: FWHM of a Gaussian in standard deviations.
FWHM = 2 * math.sqrt(2 * math.log(2))


@dataclass(frozen=True)
class Response:
    """Response by the magnification m = l / h and t = 1 - cos of the angle to the axis.

    Polynomials have coefficients of 1, m, m^2, t, t m, t m^2, or of powers of t.

    Args:
        width_u, width_v: squared widths of the hole's image in mm^2.
        detector: variance in mm^2, along both axes.
        radial: further variance in mm^2 per squared tangent along an axis.
        shift: displacement in mm per tangent along an axis, by 1, t.
        efficiency: counts per photon that passes the hole, by 1, t, t^2.
    """

    width_u: tuple[float, ...] = (0.0,) * 6
    width_v: tuple[float, ...] = (0.0,) * 6
    detector: tuple[float, ...] = (0.0,) * 6
    radial: tuple[float, ...] = (0.0,) * 6
    shift: tuple[float, ...] = (0.0, 0.0)
    efficiency: tuple[float, ...] = (1.0, 0.0, 0.0)

    @property
    def values(self) -> list[float]:
        """All coefficients, in the order of a rig's record."""
        parts = self.width_u, self.width_v, self.detector, self.radial, self.shift, self.efficiency
        return [value for part in parts for value in part]


ResponseOption = Literal["geometric"] | str | Path | Mapping[str, Any]

#: Angles at which parts of a response are evaluated, between the axis and a detector's corner.
ANGLES = 33
#: Least difference of magnifications, relative to the greatest, and of angles in degrees, for a
#: further term of a table's polynomials.
MIN_STEP, MIN_STEP_DEGREES = 0.05, 3.0
#: Least singular value of a fit's terms, relative to the greatest, far above rounding.
MIN_SINGULAR = 1e-9
#: Ratio of a grid's magnifications to those of a table from which a warning is given.
MAX_EXTRAPOLATION = 1.25
#: Points along each axis of a grid where a table's polynomials are evaluated.
GRID_POINTS = 9
#: Columns of a table of a measured response.
TABLE = ("depth_mm", "angle_degrees", "fwhm_radial_mm", "fwhm_tangential_mm")
OPTIONAL = ("distance_mm", "efficiency", "area_mm2")
#: Relative difference of a hole's area in a table and by its diameter, for rounding.
MAX_AREA_DIFFERENCE = 0.01


def response_of(
    option: ResponseOption,
    hole: Hole,
    cameras: Cameras,
    grid: Grid,
    blur: bool = True,
    intrinsic_mm: float = 0.0,
) -> Response:
    """The response of a hole and its detector; sharp without blur.

    Args:
        option: "geometric": the hole's image and the intrinsic resolution, at normal incidence;
            the options of `oblique`, `{angles: true, crystal_mm: .., attenuation_per_mm: ..}`; or
            the path of a table, see `measured`.
        hole: a pinhole with its penetration.
        cameras: the pinholes.
        grid: voxels for which a table needs a response.
        blur: whether the response blurs.
        intrinsic_mm: FWHM of the detector's intrinsic resolution.

    Raises:
        TypeError: unknown options.
        ValueError: an unknown or impossible response, or one without blur.
    """
    if not 0 <= intrinsic_mm < float("inf"):
        raise ValueError(f"Expected an intrinsic FWHM of 0 mm or more, got {intrinsic_mm}")
    if not blur and (intrinsic_mm or option != "geometric"):
        got = f"{intrinsic_mm} mm and blur=False" if intrinsic_mm else f"response={option!r}"
        raise ValueError(f"Expected blur=True with an intrinsic FWHM or a response, got {got}")
    if not blur:
        return Response()
    if option == "geometric":
        return geometric(hole, intrinsic_mm)
    if isinstance(option, Mapping):
        known = ("angles", "crystal_mm", "attenuation_per_mm")
        check_options("The response of a crystal", option, known)
        own = {name: value for name, value in option.items() if name != "angles"}
        if option.get("angles") is not True or len(own) != 2:
            raise ValueError(
                f"Expected the response {{angles: true, crystal_mm: .., attenuation_per_mm: ..}}, "
                f"got {dict(option)}"
            )
        return oblique(hole, cameras, intrinsic_mm, **own)
    if Path(option).suffix != ".csv":
        raise ValueError(f"Expected the response 'geometric' or a table .csv, got {str(option)!r}")
    if intrinsic_mm:
        raise ValueError(
            f"Expected no intrinsic FWHM with a measured response, which contains it, got "
            f"{intrinsic_mm} mm"
        )
    return measured(Path(option), hole, cameras, grid)


def geometric(hole: Hole, intrinsic_mm: float) -> Response:
    """Hole and intrinsic resolution (FWHM) at normal incidence."""
    widths = [(d * d, 2 * d * d, d * d, 0.0, 0.0, 0.0) for d in hole.blurring_mm]
    detector = ((intrinsic_mm / FWHM) ** 2, 0.0, 0.0, 0.0, 0.0, 0.0)
    return Response(*widths, detector=detector)


def oblique(
    hole: Hole, cameras: Cameras, intrinsic_mm: float, crystal_mm: float, attenuation_per_mm: float
) -> Response:
    """Hole and crystal by the angle of incidence.

    Photons stop in the crystal at exponentially distributed depths, which smears and shifts images
    radially; those that pass it are lost. The rim of a knife edge is penetrated less at oblique
    incidence: by tan(a / 2) cos / mu tangentially and by (1 - tan^2 / tan^2(a / 2)) times this
    radially (Metzler & Accorsi, Phys. Med. Biol. 50 (2005) 5005). A thin hole has a round image at
    any angle. Parts are fitted by polynomials in 1 - cos, to the corners of the detectors or the
    acceptance angle.

    Convention: the detector's plane of `Cameras` is at the mean depth of normal incidence.

    Args:
        hole: a pinhole with its penetration.
        cameras: their corners limit the angles.
        intrinsic_mm: FWHM of the detector's intrinsic resolution.
        crystal_mm: thickness of the crystal.
        attenuation_per_mm: its linear attenuation.

    Raises:
        ValueError: a thickness or attenuation that is not positive and finite.
    """
    for name, value in (("crystal_mm", crystal_mm), ("attenuation_per_mm", attenuation_per_mm)):
        if not 0 < value < math.inf:
            raise ValueError(f"Expected a positive {name}, got {value}")
    t = torch.linspace(0, 1 - _least_cosine(cameras, hole), ANGLES, dtype=torch.float64)
    cosine = 1 - t
    tangent2 = 1 / cosine**2 - 1
    rate = attenuation_per_mm / cosine
    stopped = -torch.expm1(-rate * crystal_mm)
    passed = 1 - stopped
    depth = 1 / rate - crystal_mm * passed / stopped
    spread = 1 / rate**2 - crystal_mm**2 * passed / stopped**2
    edge = math.tan(math.radians(hole.opening_degrees) / 2) ** 2
    along = (1 - tangent2 / edge).clamp_min(0) if hole.rim else torch.ones_like(t)
    more = 2 * hole.rim**2 * cosine**2 * along if hole.sensitivity == "paix" else 0.0
    area, widths, radial = torch.ones_like(t), [], []
    for d in hole.sides:
        squared = d * (d + hole.rim * cosine * (1 + along)) + more
        area = area * (squared / squared[0]).sqrt()
        image = d + math.log(2) * hole.rim * cosine
        narrower = math.log(2) * hole.rim * cosine * (along - 1)  # radially
        widths.append(_polynomial(t, image**2, 2))
        radial.append((2 * image + narrower) * narrower / tangent2.clamp_min(1e-9))
    smaller = _polynomial(t[1:], (radial[0] + radial[1])[1:] / (32 if hole.round else 24), 2)
    smear = _polynomial(t, spread, 2)
    hidden = smaller.tolist()
    both = [
        hidden[0] + smear[0].item(), 2 * hidden[0], hidden[0],
        hidden[1] + smear[1].item(), 2 * hidden[1], hidden[1],
    ]  # fmt: skip
    images = [tuple(factor * c for c in width.tolist() for factor in (1, 2, 1)) for width in widths]
    return Response(
        *images,
        detector=((intrinsic_mm / FWHM) ** 2, 0.0, 0.0, 0.0, 0.0, 0.0),
        radial=tuple(both),
        shift=tuple(_polynomial(t, depth - depth[0], 2).tolist()),
        efficiency=tuple(_polynomial(t, stopped * area, 3).tolist()),
    )


def _least_cosine(cameras: Cameras, hole: Hole) -> float:
    """Cosine of the greatest angle between the axis and a pixel that the hole accepts."""
    start, end = cameras.rays()
    away = (end - start).detach().norm(dim=-1).amax(dim=(1, 2))
    least = (cameras.distance.detach() / away).min().item()
    return min(max(least, hole.least_cosine), 1 - 1e-6)


def _powers(t: Float[Tensor, " n"], count: int) -> Float[Tensor, "n k"]:
    """1, t, .. of each value."""
    return torch.stack([t**n for n in range(count)], dim=1)


def _terms(m: Float[Tensor, " n"], t: Float[Tensor, " n"]) -> Float[Tensor, "n 6"]:
    """1, m, m^2, t, t m, t m^2 of each point, as in `Response`."""
    return torch.cat([_powers(m, 3), t[:, None] * _powers(m, 3)], dim=1)


def _least_squares(rows: Float[Tensor, "n k"], values: Float[Tensor, " n"]) -> Float[Tensor, " k"]:
    """Coefficients of the columns that fit values best."""
    return torch.linalg.lstsq(rows, values[:, None], rcond=MIN_SINGULAR).solution[:, 0]


def _polynomial(t: Tensor, values: Tensor, terms: int) -> Tensor:
    """Coefficients of 1, t, .. that fit values best."""
    return _least_squares(_powers(t, terms), values)


def _read_table(path: Path, cameras: Cameras) -> dict[str, Float[Tensor, " n"]]:
    """The columns of a table of a measured response, with `distance_mm`; see `measured`.

    Raises:
        ValueError: missing or unknown columns, impossible values, or several distances.
    """
    rows = list(csv.DictReader(text_of(path).splitlines()))
    names = set(rows[0]) if rows else set()
    if not set(TABLE) <= names <= {*TABLE, *OPTIONAL}:
        known, got = ", ".join((*TABLE, *OPTIONAL)), ", ".join(sorted(names))
        raise ValueError(f"{path}: expected a table of {known}, got {got}")
    try:
        columns = {
            name: torch.tensor([float(row[name]) for row in rows], dtype=torch.float64)
            for name in names
        }
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected numbers in all columns, got {error}") from error
    if "distance_mm" not in names:
        lengths = cameras.distance.detach()
        if (lengths - lengths[0]).abs().max() > 1e-3 * lengths[0]:
            raise ValueError(
                f"{path}: expected cameras with one distance from hole to detector, or distance_mm "
                f"in the table"
            )
        columns["distance_mm"] = lengths[0].expand(len(rows))
    finite = all(column.isfinite().all() for column in columns.values())
    in_mm = [name for name in (*TABLE, "distance_mm") if name.endswith("mm")]
    positive = all((columns[name] > 0).all() for name in in_mm)
    if not (finite and positive and (columns["angle_degrees"].abs() < 90).all()):
        raise ValueError(f"{path}: expected finite, positive mm, and angles below 90 degrees")
    return columns


def measured(path: Path, hole: Hole, cameras: Cameras, grid: Grid) -> Response:
    """A response from widths of the images of point sources, of Gaussian shape.

    Variances are fitted in l / depth and 1 - cos, by as many terms as there are depths and angles
    that differ by `MIN_STEP` and `MIN_STEP_DEGREES`, at most three and two; by fewer terms where a
    fit is not positive at all voxels in a detector's field. Sources off the axis alone determine
    how radial variances differ from tangential ones.

    Args:
        path: a table with a row for each source: its distance `depth_mm` from the hole's plane and
            `angle_degrees` from the axis, and `fwhm_radial_mm` and `fwhm_tangential_mm` of its
            image on the detector. Optional: `efficiency`, counts over those of the law for a hole
            of `area_mm2`; and `distance_mm` l from hole to detector, if the cameras have several.
        hole: the hole of the operator, whose area is compared with the table's.
        cameras: a rig with one distance from hole to detector, unless the table has it.
        grid: voxels for which the response must be positive.

    Raises:
        ValueError: missing or unknown columns, impossible values, several distances, efficiencies
            of another hole, or no fit with positive widths and efficiencies at all voxels in a
            detector's field.

    Warns:
        UserWarning: voxels far beyond the table's depths.
    """
    columns = _read_table(path, cameras)
    for area in set(columns.get("area_mm2", torch.empty(0)).tolist()):
        if not abs(area / hole.area_mm2 - 1) <= MAX_AREA_DIFFERENCE:
            raise ValueError(
                f"{path}: expected the hole of its efficiencies, of {area:g} mm^2 "
                f"({math.sqrt(4 * area / math.pi):.3g} mm wide if round), got one of "
                f"{hole.area_mm2:.4g} mm^2 with its penetration; set the diameter, and no "
                f"collimator_mu, which measured efficiencies contain"
            )
    depth, angle, radial, tangential = (columns[name] for name in TABLE)
    m, cosine = columns["distance_mm"] / depth, torch.deg2rad(angle).cos()
    t, tangent2 = 1 - cosine, 1 / cosine**2 - 1
    terms, field = _terms(m, t), seen_points(cameras, grid)
    _warn_of_depths(path, m, field.terms[:, 1])

    def distinct(some: Bool[Tensor, " n"]) -> tuple[int, int]:
        """The number of depths and of angles of some of the sources."""
        depths = _distinct(m[some], MIN_STEP * m.max().item())
        return depths, _distinct(angle[some].abs(), MIN_STEP_DEGREES)

    # on the axis, radial is no direction
    off_axis = angle.abs() >= MIN_STEP_DEGREES
    depths, angles = distinct(torch.ones_like(off_axis))
    radial_depths, radial_angles = distinct(off_axis)

    def widths(orders: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Coefficients of variances by so many terms of the depth and of the angle."""
        detector, smear = torch.zeros(2, 6, dtype=torch.float64)
        used = _first_terms(*orders)
        detector[used] = _least_squares(terms[:, used], (tangential / FWHM) ** 2)
        if off_axis.any():
            used = _first_terms(min(orders[0], radial_depths), min(orders[1], radial_angles))
            rows = (terms[:, used] * tangent2[:, None])[off_axis]
            difference = (radial**2 - tangential**2)[off_axis] / FWHM**2
            smear[used] = _least_squares(rows, difference)
        return detector, smear

    orders = product(range(min(depths, 3), 0, -1), range(min(angles, 2), 0, -1))
    fits = map(widths, sorted(orders, key=sum, reverse=True))
    detector, smear = _first_positive(path, "widths", fits, lambda fit: field.variances(*fit))
    efficiency = torch.tensor([1.0, 0.0, 0.0])
    if (values := columns.get("efficiency")) is not None:
        counts = range(min(angles, 3), 0, -1)
        fits = (F.pad(_polynomial(t, values, count), (0, 3 - count)) for count in counts)
        efficiency = _first_positive(path, "efficiencies", fits, field.efficiencies)
    return Response(
        detector=tuple(detector.tolist()),
        radial=tuple(smear.tolist()),
        efficiency=tuple(efficiency.tolist()),
    )


def _first_terms(depths: int, angles: int) -> list[int]:
    """Places in `_terms` of so many powers of the magnification, by so many of 1 - cos."""
    return [3 * j + i for j in range(angles) for i in range(depths)]


def _distinct(values: Float[Tensor, " n"], least: float) -> int:
    """The number of values, from the lowest up, that differ by so much from the one before."""
    count, last = 0, -math.inf
    for value in values.sort().values.tolist():
        if value - last >= least:
            count, last = count + 1, value
    return count


class SeenPoints(NamedTuple):
    """Points of a grid in the field of a detector.

    Args:
        terms: 1, m, m^2, t, t m, t m^2 of each point.
        tangents2: squared tangents of its angle along u and v.
    """

    terms: Float[Tensor, "p 6"]
    tangents2: Float[Tensor, "p 2"]

    def variances(self, detector: Tensor, radial: Tensor) -> Float[Tensor, "p 2"]:
        """Variances along u and v in mm^2."""
        terms = self.terms.to(detector)
        return (terms @ detector)[:, None] + (terms @ radial)[:, None] * self.tangents2

    def efficiencies(self, coefficients: Float[Tensor, "3"]) -> Float[Tensor, " p"]:
        """Counts per photon that passes the hole, by the coefficients of 1, t, t^2."""
        t = self.terms[:, 3]
        return _powers(t, 3) @ coefficients.to(t)


def seen_points(cameras: Cameras, grid: Grid) -> SeenPoints:
    """The points of a grid that a detector sees, one for each pinhole that images it."""
    axes = [torch.linspace(0, n - 1, GRID_POINTS, dtype=torch.float64) for n in grid.size]
    images = cameras.project(grid.to_world(torch.cartesian_prod(*axes)).to(cameras.source))
    pixels, length = images.detach()[..., :2], cameras.distance.detach()[:, None]
    end = pixels.new_tensor(cameras.shape[::-1]) - 0.5
    seen = (images[..., 2] < 0) & ((pixels > -0.5) & (pixels < end)).all(dim=-1)
    steps = torch.stack([cameras.u, cameras.v], dim=1).detach()
    beam = pixels @ steps + (cameras.origin - cameras.source).detach()[:, None]
    tangents = beam @ (steps / steps.norm(dim=-1, keepdim=True)).mT / length[..., None]
    m = (-length / images.detach()[..., 2])[seen]
    t = (1 - length / beam.norm(dim=-1))[seen]
    return SeenPoints(_terms(m, t), tangents[seen] ** 2)


def _warn_of_depths(path: Path, known: Float[Tensor, " n"], asked: Float[Tensor, " p"]) -> None:
    """Warn about a grid far beyond the magnifications of a table."""
    if not asked.numel():
        return
    (low, high), (least, most) = known.aminmax(), asked.aminmax()
    if most > MAX_EXTRAPOLATION * high or MAX_EXTRAPOLATION * least < low:
        warnings.warn(
            f"{path}: expected sources at the depths of the grid, of magnifications l / depth of "
            f"{least:.3g} to {most:.3g}, got {low:.3g} to {high:.3g}; widths are extrapolated",
            stacklevel=4,
        )


def _first_positive(
    path: Path, what: str, fits: Iterable[Any], values_of: Callable[[Any], Tensor]
) -> Any:
    """The first of several fits with positive values in the whole field.

    Raises:
        ValueError: there is none.
    """
    for fit in fits:
        if (values_of(fit) > 0).all():
            return fit
    raise ValueError(
        f"{path}: expected positive {what} of all voxels in the detectors' fields, got others by "
        f"each fit of the table; add sources at their depths and angles, or make the grid smaller"
    )


def record_of(
    cameras: Cameras, grid: Grid, hole: Hole, response: Response | Float[Tensor, " p"]
) -> Float[Tensor, "m c"]:
    """The record of each pinhole, see `mvrecon_spect.kernels.reference`; differentiable
    in the cameras, and in the response if it is given as `Response.values`.
    """
    fixed = isinstance(response, Response)
    values = cameras.source.new_tensor(response.values) if fixed else response
    affine = grid.affine.to(cameras.source)
    inverse = torch.linalg.inv(cameras.frame)
    rows = inverse @ affine[:3]
    offset = (inverse @ cameras.source[..., None]) * rows.new_tensor([0.0, 0.0, 0.0, 1.0])
    rows = rows - offset  # of w u, w v, w
    u, v, beam, length = cameras.u, cameras.v, cameras.origin - cameras.source, cameras.distance
    normal = torch.linalg.cross(u, v)
    normal = normal / normal.norm(dim=1, keepdim=True)
    foot = _dot(beam, normal)[:, None] * normal - beam
    products = [_dot(beam, beam), 2 * _dot(u, beam), 2 * _dot(v, beam)]
    products += [_dot(u, u), 2 * _dot(u, v), _dot(v, v)]
    secant = torch.stack(products, dim=1) / length[:, None] ** 2
    pitch = torch.stack([u.norm(dim=1), v.norm(dim=1)], dim=1)
    feet = torch.stack([_dot(foot, u), _dot(foot, v)], dim=1) / pitch**2
    area = hole.area_mm2 / (4 * math.pi)
    every = torch.ones_like(length)[:, None]
    shape = (1 / 16, 1 / 256) if hole.round else (1 / 12, 1 / 120)
    record = [
        *rows.unbind(dim=1),
        length[:, None],
        every * area * abs(float(torch.linalg.det(affine[:3, :3]))),
        secant,
        every * hole.least_cosine,
        feet,
        pitch / length[:, None],
        1 / pitch,
        every * rows.new_tensor(shape),
        every * values,
    ]
    whole = torch.cat(record, dim=1)
    assert whole.shape[1] == COLUMNS
    return whole


def _dot(a: Tensor, b: Tensor) -> Float[Tensor, " m"]:
    return (a * b).sum(dim=1)
