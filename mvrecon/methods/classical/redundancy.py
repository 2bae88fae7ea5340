"""Redundancy weights of filtered back-projection, for any angles and any panel of each view.

A line in the orbit's plane is measured on two branches: by rays (beta, q) and by their conjugates,
(beta + pi - 2 q, -q) of a fan and (beta + pi, -q) of parallel beams, where q is the fan coordinate.
Each branch takes a share of the line, and the two shares sum to one. The weight of a ray is the
integral of its branch's share over the angular cell of its view. So the weights of all rays along a
line sum to the measure of the line, whether one view measures it, two, or many.

The share of a branch falls smoothly to zero where the branch ends: at the edges of its panels,
beside a gap between its views, and towards an angle from which on views have other panels. A full
turn has shares of one half, an arc Parker's weights (Optimal short scan convolution reconstruction
for fanbeam CT, Med. Phys. 9, 1982, eq. 12), and a detector that reaches at least three times as far
on one side Wang's (X-ray micro-CT with a displaced detector array, Med. Phys. 29, 2002).
"""

import math
import warnings
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import ROUNDING_ERROR
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.missing import Missing
from mvrecon.methods.classical.orbit import Orbit, along, fan_coordinate, orbit_of
from mvrecon.methods.classical.steps import (
    FULL_TURN,
    gaps_of,
    of_exposures,
    start_of,
    usual_steps,
    widest_of,
)

#: Fan coordinates at which weights are computed, on each side of the axis; least angles of the
#: raster of lines, and angles per view.
FAN_DISTANCES, MIN_ANGLES, ANGLES_PER_VIEW = 128, 1440, 4
#: Lines in a gap count as not measured, in a warning, where it is so much wider than a usual step
#: and than an even one.
NAMED_GAP = math.radians(8.0)
#: A line that no ray measures is replaced by views within this angle, or within so many steps.
MAX_NEAR_ANGLE, MAX_NEAR_STEPS = math.radians(5.0), 2.0
#: A branch's share falls to zero over at least this angle.
MIN_TAPER = math.radians(30.0)
#: Where neighbouring views have different panels, a view's weight falls to zero over this part of
#: its panel. Neighbours are weighted by a Gaussian: its standard deviation in steps, and its end.
PANEL_TAPER, NEIGHBOUR_STEPS, NEIGHBOUR_DEVIATIONS = 0.5, 1.0, 4.0
#: Kinks of a line's distance from the edge of a panel are rounded over this part of the distance.
ROUNDING = 0.2
#: Share of the lines at any one distance from the axis that are not measured, from which a warning
#: is given: at the rim of a fan whose arc is 8 degrees short values are 2 % off.
WARNED_MISSING = 0.01
#: The same of all lines, where those missing are farther off than any that are measured: an object
#: that reaches there is cut in the views, for which there is another warning. Of a cube around the
#: field of a square panel, 1 - cos of half the fan angle are missing: 5 % for 18 degrees.
WARNED_BEYOND = 0.05
#: Streaks of a disc half as wide as the grid, root mean square over the grid's cylinder relative to
#: that of the disc, by half a turn's number of directions in which its edge is measured; and from
#: which on a warning is given. Measured: 2.9 / n of 2 directions to 4.3 / n of 12 and more, of a
#: radius of so many pixels or more; of fewer, the square root of their share of these, as they blur
#: the edge (1.1 / n of 8, 1.8 of 16, 2.6 of 32). Up to 5.5 / n of a disc a third as wide, aside,
#: and 1.2 / n of one that fills the grid.
STREAKS, SHARP_PIXELS, WARNED_STREAKS = 4.2, 58.0, 0.25


