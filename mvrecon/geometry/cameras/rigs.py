"""Rigs from a few mm and degrees: cameras on a circle, on an arc, on a dome, and parallel beams.

Convention: angles in degrees turn counter-clockwise seen from +z, from the x axis: a camera at the
angle a stands at (cos a, sin a, 0) and looks at the z axis; its rows are horizontal, u running to
its right = (-sin a, cos a, 0), and v runs downwards = -z.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from mvrecon.core.quantities import PositiveFloat, PositiveInt, Triple
from mvrecon.geometry.cameras.camera import Cameras, Extent
from mvrecon.geometry.cameras.detector import Detector
from mvrecon.geometry.rigid import look_at


def circular(
    n_views: PositiveInt,
    sid: PositiveFloat,
    sdd: PositiveFloat,
    detector: Mapping[str, Any],
    arc_degrees: float = 360.0,
    start_degrees: float = 0.0,
    angles: Sequence[float] | None = None,
) -> Cameras:
    """Cone beam on a circle about the z axis, the source at (sid cos a, sid sin a, 0).

    Args:
        n_views: number of cameras; their angles are start + arc k / n_views, so that a full circle
            repeats none.
        sid: mm from the source to the axis.
        sdd: mm from the source to the detector, which stands across the axis.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        arc_degrees: the range of angles, its end excluded; negative turns clockwise seen from +z.
        start_degrees: the first angle.
        angles: explicit angles in place of equal steps, as many as `n_views`.

    Raises:
        ValueError: lengths that are not positive, a detector in front of the axis, a wrong number
            of angles.
    """
    return _cone(_angles(n_views, arc_degrees, start_degrees, angles), sid, sdd, detector)


def arc(
    n_views: PositiveInt,
    sid: PositiveFloat,
    sdd: PositiveFloat,
    detector: Mapping[str, Any],
    arc_degrees: float = 180.0,
    start_degrees: float = 0.0,
) -> Cameras:
    """Cone beam on an arc about the z axis, as `circular`, but with a camera at both ends of the
    arc.

    Args:
        n_views: number of cameras; their angles are start + arc k / (n_views - 1).
        sid: mm from the source to the axis.
        sdd: mm from the source to the detector, which stands across the axis.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        arc_degrees: the range of angles, its end included; negative turns clockwise seen from +z.
        start_degrees: the first angle.

    Raises:
        ValueError: as `circular`, or an arc that closes, so that its ends would be one camera.
    """
    if n_views > 1 and arc_degrees % 360 == 0:
        raise ValueError(
            f"The ends of an arc of {arc_degrees} degrees are one camera; use the camera 'circular'"
        )
    step = arc_degrees / max(n_views - 1, 1)
    return _cone(_angles(n_views, step * n_views, start_degrees, None), sid, sdd, detector)


def parallel(
    n_views: PositiveInt,
    detector: Mapping[str, Any],
    depth_mm: PositiveFloat = 1000.0,
    arc_degrees: float = 180.0,
    start_degrees: float = 0.0,
    angles: Sequence[float] | None = None,
) -> Cameras:
    """Parallel beams across the z axis, coming from (cos a, sin a, 0).

    Args:
        n_views: number of views; their angles are start + arc k / n_views.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        depth_mm: a ray starts depth / 2 before the axis and ends depth / 2 behind it; only that
            range counts.
        arc_degrees: the range of angles, its end excluded.
        start_degrees: the first angle.
        angles: explicit angles in place of equal steps, as many as `n_views`.

    Convention: column u measures s along (-sin a, cos a). The Radon transform's theta, whose s runs
    along (cos theta, sin theta), is a + 90 degrees.

    Raises:
        ValueError: a depth that is not positive, a wrong number of angles.
    """
    _check_positive(depth_mm=depth_mm)
    degrees = _angles(n_views, arc_degrees, start_degrees, angles)
    return _about_z(degrees, depth_mm / 2, depth_mm / 2, detector, parallel=True)


def dome(
    n_views: PositiveInt,
    radius: PositiveFloat,
    focal: PositiveFloat,
    aperture_degrees: PositiveFloat,
    detector: Mapping[str, Any],
    target: Triple[float] = (0.0, 0.0, 0.0),
    extent: Extent = "behind",
) -> Cameras:
    """Cameras evenly spread on the cap of a sphere about +z, all aimed at its centre (pinholes, by
    default).

    The cap's height is cut into equal steps, hence into rings of equal area, and each camera is the
    golden angle further round than the last (Fibonacci lattice; Gonzalez, Math. Geosci. 42, 2010).

    Args:
        n_views: number of cameras.
        radius: mm from the target to every source or pinhole.
        focal: mm from the source or pinhole to its detector.
        aperture_degrees: full opening of the cap seen from the target: 180 a half sphere, 360 all
            of it.
        detector: options of `Detector`: pixels, pixel_mm, offset_mm, each (v, u).
        target: the point in mm that all look at, and the sphere's centre.
        extent: "behind" puts the detector behind the pinhole; any other puts it on the target's
            side.

    Raises:
        ValueError: lengths or numbers that are not positive, an aperture beyond 360 degrees.
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


def _cone(degrees: Sequence[float], sid: float, sdd: float, detector: Mapping[str, Any]) -> Cameras:
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
    detector: Mapping[str, Any],
    parallel: bool = False,
) -> Cameras:
    """Beams through the z axis from `front` mm before it to `back` mm behind it."""
    a = torch.deg2rad(torch.as_tensor(degrees, dtype=torch.float64))
    outwards = torch.stack([a.cos(), a.sin(), torch.zeros_like(a)], dim=-1)
    source, centre = front * outwards, -back * outwards
    return Detector.of(detector).carried(source, centre, look_at(source, centre), parallel)


def _angles(
    n_views: int, arc: float, start: float, angles: Sequence[float] | None
) -> Sequence[float]:
    _check_positive(n_views=n_views)
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
