"""Weights of a scan: the angle that each view stands for, and the share of a ray that was measured
twice.

The fan coordinate of a ray is what it has in common with its counterpart from the other side, but
for the sign: the fan angle gamma between its projection onto the orbit's plane and the central ray
(radians), or a parallel ray's distance s from the isocentre (mm). It grows along the tangent. A ray
from the angle beta is measured again at beta + pi - 2 gamma, at the fan angle -gamma; at s, from
theta + pi.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.filtered.orbit import Orbit, orbit_of

ScanKind = Literal["auto", "full", "short", "offset"]
KINDS = ("auto", "full", "short", "offset")

#: A gap between angles is an end of the scan if it is so many times the median step.
GAP = 3.5
#: Parallel beams that leave out so many degrees and more than four mean steps are no full turn.
WEDGE = 15.0
#: Two views across each other are the fewest, but for rounding and a little.
FEW = 100.0
#: A detector is offset if one side of it reaches so many times as far as the other.
ASYMMETRY = 1.2


@dataclass(frozen=True, eq=False)
class Scan:
    """How a rig goes about its axis.

    Args:
        orbit: circle or turn.
        kind: "full", a whole turn; "short", at least 180 degrees and the fan; "offset", a whole
            turn with the detector to one side. Parallel beams over 180 degrees are "full".
        angles: from the scan's start, in radians.
        steps: radians that each view stands for.
        overlap: for "short" the fan angle up to which rays are complete, arc / 2 - 90 degrees; for
            "offset" the fan coordinate up to which the detector reaches on its narrow side.
        side: +1 where an offset detector is wide on the tangent's side, else -1.
        columns: empty columns before and behind an offset detector's rows that make it reach as far
            on its narrow side: the ramp's response there is not zero, and counts.
    """

    orbit: Orbit
    kind: str
    angles: Float[Tensor, " m"]
    steps: Float[Tensor, " m"]
    overlap: float = 0.0
    side: int = 1
    columns: tuple[int, int] = (0, 0)

    def of(self, views: slice) -> "Scan":
        """The part of some views; what the whole scan is made for stays."""
        orbit = replace(self.orbit, outwards=self.orbit.outwards[views])
        return replace(self, orbit=orbit, angles=self.angles[views], steps=self.steps[views])

    def to(self, device: torch.device) -> "Scan":
        """The same on a device."""
        orbit = self.orbit
        axis, centre, outwards = (x.to(device) for x in (orbit.axis, orbit.centre, orbit.outwards))
        moved = replace(orbit, axis=axis, centre=centre, outwards=outwards)
        angles, steps = self.angles.to(device), self.steps.to(device)
        return replace(self, orbit=moved, angles=angles, steps=steps)


def scan_of(cameras: Cameras, grid: Grid, kind: ScanKind = "auto") -> Scan:
    """The scan of a rig, detected from its angles and from where its detector reaches.

    Args:
        cameras: the rig.
        grid: whose inscribed cylinder must be seen.
        kind: "auto", or what the scan is to be taken for: "full", "short", "offset".

    Raises:
        ValueError: an unknown kind; angles that do not suffice; a detector beside the axis.
    """
    if kind not in KINDS:
        raise ValueError(f"Unknown scan {kind!r}. Known: {', '.join(KINDS)}")
    orbit = orbit_of(cameras, grid)
    low, high = _limits(cameras, orbit)
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
    columns = (empty, 0) if before else (0, empty)
    return Scan(orbit, kind, angles, steps, narrow, side, columns)


def _gaps(angles: Float[Tensor, " m"], period: float) -> tuple[Tensor, Tensor]:
    """The order of the angles, and the gap behind each of them in that order."""
    sorted_angles, order = angles.remainder(period).sort()
    return order, torch.cat([sorted_angles, sorted_angles[:1] + period]).diff()


def _periodic(order: Tensor, gaps: Tensor) -> Float[Tensor, " m"]:
    """Half of the gaps on both sides of each angle: the trapezoidal rule around a circle."""
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
            f"degrees for this grid and detector, got {math.degrees(arc):.4g}; take a smaller "
            f"grid, or use sirt"
        )
    behind = behind.clone()
    behind[last] = 0
    return Scan(orbit, "short", angles, _periodic(order, behind), arc / 2 - math.pi / 2)


def _limits(cameras: Cameras, orbit: Orbit) -> tuple[float, float]:
    """The fan coordinates between which every camera's middle row measures."""
    rows, columns = cameras.shape
    ends = torch.tensor([-0.5, columns - 0.5], dtype=torch.float64)
    fan = fan_coordinate(cameras, orbit, ends, torch.tensor([(rows - 1) / 2]).double())[:, 0]
    return fan.amin(dim=1).max().item(), fan.amax(dim=1).min().item()


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
    """(start + u U + v V) . direction of pixels (u, v), with the digits of u."""
    first, by_u, by_v = (
        (step * direction).sum(dim=-1)[:, None, None].to(u)
        for step in (start, cameras.u, cameras.v)
    )
    return first + by_v * v[:, None] + by_u * u


def redundancy(scan: Scan, fan: Float[Tensor, "m v u"]) -> Float[Tensor, "m v u"]:
    """The share of each ray of a scan's views; the shares of a line's measurements add up to one.

    Short scans: Parker, Optimal short scan convolution reconstruction for fanbeam CT, Med. Phys. 9,
    1982, eq. 12; with a longer arc than needed the fan angle is the one that it would suffice for
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
