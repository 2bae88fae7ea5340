"""The source orbit about the axis of rotation, derived from the cameras, and the weights of a scan:
the angular step of each view, and the redundancy of each ray.

A ray and its conjugate from the other side have opposite fan coordinates: the fan angle gamma
between the ray's projection onto the orbit's plane and the central ray (radians), or a parallel
ray's distance s from the isocentre (mm), both growing along the tangent. A ray from the angle beta
is measured again at beta + pi - 2 gamma, at the fan angle -gamma; at s, from theta + pi.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit

#: Greatest deviation of sources (relative to the radius) and of directions from the orbit.
TOLERANCE = 0.05
#: The greatest cosine between detector rows and the axis of rotation: 15 degrees.
TILT = 0.26


@dataclass(frozen=True, eq=False)
class Orbit:
    """Sources on a circle, or parallel beams turned about an axis.

    Args:
        axis: direction of the axis of rotation, a unit vector.
        centre: the isocentre in world mm: the circle's centre; for parallel beams the grid's.
        radius: mm from the axis to the sources (SID); infinite for parallel beams.
        outwards: unit vectors from the axis to the sources, or against the parallel rays.
    """

    axis: Float[Tensor, "3"]
    centre: Float[Tensor, "3"]
    radius: float
    outwards: Float[Tensor, "m 3"]

    @property
    def tangents(self) -> Float[Tensor, "m 3"]:
        """Unit vectors of the sources' motion with growing angle."""
        return torch.linalg.cross(self.axis.expand_as(self.outwards), self.outwards)

    @property
    def angles(self) -> Float[Tensor, " m"]:
        """Each source's angle about the axis in degrees, from the first one."""
        tangent = torch.linalg.cross(self.axis, self.outwards[0])
        return torch.rad2deg(torch.atan2(self.outwards @ tangent, self.outwards @ self.outwards[0]))

    def reach(self, grid: Grid) -> float:
        """The radius in mm of the grid's inscribed cylinder along the axis, about the isocentre."""
        steps = grid.affine[:3, :3].to(self.axis)
        along = (unit(steps, dim=0).T @ self.axis).abs().argmax()
        halves = steps.norm(dim=0) * (grid.centre_index.to(steps) + 0.5)
        offset = grid.centre.to(self.axis) - self.centre
        offset = offset - (offset @ self.axis) * self.axis
        return (halves[torch.arange(3) != along].min() + offset.norm()).item()

    def turned(self, cameras: Cameras, degrees: Float[Tensor, " m"]) -> Cameras:
        """Turn each camera about the axis by its own angle."""
        x, y, z = self.axis.tolist()
        about = self.axis.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        R = torch.linalg.matrix_exp(about * degrees.deg2rad().to(about)[:, None, None])

        def by(vectors: Tensor) -> Tensor:
            return (R @ vectors[..., None])[..., 0]

        source, origin = (
            by(points - self.centre) + self.centre for points in (cameras.source, cameras.origin)
        )
        return replace(cameras, source=source, origin=origin, u=by(cameras.u), v=by(cameras.v))


def orbit_of(cameras: Cameras, grid: Grid) -> Orbit:
    """Fit the circle of a rig's sources, or the rotation of its parallel beams, by least squares.

    The plane comes from the singular vectors, the circle from Kasa's linear fit (IEEE Trans.
    Instrum. Meas. 25, 1976).

    Raises:
        ValueError: sources that are not on a circle, directions that are not in a plane, or
            detector rows that run along the axis instead of across it.
    """
    with torch.no_grad():
        if not isinstance(cameras, Cameras):
            raise ValueError(
                "Filtered back-projection needs detectors with rows and columns, got "
                f"{type(cameras).__name__}; use sirt"
            )
        orbit = _turn(cameras, grid) if cameras.parallel else _circle(cameras)
        _check_rows(cameras, orbit)
        return orbit