@dataclass(frozen=True, eq=False)
class RedundancyWeights:
    """Weights of a rig's rays for filtered back-projection.

    Args:
        orbit: circle, or rotation of parallel beams.
        weights: weights of each view in radians, at equal steps of the fan coordinate from -limit
            to limit; one column if they are the same for all rays of a view.
        limit: greatest fan coordinate of `weights`, in radians; in mm for parallel beams.
        columns: empty columns before and behind the rows, as the ramp's response extends to lines
            that only other views measure.
    """

    orbit: Orbit
    weights: Float[Tensor, "m q"]
    limit: float
    columns: tuple[int, int]

    def of(self, views: slice) -> "RedundancyWeights":
        """The part of some views, weighted as in the whole scan."""
        orbit = replace(self.orbit, outwards=self.orbit.outwards[views])
        return replace(self, orbit=orbit, weights=self.weights[views])

    def to(self, device: torch.device) -> "RedundancyWeights":
        """Move to a device."""
        return replace(self, orbit=self.orbit.to(device), weights=self.weights.to(device))

    def of_rays(
        self, cameras: Cameras, u: Float[Tensor, " u"], v: Float[Tensor, " v"]
    ) -> Float[Tensor, "m #v #u"]:
        """The weights of the rays through pixels (u, v) of all views, in radians."""
        if self.weights.shape[1] == 1:
            return self.weights[:, :, None].to(u)
        across = (cameras.v @ self.orbit.axis).abs() - cameras.v.norm(dim=-1)
        if across.abs().max() <= 1e-9 * cameras.v.norm(dim=-1).max():
            v = v[:1]  # columns along the axis: all rays of a column have one fan coordinate
        fan = fan_coordinate(cameras, self.orbit, u, v)
        last = self.weights.shape[1] - 1
        place = ((fan + self.limit) * (last / (2 * self.limit))).clamp(0, last)
        before = place.floor().clamp(max=last - 1)
        table, index = self.weights.to(u), before.long().flatten(1)
        here, there = (table.gather(1, index + k).view_as(fan) for k in (0, 1))
        return torch.lerp(here, there, place - before)


def redundancy_weights(cameras: Cameras, grid: Grid, max_missing: float = 0.1) -> RedundancyWeights:
    """Compute the weights of a rig's rays.

    Args:
        cameras: the rig.
        grid: lines through its inscribed cylinder must be measured.
        max_missing: greatest share of them that may be missing.

    Warns:
        UserWarning: lines through the cylinder that no ray measures, or few in a wide gap, which
            views nearby replace; streaks of few views.

    Raises:
        ValueError: no orbit, see `orbit_of`, or too many lines that no ray measures.
    """
    device, cameras = cameras.source.device, cameras.to("cpu")
    orbit = orbit_of(cameras, grid)
    low, high = _panels(cameras, orbit)
    radius, offset = orbit.cylinder(grid)
    reach = radius + offset.norm().item()
    reach = reach if cameras.parallel else math.asin(min(1.0, reach / orbit.radius))
    field = max(high.max().item(), -low.min().item())
    pixel = (high - low) / cameras.shape[1]
    if (torch.minimum(-low, high) - pixel / 2).max() < 0:
        unit = "mm" if cameras.parallel else "rad"
        raise ValueError(
            f"Filtered back-projection needs a detector that the axis of rotation is projected "
            f"onto, half a pixel inside at least, got one that reaches from "
            f"{low.min().item():.4g} to {high.max().item():.4g} {unit} beside it"
        )
    limit = max(field, reach)
    q = torch.linspace(-limit, limit, 2 * FAN_DISTANCES + 1, dtype=torch.float64)
    # rounding does not make the first view the last one
    start = start_of(orbit)
    angles = torch.deg2rad(orbit.angles) - start + ROUNDING_ERROR
    angles, order = (angles.remainder(FULL_TURN) - ROUNDING_ERROR).sort()
    edge = torch.minimum(q[:, None] - low[order], high[order] - q[:, None])  # [q m]
    branches = _Branches.of(angles, edge, q, cameras.parallel, min(field, reach))
    # values are those of voxels' centres, and between the angles of two views lines are theirs
    usual, _ = usual_steps(gaps_of(angles))
    rim = orbit.cylinder(grid, margin=0.0)[0] * math.cos(usual.max().item() / 2)
    missing = Missing.of(branches.measured, q, orbit, start, rim, offset)
    if missing.hole:
        raise ValueError(f"{missing}, which are inside others that are measured; use sirt")
    if missing.share > max_missing:
        raise ValueError(
            f"{missing}; expected at most {max_missing:.0%} (max_missing): are the angles right? "
            f"Else take a smaller grid, if the object lies within the field, or use sirt"
        )
    near = branches.measured & branches.near
    bridged = Missing.of(near, q, orbit, start, rim, offset)
    if bridged.worst > WARNED_MISSING or bridged.share > WARNED_BEYOND:
        warnings.warn(
            f"{bridged}; expect from these alone errors of several per cent on these lines, of "
            f"tens of per cent where more than 5% at one distance are missing, and of more if the "
            f"object extends beyond the field; see sirt",
            stacklevel=2,
        )
    cells = branches.weights(angles)
    _warn_of_streaks(angles, cells, q, orbit, rim, pixel.min().item())
    weights = torch.empty_like(edge.T)
    weights[order] = cells.T
    # beyond its panel a view's weight continues, for the interpolation at the panel's edge
    seen = (edge > 0).double()
    first, last = seen.argmax(dim=0), len(q) - 1 - seen.flip(0).argmax(dim=0)
    nodes = torch.arange(len(q))[None].expand(len(order), -1)
    inside = torch.empty_like(nodes)
    inside[order] = torch.minimum(torch.maximum(nodes, first[:, None]), last[:, None])
    weights = weights.gather(1, inside)
    middle = weights[:, FAN_DISTANCES, None]
    if (weights - middle).abs().max() <= 1e-9 * middle.max():
        weights = middle
    columns = _columns(cameras, orbit, min(field, reach))
    return RedundancyWeights(orbit, weights, limit, columns).to(device)


