"""Where the rays of an upright detector column run: one way through the rows of voxels, and a
height for each of them.

See `columns.py`, which reads and writes the rows.
"""

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.lines import DIRECTION, MOMENT, START
from mvrecon.kernels.rays.loops import pixel
from mvrecon.kernels.rays.occupancy import EDGE
from mvrecon.kernels.rays.trace import JOSEPH, Space, at, crossing, trace

#: Larger than any volume: a column is not clipped along z.
ENDLESS = 1 << 40


@scalar
def upright(rig, line, axis, u):
    """A column's ray in the level plane, and its height there: z = (A0 + v A1) + s (B0 + v B1) of
    detector row v.
    """
    here, box = pixel(rig, u, 0), rig.box
    tall = Space(
        rig.window,
        (rig.sizes[0], rig.sizes[1], ENDLESS),
        (box[0], box[1], 0, box[3], box[4], ENDLESS),
    )
    ray = trace(line, axis, 2, here, tall, rig.method)
    D = at(line, 0, axis, here[0], here[1])
    zero = crossing(line, axis, 2, here[0], here[1])
    more = crossing(line, axis, 2, here[0], here[1] + 1) - zero
    climb = at(line, 0, 2, here[0], here[1]) / D
    steeper = line[0, 2, 1] / D
    # from the padding in front of the first voxel on, centres (joseph) or faces (siddon) at whole
    # numbers
    first = (rig.sizes[2] - 1) / 2.0 + (1.0 if rig.method == JOSEPH else 1.5)
    return ray, (zero + first, more, climb, steeper)


@scalar
def _held(rig, axis, k, y):
    """From where to where, along z, anything may be in slab k of row y of voxels and the next
    one.
    """
    if not rig.heights.size:
        return rig.box[2], rig.box[5]
    i, j = k // EDGE, min(max(y, 0), rig.sizes[1 - axis] - 1) // EDGE
    held = rig.heights[j, i] if axis == 0 else rig.heights[i, j]
    return max(held[0], rig.box[2]), min(held[1], rig.box[5])


@scalar
def _put(rig, room, count, part, held):
    room.index[count], room.pieces[0, count], room.pieces[1, count] = part[0], part[1], part[2]
    room.pieces[2, count], room.pieces[3, count] = part[3], part[4]
    if rig.heights.size:
        room.held[0, count], room.held[1, count] = held[0], held[1]


@scalar
def within_held(rig, room, i, span):
    """The part of a span along z in which piece i may have anything."""
    if not rig.heights.size:
        return span
    return min(max(span[0], room.held[0, i]), span[1]), max(min(span[1], room.held[1, i]), span[0])


@scalar
def pieces(rig, ray, span, steps, room):
    """Per blend of rows: flat index of the lower row, weights of it and of the next, where it
    begins and ends; held.
    """
    count = 0
    for k in range(span[0], span[1]):
        s = k - ray.centre
        s0, s1 = max(ray.begin, s - 0.5), min(ray.end, s + 0.5)
        if rig.method == JOSEPH:
            y = ray.b + s * ray.slope_b
            held = _held(rig, ray.axis, k, int(y) - 1)
            if held[0] < held[1]:
                row = (k + 1) * steps.along + int(y) * steps.far + 1 - steps.origin
                _put(
                    rig,
                    room,
                    count,
                    (row, (s1 - s0) * (1 - y + int(y)), (s1 - s0) * (y - int(y)), s, s),
                    held,
                )
                count += 1
            continue
        y0, y1 = int(ray.b + 0.5 + s0 * ray.slope_b), int(ray.b + 0.5 + s1 * ray.slope_b)
        turn = s1 if y0 == y1 else min(max((max(y0, y1) - 0.5 - ray.b) / ray.slope_b, s0), s1)
        for y, one, two in ((y0, s0, turn), (y1, turn, s1)):
            held = _held(rig, ray.axis, k, y - 1)
            if two > one and held[0] < held[1]:
                row = (k + 1) * steps.along + y * steps.far + 1 - steps.origin
                _put(rig, room, count, (row, two - one, 0.0, one, two), held)
                count += 1
    return count


@scalar
def places(rig, height, begin, end, rays, room):
    """Where rays = (first, one behind the last) stand in a padded row: the lower neighbour, the
    upper one's share.
    """
    places, shares = room.places, room.shares
    real = shares.dtype.type
    z0, z1 = real(height[0] + begin * height[2]), real(height[0] + end * height[2])
    step0, step1 = real(height[1] + begin * height[3]), real(height[1] + end * height[3])
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
def extent(height, s, rays, held):
    """The voxels along z, first and one behind the last, between which rays of a column lie in one
    place, if held.
    """
    bottom = height[0] + s * height[2] + rays[0] * (height[1] + s * height[3])
    top = bottom + (rays[1] - 1 - rays[0]) * (height[1] + s * height[3])
    # two more on each side: the pair of neighbours, and the rounding of single precision
    low, high = min(bottom, top) - 3.0, max(bottom, top) + 3.0
    return int(min(max(low, held[0]), held[1])), int(min(max(high, held[0]), held[1]))


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