def _turn(cameras: Cameras, grid: Grid) -> Orbit:
    beams = unit(cameras.origin - cameras.source)
    _, sizes, axes = torch.linalg.svd(beams)
    if len(beams) < 2 or sizes[1] < 1e-6 * sizes[0]:
        raise ValueError(
            f"FBP needs parallel beams from two directions at least, got {len(beams)} views along "
            f"one line"
        )
    axis = axes[2]
    if (leave := (beams @ axis).abs().max().item()) > TOLERANCE:
        raise ValueError(
            f"FBP needs parallel beams that are turned about one axis, got directions that leave "
            f"their plane by up to {leave:.2g} of their length, expected at most {TOLERANCE}; "
            f"use sirt"
        )
    outwards = unit(-beams + (beams @ axis)[:, None] * axis)
    return Orbit(axis, grid.centre.to(axis), torch.inf, outwards)


def _circle(cameras: Cameras) -> Orbit:
    count, mean = len(cameras), cameras.source.mean(dim=0)
    places = cameras.source - mean
    extent = places.norm(dim=1).max()
    places = places / extent if extent > 0 else places  # independent of the unit of length
    _, sizes, axes = torch.linalg.svd(places)
    if count < 3 or sizes[1] < 1e-6 * sizes[0] or not sizes[0] > 0:
        raise ValueError(
            f"FDK needs at least three sources on a circle, got {count} on a line; use sirt"
        )
    flat = places @ axes[:2].T
    system = torch.cat([2 * flat, torch.ones_like(flat[:, :1])], dim=1)
    # normal equations: the last bits of LAPACK's lstsq depend on memory alignment
    fit = torch.linalg.solve(system.T @ system, system.T @ flat.square().sum(dim=1))
    radius = (fit[2] + fit[:2].square().sum()).sqrt().item()
    out = flat - fit[:2]
    off = torch.hypot(places @ axes[2], out.norm(dim=1) - radius).max().item()
    if not off <= TOLERANCE * radius:
        raise ValueError(
            f"FDK needs sources on a circle, within {TOLERANCE:.0%} of its radius, got {count} "
            f"sources that leave the best circle, of radius {extent * radius:.4g} mm, by up to "
            f"{extent * off:.4g} mm; use sirt"
        )
    centre, radius = mean + extent * (fit[:2] @ axes[:2]), extent.item() * radius
    return Orbit(axes[2], centre, radius, unit(out) @ axes[:2])


def _check_rows(cameras: Cameras, orbit: Orbit) -> None:
    along = (unit(cameras.u) @ orbit.axis).abs()
    if (worst := along.max().item()) > TILT:
        raise ValueError(
            f"The ramp filter runs along detector rows, which must be across the axis of rotation: "
            f"expected a cosine between them of at most {TILT}, got {worst:.2g} in view "
            f"{int(along.argmax())}; if rows run along the axis, exchange rows and columns of "
            f"views and cameras"
        )


ScanKind = Literal["auto", "full", "short", "offset"]
KINDS = ("auto", "full", "short", "offset")

#: A gap between angles of so many median steps ends the scan.
GAP = 3.5
#: Parallel beams with a gap above so many degrees and four mean steps are no full turn.
WEDGE = 15.0
#: Two perpendicular views are the fewest, with a margin for rounding.
FEW = 100.0
#: A detector is offset if one side of it reaches so many times as far as the other.
ASYMMETRY = 1.2


@dataclass(frozen=True, eq=False)
class Scan:
    """The angular coverage of a rig.

    Args:
        orbit: circle, or rotation of parallel beams.
        kind: "full", a whole turn; "short", at least 180 degrees plus the fan angle; "offset", a
            whole turn with an offset detector. Parallel beams over 180 degrees are "full".
        angles: from the scan's start, in radians.
        steps: angular step of each view, in radians.
        overlap: for "short" the greatest complete fan angle, arc / 2 - 90 degrees; for "offset" the
            fan coordinate of the detector's narrow edge.
        side: +1 if an offset detector is wide on the tangent's side, else -1.
        columns: empty columns before and behind an offset detector's rows that make it symmetric,
            as the ramp's response extends there.
    """

    orbit: Orbit
    kind: str
    angles: Float[Tensor, " m"]
    steps: Float[Tensor, " m"]
    overlap: float = 0.0
    side: int = 1
    columns: tuple[int, int] = (0, 0)

    def of(self, views: slice) -> "Scan":
        """The part of some views, weighted as in the whole scan."""
        orbit = replace(self.orbit, outwards=self.orbit.outwards[views])
        return replace(self, orbit=orbit, angles=self.angles[views], steps=self.steps[views])

    def to(self, device: torch.device) -> "Scan":
        """Move to a device."""
        orbit = self.orbit
        axis, centre, outwards = (x.to(device) for x in (orbit.axis, orbit.centre, orbit.outwards))
        moved = replace(orbit, axis=axis, centre=centre, outwards=outwards)
        angles, steps = self.angles.to(device), self.steps.to(device)
        return replace(self, orbit=moved, angles=angles, steps=steps)