def _warn_of_streaks(
    angles: Float[Tensor, " m"],
    weights: Float[Tensor, "q m"],
    q: Float[Tensor, " q"],
    orbit: Orbit,
    radius: float,
    pixel: float,
) -> None:
    """Warn of the streaks of few views: the lines at half of a cylinder's radius in mm, which are
    tangent to a disc, are measured in directions too far apart for the pixels, as fan coordinates
    (Kak and Slaney, Principles of Computerized Tomographic Imaging, 1988, ch. 5.1).
    """
    parallel = orbit.radius == math.inf
    fan = radius / 2 if parallel else math.asin(min(1.0, radius / 2 / orbit.radius))
    fan = min(fan, q[weights.sum(dim=1) > 0].abs().max().item())
    index = int((q - fan).abs().argmin())
    turn, size = (0.0, pixel) if parallel else (q[index].item(), pixel * orbit.radius)
    lines, cells = torch.cat([angles - turn, angles + math.pi + turn]), weights[[index, -1 - index]]
    gaps = gaps_of(lines[cells.flatten() > 0].remainder(FULL_TURN).sort().values)
    usual, _ = usual_steps(gaps)
    gaps = gaps[gaps <= widest_of(torch.minimum(usual, usual.roll(-1)))]
    # the more directions lie near one another, or the more unevenly they are weighted, the wider
    step = max((x.square().sum() / x.sum().clamp_min(1e-300)).item() for x in (gaps, cells))
    blurred = math.sqrt(min(1.0, radius / size / SHARP_PIXELS))
    streaks = STREAKS * blurred * (step - size / (2 * radius)) / math.pi
    if streaks > WARNED_STREAKS:
        warnings.warn(
            f"Too few views for filtered back-projection: lines at {radius / 2:.3g} mm from the "
            f"axis of rotation are measured {math.degrees(step):.3g} degrees apart. Expect streaks "
            f"of about {streaks:.0%} (root mean square) for an object half as wide as the grid's "
            f"{2 * radius:.4g} mm, up to five times as high in single voxels, and more for a "
            f"smaller one; pixels of {size:.3g} mm need {math.degrees(size / radius):.2g} degrees "
            f"for none. Use sirt or fista_tv",
            stacklevel=3,
        )


def _panels(cameras: Cameras, orbit: Orbit) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """The range of fan coordinates that every row of each view covers."""
    rows, columns = cameras.shape
    ends = torch.tensor([-0.5, columns - 0.5], dtype=torch.float64)
    v = torch.tensor([0.0, rows - 1.0], dtype=torch.float64)
    fan = fan_coordinate(cameras, orbit, ends, v)
    return fan.amin(dim=2).amax(dim=1), fan.amax(dim=2).amin(dim=1)


