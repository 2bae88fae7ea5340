"""Rigs from lengths in mm and angles in degrees: cameras with a flat detector on a circle, an arc
or a dome, and parallel beams.

Convention: angles in degrees are counter-clockwise seen from +z, from the x axis: a camera at the
angle a is at (cos a, sin a, 0) and looks at the z axis; its rows are horizontal, with u = (-sin a,
cos a, 0) to its right, and v = -z downwards.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypedDict

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused
from mvrecon.core.quantities import Pair, PositiveFloat, PositiveInt, Triple
from mvrecon.core.registry import check_options
from mvrecon.core.signatures import OptionsOf
from mvrecon.geometry.cameras.camera import Cameras, Extent
from mvrecon.geometry.cameras.formats.common import angles_in
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import look_at

#: Where parallel rays without an end start before the axis, and the detector stands behind it.
BEAM_HALF_MM = 500.0


class _Detector(TypedDict, total=False):
    """Settings of a detector, for both directions or (v, u).

    Args:
        pixels: rows and columns; fit: as many as see the grid.
        pixel_mm: pitch; fit: that of the grid's voxels.
        offset_mm: shift of the detector's centre down and to the right, as seen from the source.
    """

    pixels: PositiveInt | Pair[PositiveInt] | Literal["fit"] | None
    pixel_mm: PositiveFloat | Pair[PositiveFloat] | Literal["fit"] | None
    offset_mm: float | Pair[float] | None


#: A mapping of the options of `Detector`; apps take "fit" for the pixels that see the grid.
DetectorOptions: TypeAlias = Annotated[
    Mapping[str, Any] | Literal["fit"], OptionsOf("mvrecon.geometry.cameras.rigs:_Detector")
]


@dataclass(frozen=True)
class Detector:
    """A flat detector. Pairs are in the order (v, u): down a column, along a row; one number is for
    both.

    Args:
        pixels: rows and columns.
        pixel_mm: pitch of the rows and of the columns.
        offset_mm: shift of the detector's centre down and to the right, as seen from the source.

    Raises:
        ValueError: sizes that are not positive, or not one or two finite numbers.
    """

    pixels: tuple[int, int]
    pixel_mm: tuple[float, float]
    offset_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            pair = tuple(value) if isinstance(value, list | tuple) else (value, value)
            if len(pair) != 2 or not all(isinstance(x, Real) and math.isfinite(x) for x in pair):
                fit = "; fit needs a simulated rig and its grid" if value == "fit" else ""
                raise ValueError(
                    f"A detector's {field.name} must be one number or two (v, u), got "
                    f"{value!r}{fit}"
                )
            object.__setattr__(self, field.name, pair)
        if not (all(x == int(x) and x >= 1 for x in self.pixels) and min(self.pixel_mm) > 0):
            raise ValueError(
                "A detector needs positive whole pixels and a positive pixel_mm, "
                f"got pixels {self.pixels} and pixel_mm {self.pixel_mm}"
            )

    @classmethod
    def of(cls, options: DetectorOptions) -> "Detector":
        """Build a detector from a mapping; an option that is None is absent.

        Raises:
            TypeError: not a mapping, an unknown option, or a missing one; the message names it.
        """
        known = [field.name for field in fields(cls)]
        if not isinstance(options, Mapping):
            raise TypeError(f"A detector must be a mapping of {', '.join(known)}, got {options!r}")
        check_options("A detector", options, known)
        options = {name: value for name, value in options.items() if value is not None}
        if absent := {"pixels", "pixel_mm"} - set(options):
            raise TypeError(
                f"A detector needs {' and '.join(sorted(absent))}, got only {sorted(options)}"
            )
        return cls(**options)

    def carried(
        self,
        source: Float[Tensor, "m 3"],
        centre: Float[Tensor, "m 3"],
        R: Float[Tensor, "m 3 3"],
        parallel: bool = False,
        extent: Extent = "segment",
    ) -> Cameras:
        """Build cameras with this detector.

        Args:
            source: sources or pinholes in mm; for parallel beams, the start of the beam's axis.
            centre: position of the detector's centre in mm, before `offset_mm`.
            R: rows right, down and forward as seen from the source towards the object (`look_at`).
            parallel, extent: see `Cameras`.
        """
        (down, right), (rows, columns) = self.pixel_mm, self.pixels
        u, v = R[:, 0] * right, R[:, 1] * down
        offset = R[:, 0] * self.offset_mm[1] + R[:, 1] * self.offset_mm[0]
        corner = offset - u * (columns - 1) / 2 - v * (rows - 1) / 2
        return Cameras(
            source=source + corner if parallel else source,
            origin=centre + corner,
            u=u,
            v=v,
            shape=self.pixels,
            parallel=parallel,
            extent=extent,
        )


def circular(
    n_views: PositiveInt,
    sid: PositiveFloat,
    sdd: PositiveFloat,
    detector: DetectorOptions,
    arc_degrees: float = 360.0,
    start_degrees: float = 0.0,
    angles: Sequence[float] | str | Path | None = None,
    small_arc: bool = False,
) -> Cameras:
    """Cone beam on a circle about the z axis, the source at (sid cos a, sid sin a, 0).

    Args:
        n_views: number of cameras, at the angles start + arc k / n_views, without repetition on a
            full circle.
        sid: mm from the source to the axis.
        sdd: mm from the source to the detector, on the other side of the axis.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        arc_degrees: the range of angles, excluding its end; negative is clockwise seen from +z.
        start_degrees: the first angle.
        angles: explicit angles instead of equal steps, as many as `n_views`, or a file of them:
            .npy, text or a table, see `angles_in`.
        small_arc: the angles in the file are degrees although they look like radians.

    Returns:
        A rig of `n_views` cameras.

    Raises:
        ValueError: lengths that are not positive, a detector in front of the axis, a wrong number
            of angles.

    Examples:
        >>> rig = mv.circular(4, sid=200, sdd=300, detector={"pixels": [32, 48], "pixel_mm": 2.0})
        >>> len(rig), rig.shape
        (4, (32, 48))
        >>> rig.source[1].round()  # mm; at 90 degrees
        tensor([  0., 200.,   0.], dtype=torch.float64)
    """
    degrees = _angles(n_views, arc_degrees, start_degrees, angles, small_arc)
    return _cone(degrees, sid, sdd, detector)


def arc(
    n_views: PositiveInt,
    sid: PositiveFloat,
    sdd: PositiveFloat,
    detector: DetectorOptions,
    arc_degrees: float = 180.0,
    start_degrees: float = 0.0,
) -> Cameras:
    """Cone beam on an arc about the z axis, as `circular`, but with a camera at both ends.

    Args:
        n_views: number of cameras, at the angles start + arc k / (n_views - 1).
        sid: mm from the source to the axis.
        sdd: mm from the source to the detector, on the other side of the axis.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        arc_degrees: the range of angles, including its end; negative is clockwise seen from +z.
        start_degrees: the first angle.

    Returns:
        A rig of `n_views` cameras.

    Raises:
        ValueError: as `circular`, or a closed arc, whose ends would be one camera.

    Examples:
        >>> rig = mv.arc(5, sid=200, sdd=300, detector={"pixels": [32, 32], "pixel_mm": 2.0})
        >>> rig.source[2].round()  # mm; at 90 degrees, in the middle of the arc
        tensor([  0., 200.,   0.], dtype=torch.float64)
        >>> torch.allclose(rig.source[0], -rig.source[4])  # at its ends
        True
    """
    if n_views > 1 and arc_degrees % 360 == 0:
        raise ValueError(
            f"The ends of an arc of {arc_degrees} degrees are one camera; use the camera 'circular'"
        )
    step = arc_degrees / max(n_views - 1, 1)
    return _cone(_angles(n_views, step * n_views, start_degrees, None), sid, sdd, detector)


def parallel(
    n_views: PositiveInt,
    detector: DetectorOptions,
    depth_mm: PositiveFloat | None = None,
    arc_degrees: float = 180.0,
    start_degrees: float = 0.0,
    angles: Sequence[float] | str | Path | None = None,
    small_arc: bool = False,
) -> Cameras:
    """Parallel beams across the z axis, coming from (cos a, sin a, 0).

    Args:
        n_views: number of views, at the angles start + arc k / n_views.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        depth_mm: rays extend from depth / 2 before to depth / 2 behind the axis; None: without end,
            as wide panels, or pixels as the unit of length, need.
        arc_degrees: the range of angles, excluding its end.
        start_degrees: the first angle.
        angles: explicit angles instead of equal steps, as many as `n_views`, or a file of them:
            .npy, text or a table, see `angles_in`.
        small_arc: the angles in the file are degrees although they look like radians.

    Returns:
        A rig of `n_views` cameras.

    Convention: column u measures s along (-sin a, cos a). The Radon transform's theta, with s along
    (cos theta, sin theta), is a + 90 degrees.

    Raises:
        ValueError: a depth that is not positive, a wrong number of angles.

    Examples:
        >>> rig = mv.parallel(90, detector={"pixels": [32, 48], "pixel_mm": 2.0})
        >>> A = mv.Radon(mv.Grid.centred(32, spacing=2.0), rig)
        >>> A(torch.ones(1, 1, 32, 32, 32)).shape
        torch.Size([1, 1, 90, 32, 48])
    """
    degrees = _angles(n_views, arc_degrees, start_degrees, angles, small_arc)
    if depth_mm is None:
        return _about_z(degrees, BEAM_HALF_MM, BEAM_HALF_MM, detector, True, "line")
    _check_positive(depth_mm=depth_mm)
    return _about_z(degrees, depth_mm / 2, depth_mm / 2, detector, parallel=True)


def dome(
    n_views: PositiveInt,
    radius: PositiveFloat,
    focal: PositiveFloat,
    aperture_degrees: PositiveFloat,
    detector: DetectorOptions,
    target: Triple[float] = (0.0, 0.0, 0.0),
    extent: Extent = "behind",
) -> Cameras:
    """Cameras evenly distributed on the cap of a sphere about +z, all aimed at its centre
    (pinholes, by default).

    Equal steps in height give rings of equal area; consecutive cameras are the golden angle apart
    (Fibonacci lattice; Gonzalez, Math. Geosci. 42, 2010).

    Args:
        n_views: number of cameras.
        radius: mm from the target to every source or pinhole.
        focal: mm from the source or pinhole to its detector.
        aperture_degrees: full opening of the cap seen from the target: 180 a half sphere, 360 all
            of it.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        target: the sphere's centre in mm, at which all cameras aim.
        extent: "behind" puts the detector behind the pinhole; any other on the target's side.

    Returns:
        A rig of `n_views` cameras.

    Raises:
        ValueError: lengths or numbers that are not positive, an aperture beyond 360 degrees.

    Examples:
        >>> detector = {"pixels": [32, 32], "pixel_mm": 1.0}
        >>> rig = mv.dome(12, radius=150.0, focal=60.0, aperture_degrees=120.0, detector=detector)
        >>> len(rig), rig.extent
        (12, 'behind')
        >>> torch.allclose(rig.source.norm(dim=1), torch.tensor(150.0, dtype=torch.float64))
        True
    """
    _check_positive(n_views=n_views, radius=radius, focal=focal, aperture_degrees=aperture_degrees)
    if aperture_degrees > 360:
        raise ValueError(
            f"A dome's aperture_degrees must be at most 360, a whole sphere, got {aperture_degrees}"
        )
    k = torch.arange(n_views, dtype=torch.float64)
    height = 1 - (k + 0.5) / n_views * (1 - math.cos(math.radians(aperture_degrees / 2)))
    azimuth = k * math.pi * (3 - math.sqrt(5))
    across = (1 - height**2).sqrt()
    outwards = torch.stack([across * azimuth.cos(), across * azimuth.sin(), height], dim=-1)
    centre = torch.as_tensor(target, dtype=torch.float64).expand(n_views, 3)
    source = centre + radius * outwards
    reach = focal if extent == "behind" else -focal
    R = look_at(source, centre)
    return Detector.of(detector).carried(source, source + reach * outwards, R, extent=extent)


def _cone(degrees: Sequence[float], sid: float, sdd: float, detector: DetectorOptions) -> Cameras:
    _check_positive(sid=sid, sdd=sdd)
    if sdd <= sid:
        raise ValueError(
            f"The detector must stand across the axis, sdd > sid, got sdd {sdd} and sid {sid} mm"
        )
    return _about_z(degrees, sid, sdd - sid, detector)


def _about_z(
    degrees: Sequence[float],
    front: float,
    back: float,
    detector: DetectorOptions,
    parallel: bool = False,
    extent: Extent = "segment",
) -> Cameras:
    """Beams through the z axis from `front` mm before it to `back` mm behind it."""
    a = torch.deg2rad(torch.as_tensor(degrees, dtype=torch.float64))
    outwards = torch.stack([a.cos(), a.sin(), torch.zeros_like(a)], dim=-1)
    source, centre = front * outwards, -back * outwards
    return Detector.of(detector).carried(source, centre, look_at(source, centre), parallel, extent)


def _angles(
    n_views: int,
    arc: float,
    start: float,
    angles: Sequence[float] | str | Path | None,
    small_arc: bool = False,
) -> Sequence[float]:
    _check_positive(n_views=n_views)
    if angles is not None and start:
        raise ValueError(f"A rig has angles or start_degrees, got both, start_degrees {start:g}")
    if isinstance(angles, str | Path):
        found = angles_in(angles, small_arc)
        if len(found) != n_views:
            raise Refused(
                f"{angles}: expected an angle of each of {n_views} views, got {len(found)}"
            )
        return found
    numbers = {
        "arc_degrees": [arc],
        "start_degrees": [start],
        "angles": [] if angles is None else angles,
    }
    for name, degrees in numbers.items():
        if not all(math.isfinite(angle) for angle in degrees):
            raise ValueError(f"A rig's {name} must be finite degrees, got {degrees}")
    if angles is None:
        return [start + arc * k / n_views for k in range(n_views)]
    if len(angles) != n_views:
        raise ValueError(f"A rig of {n_views} views needs {n_views} angles, got {len(angles)}")
    return angles


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise ValueError(f"A rig's {name} must be positive, got {value!r}")


def sinogram_rig(grid: Grid, angles: int, bins: int | None = None) -> Cameras:
    """Parallel beams across a grid's slices, one row for each slice, with pixels as wide as the
    narrower side of a voxel.

    Convention: view a is the Radon transform at theta = 360 a / angles degrees, its columns measure
    s along (cos theta, sin theta) of the grid's own axes x and y from its centre, its row k is
    slice k of the volume.

    Args:
        grid: the slices.
        angles: number of angles on the full circle.
        bins: columns; None: enough for the diagonal of a slice.

    Raises:
        ValueError: a grid whose axes are not at right angles.
    """
    x, y, z = grid.spacing
    axes = grid.affine[:3, :3] / grid.affine.new_tensor([x, y, z])
    if not torch.allclose(axes.T @ axes, torch.eye(3).to(axes), atol=1e-6):
        raise ValueError(
            f"Sinograms of slices need a grid with axes at right angles, got {grid.affine.tolist()}"
        )
    width = min(x, y)
    diagonal = math.hypot(grid.shape[2] * (x / width), grid.shape[1] * (y / width))
    bins = bins or math.ceil(diagonal - 1e-6)
    detector = {"pixels": [grid.shape[0], bins], "pixel_mm": [z, width]}
    rig = parallel(angles, detector, 2 * width * diagonal, arc_degrees=360.0, start_degrees=90.0)
    rows, columns = rig.shape
    turned = (columns - 1) * rig.u + (rows - 1) * rig.v  # rows upwards, in the order of slices
    source, origin = rig.source + turned, rig.origin + turned
    rig = Cameras(source, origin, -rig.u, -rig.v, rig.shape, parallel=True)
    return rig.moved(axes, grid.centre)


#: Of DC-SPECT: rows and columns of modules, and a detector's edge.
MODULE_ROWS, MODULE_COLUMNS, DETECTOR_MM = 4, 20, 50.0


def dcspect80(
    pixels: int | Sequence[int] = 48,
    rows: Sequence[int] | None = None,
    columns: Sequence[int] | None = None,
    field: float = 1.0,
) -> Cameras:
    """The 80-pinhole cardiac camera DC-SPECT: pinholes about the chest, all aimed at the heart's
    centre, the origin.

    Each detector, 50 x 50 mm, is one collimator length (50 to 89 mm) behind its pinhole,
    perpendicular to the pinhole's axis; v runs downwards, as near to -z as possible. Camera k of
    the whole rig is module 20 row + column.

    Args:
        pixels: the detector's pixels (rows, columns), or one number for both.
        rows: indices of the 4 rows of modules, from -z to +z; all by default.
        columns: indices of the 20 columns, from the azimuth 14 degrees to 256; all by default.
        field: factor on the detectors' width and height, with as many pixels; 2: the enlarged field
            of the project's design slides.

    Returns:
        A rig of `len(rows)` x `len(columns)` pinholes.

    Published: pinhole positions, detector size, and the collimator lengths of 8 modules (16 by
    mirror symmetry). Fitted: the other 64 lengths, linear in the distance to the heart. Not
    published: the pixel pitch, hence `pixels`. Source: the header of `dcspect80.csv`, beside this
    file.

    Raises:
        ValueError: a row or column out of range, or a field that is not positive.

    Examples:
        >>> rig = mv.dcspect80(pixels=32)
        >>> len(rig), rig.shape, rig.extent
        (80, (32, 32), 'behind')
        >>> rig.project(torch.zeros(1, 3))[0, 0, :2]  # aimed at the origin
        tensor([15.5000, 15.5000])
    """
    chosen = [
        MODULE_COLUMNS * row + column
        for row in _chosen("rows", rows, MODULE_ROWS)
        for column in _chosen("columns", columns, MODULE_COLUMNS)
    ]
    table = torch.tensor(modules(), dtype=torch.float64)[chosen]
    pinhole, length = table[:, :3], table[:, 3:]
    heart = torch.zeros_like(pinhole)
    centre = pinhole + length * torch.nn.functional.normalize(pinhole, dim=-1)
    if not 0 < field < float("inf"):
        raise ValueError(f"Expected a positive factor of the field, got {field}")
    count = (pixels, pixels) if isinstance(pixels, int) else tuple(pixels)
    detector = Detector.of(
        {"pixels": count, "pixel_mm": [field * DETECTOR_MM / max(n, 1) for n in count]}
    )
    return detector.carried(pinhole, centre, look_at(pinhole, heart), extent="behind")


@cache
def modules() -> tuple[tuple[float, float, float, float], ...]:
    """Pinhole x, y, z and collimator length in mm of the 80 modules, in order."""
    text = files("mvrecon.geometry.cameras").joinpath("dcspect80.csv").read_text(encoding="utf-8")
    table = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    columns = ("x_mm", "y_mm", "z_mm", "collimator_length_mm")
    return tuple(tuple(float(row[name]) for name in columns) for row in table)  # type: ignore[misc]


def _chosen(what: str, indices: Sequence[int] | None, count: int) -> Sequence[int]:
    if indices is None:
        return range(count)
    if not indices or any(i not in range(count) for i in indices):
        raise ValueError(f"DC-SPECT has {what} 0 to {count - 1}, got {list(indices)}")
    return indices