def scan_of(cameras: Cameras, grid: Grid, kind: ScanKind = "auto") -> Scan:
    """Detect the scan of a rig from its angles and the extent of its detector.

    Args:
        cameras: the rig.
        grid: its inscribed cylinder must be covered.
        kind: "auto", or the scan to assume: "full", "short", "offset".

    Raises:
        ValueError: an unknown kind; insufficient angles; a detector beside the axis.
    """
    if kind not in KINDS:
        raise ValueError(f"Unknown scan {kind!r}. Known: {', '.join(KINDS)}")
    orbit = orbit_of(cameras, grid)
    # the range of fan coordinates of every camera's middle row
    rows, columns = cameras.shape
    ends = torch.tensor([-0.5, columns - 0.5], dtype=torch.float64)
    fan = fan_coordinate(cameras, orbit, ends, torch.tensor([(rows - 1) / 2]).double())[:, 0]
    low, high = fan.amin(dim=1).max().item(), fan.amax(dim=1).min().item()
    narrow, wide = min(-low, high), max(-low, high)
    if not narrow > 0:
        raise ValueError(
            "Filtered back-projection needs a detector that the axis of rotation is projected "
            f"onto, got one that reaches from {low:.4g} to {high:.4g} "
            f"{'mm' if cameras.parallel else 'rad'} beside it"
        )
    angles = torch.deg2rad(orbit.angles).remainder(2 * math.pi)
    order, gaps = _gaps(angles, 2 * math.pi)
    median = gaps[gaps > 1e-6].median()
    whole = bool(gaps.max() <= max(GAP * median.item(), 1e-6))
    reach = orbit.reach(grid)
    reach = reach if cameras.parallel else math.asin(min(1.0, reach / orbit.radius))
    if kind == "auto":
        offset = whole and wide > ASYMMETRY * narrow and narrow < reach
        short = not whole and not cameras.parallel
        kind = "offset" if offset else "short" if short else "full"
    if kind == "short" and not cameras.parallel:
        return _short(orbit, angles, (order, gaps), min(wide, reach))
    if cameras.parallel and kind != "offset":
        return _half_turn(orbit, angles)
    if not whole:
        raise ValueError(
            f"A {kind} scan needs angles all around, got a gap of {math.degrees(gaps.max()):.4g} "
            f"degrees; expected at most {GAP} times the usual step of {math.degrees(median):.4g}"
        )
    steps = _periodic(order, gaps)
    if kind == "full":
        return Scan(orbit, kind, angles, steps)
    side = 1 if high > -low else -1
    far, near = (wide, narrow) if cameras.parallel else (math.tan(wide), math.tan(narrow))
    empty = math.ceil(cameras.shape[1] * (far - near) / (far + near))
    before = side * (cameras.u[0] @ orbit.tangents[0]).item() > 0
    padding = (empty, 0) if before else (0, empty)
    return Scan(orbit, kind, angles, steps, narrow, side, padding)


def _gaps(angles: Float[Tensor, " m"], period: float) -> tuple[Tensor, Tensor]:
    """The order of the angles, and the gap after each in that order."""
    sorted_angles, order = angles.remainder(period).sort()
    return order, torch.cat([sorted_angles, sorted_angles[:1] + period]).diff()


def _periodic(order: Tensor, gaps: Tensor) -> Float[Tensor, " m"]:
    """Half of the gaps on both sides of each angle: the periodic trapezoidal rule."""
    return torch.empty_like(gaps).index_copy(0, order, (gaps + gaps.roll(1)) / 2)