def _columns(cameras: Cameras, orbit: Orbit, field: float) -> tuple[int, int]:
    """Columns before and behind the rows up to the fan coordinates -field and field."""
    zero, row = torch.zeros(1, dtype=torch.float64), (cameras.shape[0] - 1) / 2
    v, tangents = torch.tensor([row], dtype=torch.float64), orbit.tangents
    across = (cameras.u * tangents).sum(dim=-1)
    if cameras.parallel:
        first = fan_coordinate(cameras, orbit, zero, v)[:, 0, 0]
        places = [(q - first) / across for q in (-field, field)]
    else:
        side = -1.0 if cameras.ray_extent[1] > 0 else 1.0  # as in `fan_coordinate`
        start, ahead = cameras.origin - cameras.source, side * orbit.outwards
        a = along(start, cameras, tangents, zero, v)[:, 0, 0]
        b, depth = along(start, cameras, ahead, zero, v)[:, 0, 0], (cameras.u * ahead).sum(dim=-1)
        slopes = (math.tan(q) for q in (-field, field))
        places = [-(side * a + slope * b) / (side * across + slope * depth) for slope in slopes]
    before = -torch.minimum(*places).min().item() - 0.5
    behind = torch.maximum(*places).max().item() - (cameras.shape[1] - 0.5)
    return max(0, math.ceil(before - 0.5)), max(0, math.ceil(behind - 0.5))


@dataclass(frozen=True, eq=False)
class _Branches:
    """The branch of each fan coordinate on a raster of angles.

    Args:
        q: fan coordinates, symmetric about zero.
        share: share of the branch in each line.
        edge: distance of each view's lines from the edges of its panel.
        level: the same of the lines that its neighbours measure, too.
        measured: whether views of this branch or of its conjugate measure the line, a gap of a few
            steps between them included.
        near: the same without gaps that are wide in degrees, or wide for so many views.
    """

    q: Float[Tensor, " q"]
    parallel: bool
    share: Float[Tensor, "q n"]
    edge: Float[Tensor, "q m"]
    level: Float[Tensor, "q m"]
    measured: Bool[Tensor, "q n"]
    near: Bool[Tensor, "q n"]

    @classmethod
    def of(
        cls,
        angles: Float[Tensor, " m"],
        edge: Float[Tensor, "q m"],
        q: Float[Tensor, " q"],
        parallel: bool,
        field: float,
    ) -> "_Branches":
        """From sorted angles in radians, and each view's distance from the edges of its panel."""
        taper = max(MIN_TAPER, 0 if parallel else 4 * field)
        gaps = gaps_of(angles)
        usual, even = usual_steps(gaps)
        count = _raster(len(angles), usual.min().item())
        step = FULL_TURN / count
        places = (torch.arange(count, dtype=torch.float64) + 0.5) * step
        nearest = torch.searchsorted(angles + gaps / 2, places) % len(angles)
        usual, even = usual[nearest], even[nearest]
        most = widest_of(usual)
        named = torch.minimum(most, torch.minimum(usual, even) + NAMED_GAP)
        measured, near = (
            _covered(angles, places, edge > 0, gap, torch.minimum(usual, gap))
            for gap in (most, named)
        )
        edge = edge.clamp_min(0)
        index = (angles / step + 1e-6).long().clamp_max(count - 1).expand_as(edge)
        # a morphological closing in the angle: views that measure a line less deeply than those
        # around them, or not at all, make no gap
        level = edge.new_zeros(len(q), count).scatter_reduce(1, index, edge, "amax")
        level = torch.where(measured, _greatest(level, most / 2 / step + 1), torch.inf)
        level = -_greatest(-level, (most - usual) / 2 / step)
        level = _rounded(torch.where(measured, level, 0), q)
        deepest = _greatest(level, usual / step).gather(1, index)
        # where the other branch has finer steps, it takes the greater share
        level = level * (usual.min() / usual).sqrt()
        reach = (MAX_NEAR_STEPS * usual).clamp_min(MAX_NEAR_ANGLE)
        slope = level.amax(dim=1, keepdim=True).clamp_min(1e-300) / taper
        inside = slope * _eroded(level / slope, step)
        without_gaps = slope * _eroded(torch.where(measured, level / slope, taper), step)
        outside = _eroded(torch.where(measured, 0.0, FULL_TURN), step)
        beside = (2 - outside / reach).clamp(0, 1)
        lines = torch.stack([level, beside, measured.double(), near.double()])
        other, there, *conjugates = _conjugate(lines, q, parallel)
        # where the other branch does not measure a line, this one does not end at a gap
        firmness = torch.where((outside > 2 * reach + 1e-9).any(dim=1), 8.0, 2.0)[:, None]
        firm = (firmness * other / (other + without_gaps).clamp_min(1e-300)).clamp_max(1)
        strength = torch.lerp(without_gaps * beside, inside, firm)
        conjugate = _conjugate(strength, q, parallel)
        ratio = strength / (strength + conjugate).clamp_min(1e-300)
        share = (math.pi / 2 * ratio).sin().square() * torch.maximum(beside, there)
        pairs = zip((measured, near), conjugates, strict=True)
        return cls(q, parallel, share, edge, deepest, *(here | (c > 0.5) for here, c in pairs))

    def weights(self, angles: Float[Tensor, " m"]) -> Float[Tensor, "q m"]:
        """The integral of each branch's share over the cells of its views, in radians."""
        count = self.share.shape[1]
        whole = torch.nn.functional.pad(self.share.cumsum(dim=1) * (FULL_TURN / count), (1, 0))
        place = (angles + gaps_of(angles) / 2) / (FULL_TURN / count)
        turn, place = place.div(count, rounding_mode="floor"), place.remainder(count)
        index = place.floor().long().clamp_max(count - 1)
        upto = torch.lerp(whole[:, index], whole[:, index + 1], place - index)
        upto = upto + turn * whole[:, -1:]
        cells = upto.diff(dim=1, prepend=upto[:, -1:] - whole[:, -1:])
        # a node of fan coordinates apart is as far as any: whatever rounding makes of equal panels
        # changes nothing
        apart = (self.edge - self.edge[:, :1]).abs().max() / (self.q[1] - self.q[0])
        apart = min(apart.item(), 1.0)
        return _distributed(of_exposures(cells, angles), angles, self.edge, self.level, apart)


