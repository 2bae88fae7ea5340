"""Where the rays of an upright detector column run: one way through the rows of voxels, and a
height for each of them.

See `columns.py`, which reads and writes the rows.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.lines import DIRECTION, MOMENT, START
from mvrecon.kernels.rays.occupancy import EDGE
from mvrecon.kernels.rays.trace import JOSEPH, Space, at, crossing, from_centre, trace

#: Where the rays of a column are along z, from the padding in front of the first voxel on:
#: (at_zero + v per_row) + s (climb + v steeper) of detector row v, at s along the main axis.
Height = namedtuple("Height", ["at_zero", "per_row", "climb", "steeper"])
#: A blend of two rows of voxels: flat index of the lower one, their weights, where along the main
#: axis it begins and ends.
Piece = namedtuple("Piece", ["index", "low", "high", "begin", "end"])
#: Larger than any volume: a column is not clipped along z.
ENDLESS = 1 << 40


@scalar
def upright(rig, line, axis, u):
    """A column's ray in the level plane, and the `Height` of its rays."""
    pixel, box = from_centre(rig, u, 0), rig.box
    tall = Space(
        rig.window,
        (rig.sizes[0], rig.sizes[1], ENDLESS),
        (box[0], box[1], 0, box[3], box[4], ENDLESS),
    )
    ray = trace(line, axis, 2, pixel, tall, rig.method)
    D = at(line, 0, axis, pixel[0], pixel[1])
    zero = crossing(line, axis, 2, pixel[0], pixel[1])
    per_row = crossing(line, axis, 2, pixel[0], pixel[1] + 1) - zero
    climb = at(line, 0, 2, pixel[0], pixel[1]) / D
    steeper = line[0, 2, 1] / D
    # centres (joseph) or faces (siddon) at whole numbers
    first = (rig.sizes[2] - 1) / 2.0 + (1.0 if rig.method == JOSEPH else 1.5)
    return ray, Height(zero + first, per_row, climb, steeper)


@scalar
def _occupied(rig, axis, k, y):
    """From where to where, along z, anything may be in slab k of row y of voxels and the next
    one.
    """
    if not rig.heights.size:
        return rig.box[2], rig.box[5]
    i, j = k // EDGE, min(max(y, 0), rig.sizes[1 - axis] - 1) // EDGE
    occupied = rig.heights[j, i] if axis == 0 else rig.heights[i, j]
    return max(occupied[0], rig.box[2]), min(occupied[1], rig.box[5])


@scalar
def _put(rig, room, count, piece, occupied):
    room.index[count] = piece.index
    room.pieces[0, count], room.pieces[1, count] = piece.low, piece.high
    room.pieces[2, count], room.pieces[3, count] = piece.begin, piece.end
    if rig.heights.size:
        room.occupied[0, count], room.occupied[1, count] = occupied[0], occupied[1]


@scalar
def clipped(low, high, span):
    """The part of a span from low to high."""
    return min(max(low, span[0]), span[1]), min(max(high, span[0]), span[1])


@scalar
def within_occupied(rig, room, i, span):
    """The part of a span along z in which piece i may have anything."""
    if not rig.heights.size:
        return span
    return clipped(room.occupied[0, i], room.occupied[1, i], span)


@scalar
def pieces(rig, ray, span, steps, room):
    """Write the pieces of a column's way into its room, and count them.

    Joseph's and Siddon's method split here once more: their steps at one height, in two places,
    instead of those of `methods/` cost 7 to 15 % of a projection at 128^3.
    """
    count = 0
    for k in range(span[0], span[1]):
        s = k - ray.centre
        s0, s1 = max(ray.begin, s - 0.5), min(ray.end, s + 0.5)
        if rig.method == JOSEPH:
            y = ray.b + s * ray.slope_b
            occupied = _occupied(rig, ray.axis, k, int(y) - 1)
            if occupied[0] < occupied[1]:
                row = (k + 1) * steps.along + int(y) * steps.far + 1 - steps.origin
                low, high = (s1 - s0) * (1 - y + int(y)), (s1 - s0) * (y - int(y))
                _put(rig, room, count, Piece(row, low, high, s, s), occupied)
                count += 1
            continue
        y0, y1 = int(ray.b + 0.5 + s0 * ray.slope_b), int(ray.b + 0.5 + s1 * ray.slope_b)
        turn = s1 if y0 == y1 else min(max((max(y0, y1) - 0.5 - ray.b) / ray.slope_b, s0), s1)
        for y, one, two in ((y0, s0, turn), (y1, turn, s1)):
            occupied = _occupied(rig, ray.axis, k, y - 1)
            if two > one and occupied[0] < occupied[1]:
                row = (k + 1) * steps.along + y * steps.far + 1 - steps.origin
                _put(rig, room, count, Piece(row, two - one, 0.0, one, two), occupied)
                count += 1
    return count