def _half_turn(orbit: Orbit, angles: Float[Tensor, " m"]) -> Scan:
    order, gaps = _gaps(angles, math.pi)
    if (gap := math.degrees(gaps.max())) > max(WEDGE, min(4 * 180 / len(angles), FEW)):
        raise ValueError(
            f"FBP of parallel beams needs angles over 180 degrees, got a gap of {gap:.4g} degrees "
            f"between {len(angles)} views; use sirt"
        )
    return Scan(orbit, "full", angles, _periodic(order, gaps))


def _short(
    orbit: Orbit, angles: Float[Tensor, " m"], gaps: tuple[Tensor, Tensor], fan: float
) -> Scan:
    order, behind = gaps
    last = int(behind.argmax())
    start = angles[order[(last + 1) % len(angles)]]
    angles = (angles - start).remainder(2 * math.pi)
    arc = 2 * math.pi - behind.max().item()
    if arc + arc / len(angles) < math.pi + 2 * fan:
        raise ValueError(
            f"A short scan needs 180 degrees and the fan angle, {180 + math.degrees(2 * fan):.4g} "
            f"degrees for this grid and detector, got {math.degrees(arc):.4g}: are the angles "
            f"right? Else take a smaller grid, or use sirt"
        )
    behind = behind.clone()
    behind[last] = 0
    return Scan(orbit, "short", angles, _periodic(order, behind), arc / 2 - math.pi / 2)


def fan_coordinate(
    cameras: Cameras, orbit: Orbit, u: Float[Tensor, " u"], v: Float[Tensor, " v"]
) -> Float[Tensor, "m v u"]:
    """The fan coordinate of the rays through pixels (u, v), in radians; in mm for parallel rays."""
    start = cameras.source - orbit.centre if cameras.parallel else cameras.origin - cameras.source
    across = along(start, cameras, orbit.tangents, u, v)
    if cameras.parallel:
        return across
    side = -1.0 if cameras.ray_extent[1] > 0 else 1.0  # a pinhole's detector is behind it
    ahead = along(start, cameras, side * orbit.outwards, u, v)
    return torch.atan2(-side * across, ahead)


def along(
    start: Float[Tensor, "m 3"],
    cameras: Cameras,
    direction: Float[Tensor, "m 3"],
    u: Float[Tensor, " u"],
    v: Float[Tensor, " v"],
) -> Float[Tensor, "m v u"]:
    """(start + u U + v V) . direction of pixels (u, v), in the dtype of u."""
    first, by_u, by_v = (
        (step * direction).sum(dim=-1)[:, None, None].to(u)
        for step in (start, cameras.u, cameras.v)
    )
    return first + by_v * v[:, None] + by_u * u


def redundancy(scan: Scan, fan: Float[Tensor, "m v u"]) -> Float[Tensor, "m v u"]:
    """The redundancy weight of each ray of a scan's views; the weights of all measurements of a
    line sum to one.

    Short scans: Parker, Optimal short scan convolution reconstruction for fanbeam CT, Med. Phys. 9,
    1982, eq. 12; with a longer arc the fan angle is replaced by the one that the arc covers
    (Silver, Med. Phys. 27, 2000). Offset detectors: Wang, X-ray micro-CT with a displaced detector
    array, Med. Phys. 29, 2002.
    """
    if scan.kind == "short":
        beta, delta = scan.angles[:, None, None].to(fan), scan.overlap
        gamma = fan.clamp(-delta * 0.9999, delta * 0.9999)
        begin = (beta / (delta + gamma)).clamp(0, 2)
        end = ((math.pi + 2 * delta - beta) / (delta - gamma)).clamp(0, 2)
        return (torch.sin(math.pi / 4 * begin) * torch.sin(math.pi / 4 * end)).square()
    if scan.kind == "offset":
        place = (scan.side * fan / scan.overlap).clamp(-1, 1)
        return (1 + torch.sin(math.pi / 2 * place)) / 2
    return torch.full_like(fan[:, :1, :1], 1.0 if math.isinf(scan.orbit.radius) else 0.5)