def _distributed(
    cells: Float[Tensor, "q m"],
    angles: Float[Tensor, " m"],
    edge: Float[Tensor, "q m"],
    level: Float[Tensor, "q m"],
    apart: float,
) -> Float[Tensor, "q m"]:
    """Give the lines of each view's cell to the views near it, the more, the nearer they are and
    the farther from the edge of their panel.

    A neighbour counts only as far as all measure the lines of the cell, so that nothing is blended
    across an angle from which on views have other panels.

    Args:
        cells: angles to be distributed, in radians.
        edge: distance of each view's lines from the edges of its panel.
        level: the greatest distance that counts in its cell.
        apart: how far the panels of the views are apart, from 0 to 1: equal ones keep their cells.
    """
    own = cells * (edge > 0)
    if apart < 1e-9:
        return own
    edge, level = ((x / (PANEL_TAPER * edge.max())).clamp_max(1) for x in (edge, level))
    edge, level = (x.square() * (3 - 2 * x) for x in (edge, level))
    gaps = gaps_of(angles)
    usual, _ = usual_steps(gaps)
    sigma = NEIGHBOUR_STEPS * usual
    width = torch.minimum(gaps, usual) + torch.minimum(gaps.roll(1), usual)
    width = of_exposures(width, angles)
    ahead = torch.cat([angles, angles + FULL_TURN])
    ahead = torch.searchsorted(ahead, angles + NEIGHBOUR_DEVIATIONS * sigma.max() + ROUNDING_ERROR)
    most = int((ahead - torch.arange(1, len(angles) + 1)).max())
    shifts = range(-min(most, (len(angles) - 1) // 2), min(most, (len(angles) - 1) // 2) + 1)

    def claims(shift: int) -> Tensor:
        """Of the views so many places before, on the lines of each cell."""
        apart = (angles.roll(shift) - angles + math.pi).remainder(FULL_TURN) - math.pi
        near = torch.exp(-(apart / sigma).square() / 2) * width.roll(shift)
        return torch.minimum(edge.roll(shift, dims=1), level) * near

    total = torch.zeros_like(cells)
    for shift in shifts:
        total += claims(shift)
    cells, given = cells / total.clamp_min(1e-300), torch.zeros_like(cells)
    for shift in shifts:
        given += (cells * claims(shift)).roll(-shift, dims=1)
    return torch.lerp(own, given, apart)


def _greatest(level: Float[Tensor, "q n"], reach: Float[Tensor, " n"]) -> Float[Tensor, "q n"]:
    """The greatest level within so many places of each, around the circle: of two ranges that cover
    these, as wide as a power of two.
    """
    places, index = reach.round().long(), torch.arange(len(reach))
    most, doublings = int(places.max()), (2 * places + 1).log2().floor().long()
    wide, greatest = torch.nn.functional.pad(level[None], (most, most), mode="circular")[0], level
    for doubling in range(int(doublings.max()) + 1):
        first, last = index + most - places, index + most + places + 1 - 2**doubling
        here = (doublings == doubling).nonzero()[:, 0]
        greatest = greatest.index_copy(
            1, here, torch.maximum(wide[:, first[here]], wide[:, last[here]])
        )
        wide = torch.maximum(wide[:, : -(2**doubling)], wide[:, 2**doubling :])
    return greatest


def _rounded(level: Float[Tensor, "q n"], q: Float[Tensor, " q"]) -> Float[Tensor, "q n"]:
    """Round the level's kinks along q, which the ramp filter would make streaks of.

    Its mean over a part of itself: a linear level stays as it is, and one of zero, too.
    """
    nodes = torch.arange(len(q), dtype=q.dtype)[:, None]
    mean = torch.zeros_like(level)
    for part, weight in ((-0.8, 0.1), (-0.4, 0.2), (0.0, 0.4), (0.4, 0.2), (0.8, 0.1)):
        place = (nodes + ROUNDING * part / (q[1] - q[0]) * level).clamp(0, len(q) - 1)
        before = place.floor().clamp_max(len(q) - 2)
        here, there = (level.gather(0, before.long() + k) for k in (0, 1))
        mean += weight * torch.lerp(here, there, place - before)
    return mean


def _covered(
    angles: Float[Tensor, " m"],
    places: Float[Tensor, " n"],
    seen: Bool[Tensor, "q m"],
    widest: Float[Tensor, " n"],
    usual: Float[Tensor, " n"],
) -> Bool[Tensor, "q n"]:
    """Whether views at sorted angles cover places: those that see a fan coordinate, in gaps between
    them of at most so much, and beside wider ones half of the usual step.
    """
    last, following = (torch.where(seen, angles, far) for far in (-torch.inf, torch.inf))
    last = torch.cat([last - FULL_TURN, last], dim=1).cummax(dim=1).values[:, len(angles) - 1 :]
    following = torch.cat([following, following + FULL_TURN], dim=1).flip(1)
    following = following.cummin(dim=1).values.flip(1)[:, : len(angles) + 1]
    index = torch.searchsorted(angles, places)
    left, right = places - last[:, index], following[:, index] - places
    near = torch.minimum(left, right) <= usual / 2 + 1e-9
    return near | (left + right <= widest + 1e-9)


def _eroded(level: Float[Tensor, "q n"], step: float) -> Float[Tensor, "q n"]:
    """The least sum of a place's level and its distance from here, around the circle.

    For levels of 0 and of more than a turn it is the distance from the nearest place of level 0.
    """
    count = level.shape[1]
    places = torch.arange(3 * count, dtype=torch.float64) * step
    level = level.repeat(1, 3)
    left = places + (level - places).cummin(dim=1).values
    right = (level + places).flip(1).cummin(dim=1).values.flip(1) - places
    return torch.minimum(left, right)[:, count : 2 * count]


def _raster(views: int, usual: float) -> int:
    """The number of angles of the raster of lines: an even number in a usual step, so that cells of
    evenly turned views begin and end between two of them, wherever rounding puts the views.
    """
    least, steps = max(MIN_ANGLES, ANGLES_PER_VIEW * views), round(FULL_TURN / usual)
    return least if steps > least else steps * 2 * math.ceil(least / (2 * steps))


def _conjugate(
    branches: Float[Tensor, "*n q n"], q: Float[Tensor, " q"], parallel: bool
) -> Float[Tensor, "*n q n"]:
    """The values of each line's conjugate branch: at beta + pi - 2 q and -q."""
    count = branches.shape[-1]
    turn = torch.full_like(q, math.pi) - (0 if parallel else 2) * q
    shift = (turn * (count / FULL_TURN))[:, None]
    place = (torch.arange(count) + shift.floor().long()).expand(branches.shape)
    here, there = (branches.flip(-2).gather(-1, (place + k) % count) for k in (0, 1))
    return torch.lerp(here, there, shift - shift.floor())