@scalar
def places(rig, height, begin, end, rays, room):
    """Where rays = (first, one behind the last) stand in a padded row: the lower neighbour, the
    upper one's share.
    """
    places, shares = room.places, room.shares
    real = shares.dtype.type
    z0 = real(height.at_zero + begin * height.climb)
    z1 = real(height.at_zero + end * height.climb)
    step0 = real(height.per_row + begin * height.steeper)
    step1 = real(height.per_row + end * height.steeper)
    zero, top, one = real(0), real(rig.sizes[2] + 1), real(1)
    if rig.method == JOSEPH:
        for v in range(np.uint32(rays[0]), np.uint32(rays[1])):
            z = min(max(z0 + real(np.int32(v)) * step0, zero), top)
            places[v] = np.uint32(np.int32(z))
            shares[v] = z - real(np.int32(z))
        return
    least = real(1e-30)
    for v in range(np.uint32(rays[0]), np.uint32(rays[1])):
        one_end, other = z0 + real(np.int32(v)) * step0, z1 + real(np.int32(v)) * step1
        lower, upper = min(one_end, other), max(one_end, other)
        cell = np.int32(min(max(lower, zero), top))
        above = (upper - real(cell) - one) / max(upper - lower, least)
        places[v] = np.uint32(cell)
        shares[v] = min(max(above, zero), one)


@scalar
def extent(height, s, rays, occupied):
    """The voxels along z, first and one behind the last, between which rays of a column lie in one
    place, of those that are occupied.
    """
    step = height.per_row + s * height.steeper
    bottom = height.at_zero + s * height.climb + rays[0] * step
    top = bottom + (rays[1] - 1 - rays[0]) * step
    # two more on each side: the pair of neighbours, and the rounding of single precision
    low, high = min(bottom, top) - 3.0, max(bottom, top) + 3.0
    first, last = clipped(low, high, occupied)
    return int(first), int(last)


def columnar(rig) -> np.ndarray:
    """Which views [m] of a `Rig` stand upright over the volume, and gain by it; never those of
    explicit rays.
    """
    rows, columns = rig.detector
    if rig.lines.shape[3] != 3 or rows < 8 or rig.sizes[2] < 8 or 2 * rows < rig.sizes[2]:
        return np.zeros(len(rig.lines), bool)
    direction, moment, start = rig.lines[:, DIRECTION], rig.lines[:, MOMENT], rig.lines[:, START]
    u, v = np.arange(columns) - (columns - 1) / 2, np.array([-0.5, 0.5]) * (rows - 1)
    level = (
        np.abs(direction[:, :2, 0, None] * u + direction[:, :2, 2, None]).max(axis=1).min(axis=1)
    )
    climb = direction[:, 2, 0, None, None] * u + direction[:, 2, 1, None, None] * v[:, None]
    climb = np.abs(climb + direction[:, 2, 2, None, None]).max(axis=(1, 2))
    tilt = np.concatenate([direction[:, :2, 1], start[:, :2, 1], moment[:, 2:, 1]], axis=1)
    scale = np.abs(direction).max(axis=(1, 2)) * (1 + np.abs(start).max(axis=(1, 2)))
    return (climb < 0.999 * level) & (np.abs(tilt).max(axis=1) * rows < 1e-13 * scale)
