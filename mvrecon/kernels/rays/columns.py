"""Detector columns that stand upright over the volume: their rays share all but z, so slabs are read as whole rows.

When a step from one detector row to the next runs along the volume's z axis (every circular orbit about it, every
stack of slices), the rays of one detector column lie in one upright plane. In a slab they all meet the same two rows of
voxels along z (joseph) or the same one or two (siddon). These rows are blended once, as contiguous vectors, and each
ray then takes one pair of neighbours out of the blend: a third of the work of `loops.py`, in the level plane not even
that, with the same weights. The volume must be turned so that z is contiguous, see `stores.py`.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.lanes import LANES, mix, more, put, take
from mvrecon.kernels.rays.lines import DIRECTION, MOMENT, START
from mvrecon.kernels.rays.loops import Rig, pixel, steps_of
from mvrecon.kernels.rays.stores import Store
from mvrecon.kernels.rays.stores import store as store_of
from mvrecon.kernels.rays.trace import JOSEPH, at, crossing, main_axis, slab_length, trace, within

#: Rays in turn add to rows of their own, so that no addition waits for the one before.
ROWS = 4
#: Larger than any volume: a column is not clipped along z.
ENDLESS = 1 << 40


@scalar
def _upright(rig, line, axis, u):
    """A column's ray in the level plane, and its height there: z = (A0 + v A1) + s (B0 + v B1) of detector row v."""
    here = pixel(rig, u, 0)
    sizes = (rig.sizes[0], rig.sizes[1], ENDLESS)
    ray = trace(line, axis, 2, here, rig.window, sizes, rig.method)
    D = at(line, 0, axis, here[0], here[1])
    zero = crossing(line, axis, 2, here[0], here[1])
    more = crossing(line, axis, 2, here[0], here[1] + 1) - zero
    climb = at(line, 0, 2, here[0], here[1]) / D
    steeper = line[0, 2, 1] / D
    # from the padding in front of the first voxel on, centres (joseph) or faces (siddon) at whole numbers
    first = (rig.sizes[2] - 1) / 2.0 + (1.0 if rig.method == JOSEPH else 1.5)
    return ray, (zero + first, more, climb, steeper)


@scalar
def _pieces(rig, ray, span, steps, room):
    """Per blend of rows: flat index of the lower row, weights of it and of the next, where it begins and ends."""
    count = 0
    index, low, high, begin, end = room.index, room.pieces[0], room.pieces[1], room.pieces[2], room.pieces[3]
    for k in range(span[0], span[1]):
        s = k - ray.centre
        s0, s1 = max(ray.begin, s - 0.5), min(ray.end, s + 0.5)
        if rig.method == JOSEPH:
            y = ray.b + s * ray.slope_b
            index[count] = (k + 1) * steps.along + int(y) * steps.far + 1
            low[count], high[count] = (s1 - s0) * (1 - y + int(y)), (s1 - s0) * (y - int(y))
            begin[count] = end[count] = s
            count += 1
            continue
        y0, y1 = int(ray.b + 0.5 + s0 * ray.slope_b), int(ray.b + 0.5 + s1 * ray.slope_b)
        turn = s1 if y0 == y1 else min(max((max(y0, y1) - 0.5 - ray.b) / ray.slope_b, s0), s1)
        for y, one, two in ((y0, s0, turn), (y1, turn, s1)):
            if two > one:
                index[count] = (k + 1) * steps.along + y * steps.far + 1
                low[count], high[count], begin[count], end[count] = two - one, 0, one, two
                count += 1
    return count


@scalar
def _places(rig, height, begin, end, room):
    """Where each ray of a column stands in a padded row: the lower neighbour, and the upper one's share."""
    places, shares = room.places, room.shares
    real = shares.dtype.type
    z0, z1 = real(height[0] + begin * height[2]), real(height[0] + end * height[2])
    step0, step1 = real(height[1] + begin * height[3]), real(height[1] + end * height[3])
    zero, top, one = real(0), real(rig.sizes[2] + 1), real(1)
    if rig.method == JOSEPH:
        for v in range(np.uint32(len(shares))):
            z = min(max(z0 + real(np.int32(v)) * step0, zero), top)
            places[v] = np.uint32(np.int32(z))
            shares[v] = z - real(np.int32(z))
        return
    least = real(1e-30)
    for v in range(np.uint32(len(shares))):
        one_end, other = z0 + real(np.int32(v)) * step0, z1 + real(np.int32(v)) * step1
        lower, upper = min(one_end, other), max(one_end, other)
        cell = np.int32(min(max(lower, zero), top))
        above = (upper - real(cell) - one) / max(upper - lower, least)
        places[v] = np.uint32(cell)
        shares[v] = min(max(above, zero), one)


@scalar
def _extent(height, s, rows, size):
    """The voxels along z, first and one behind the last, between which the rays of a column lie in one place."""
    bottom = height[0] + s * height[2]
    top = bottom + (rows - 1) * (height[1] + s * height[3])
    # two more on each side: the pair of neighbours, and the rounding of single precision
    low, high = min(bottom, top) - 3.0, max(bottom, top) + 3.0
    return int(min(max(low, 0.0), size)), int(min(max(high, 0.0), size))


@scalar
def _blend(room, store, group, k, weights, span, add):
    """A group's row of the room = low * (voxels along z at k) + high * (those of the next row), added where `add`."""
    row, flat, low, high = room.row, store.values, weights[0], weights[1]
    first, lanes = np.uint64((group * room.width + 1) * store.lanes), store.lanes
    below = np.uint64(k * lanes)
    above = below + np.uint64(weights[2] * lanes)
    for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
        blend = low * flat[below + z] + high * flat[above + z]
        row[first + z] = blend + row[first + z] if add else blend


@scalar
def _read_lanes(room, group):
    """`_read` of four volumes side by side."""
    places, row, shares, sums = room.places, room.row, room.shares, room.values[group]
    four, start, one = np.uint64(LANES), np.uint64(group * room.width * LANES), room.shares.dtype.type(1)
    for v in range(np.uint32(len(shares))):
        below, here = np.uint64(places[v]) * four + start, np.uint64(v) * four
        value = mix(take(row, below), take(row, below + four), shares[v])
        put(sums, here, more(take(sums, here), one, value))


@scalar
def _read(room, lanes, group):
    """Add to a group's values each ray's share of its two neighbours in the group's row."""
    if lanes > 1:
        _read_lanes(room, group)
        return
    first = group * room.width
    places, pairs, row, parts = room.places, room.pairs, room.row_pairs, room.parts
    shares, sums = room.shares, room.values[group]
    for v in range(np.uint32(len(shares))):
        pairs[v] = row[np.uint64(places[v]) + np.uint64(first)]
    for v in range(np.uint32(len(shares))):
        sums[v] += parts[2 * v] + shares[v] * (parts[2 * v + 1] - parts[2 * v])


#: Room for one column: flat indices of its pieces, four numbers each; per ray its place in a row of voxels, its share
#: of the upper neighbour, its two neighbours whole and in their parts; values [g v l]; a blended row [z l]; rows.
Column = namedtuple(
    "Column",
    ["index", "pieces", "places", "shares", "pairs", "parts", "values", "blended", "row", "row_pairs", "width"],
)


def column_of(rig: Rig, store: Store, volumes: int) -> Column:
    """Room for one column of a thread, its padded rows empty."""
    real, lanes, height = store.values.dtype, store.lanes, rig.detector[0]
    length, width = 2 * max(rig.sizes[:2]), rig.sizes[2] + 3
    pairs = np.empty(height, store.pairs.dtype)
    groups = -(-volumes // lanes)
    row, row_pairs, *_ = store_of(np.zeros((1, 1, 1, max(ROWS, groups) * width, lanes), real), 0)
    index, pieces = np.empty(length, store.strides.dtype), np.empty((4, length))
    places, shares = np.empty(height, np.uint32), np.empty(height, real)
    values, blended = np.empty((groups, height * lanes), real), np.empty(rig.sizes[2] * lanes, real)
    return Column(index, pieces, places, shares, pairs, pairs.view(real), values, blended, row, row_pairs, width)


@compiled
def project_columns(store, rig, room, chosen, views, first, last):
    """Add to views [n m v u] the sums of the volumes along the chosen views' columns first to last, counted in one."""
    rows, columns = rig.detector
    volumes, groups, lanes, real = len(views), len(room.values), store.lanes, store.values.dtype.type
    for column in range(first, last):
        m, u = chosen[column // columns], column % columns
        line, here = rig.lines[m], pixel(rig, u, 0)
        axis = main_axis(line, here[0], here[1])
        steps = steps_of(rig, store, axis)
        ray, height = _upright(rig, line, axis, u)
        count = _pieces(rig, ray, (ray.first, ray.last), steps, room)
        level = height[2] == 0 and height[3] == 0
        room.values[:] = 0
        for i in range(count):
            span = _extent(height, room.pieces[2, i], rows, rig.sizes[2])
            weights = real(room.pieces[0, i]), real(room.pieces[1, i]), np.int64(steps.far)
            if not level or i == 0:
                _places(rig, height, room.pieces[2, i], room.pieces[3, i], room)
            for group in range(groups):
                k = group * store.size + np.int64(room.index[i])
                _blend(room, store, group, k, weights, span, level and i > 0)
                if not level or i == count - 1:
                    _read(room, lanes, group)
        for v in range(rows):
            length = real(slab_length(line, axis, here[0], v - (rows - 1) / 2))
            for n in range(volumes):
                views[n, m, v, u] += length * room.values[n // lanes, v * lanes + n % lanes]


@scalar
def _write_lanes(room, group):
    """`_write` of four volumes side by side."""
    places, row, shares, values = room.places, room.row, room.shares, room.values[group]
    four, width, one = np.uint64(LANES), np.uint32(room.width), room.shares.dtype.type(1)
    for v in range(np.uint32(len(shares))):
        below = np.uint64(places[v] + np.uint32(v % np.uint32(ROWS)) * width) * four
        given = take(values, np.uint64(v) * four)
        put(row, below, more(take(row, below), one - shares[v], given))
        put(row, below + four, more(take(row, below + four), shares[v], given))


@scalar
def _write(room, lanes, group):
    """Spread a group's values over `ROWS` rows of neighbours in turn: the transpose of `_read`."""
    if lanes > 1:
        _write_lanes(room, group)
        return
    places, pairs, row, parts = room.places, room.pairs, room.row_pairs, room.parts
    shares, values, one, width = room.shares, room.values[group], room.shares.dtype.type(1), np.uint32(room.width)
    for v in range(np.uint32(len(shares))):
        parts[2 * v], parts[2 * v + 1] = values[v] * (one - shares[v]), values[v] * shares[v]
    for v in range(np.uint32(len(shares))):
        row[np.uint64(places[v] + np.uint32(v % np.uint32(ROWS)) * width)] += pairs[v]


@scalar
def _gather(room, lanes, span):
    """The sum of the `ROWS` rows, without their padding; they are empty then."""
    flat, blended, width = room.row[lanes:], room.blended, room.width * lanes
    one, two, three, four = flat, flat[width:], flat[2 * width :], flat[3 * width :]
    for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
        blended[z] = (one[z] + two[z]) + (three[z] + four[z])
    for z in range(np.uint32(ROWS * width)):
        room.row[z] = 0


@scalar
def _unblend(room, store, k, weights, span):
    """Add to two rows of voxels their shares of a row: the transpose of `_blend`."""
    given, flat, low, high, lanes = room.blended, store.values, weights[0], weights[1], store.lanes
    below = np.uint64(k * lanes)
    above = below + np.uint64(weights[2] * lanes)
    for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
        flat[below + z] += low * given[z]
    if high != 0:
        for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
            flat[above + z] += high * given[z]


@compiled
def backproject_columns(store, rig, room, reads, views, low, high):
    """Spread views [n m v u] into the slabs [low, high) of the store, for some upright views and one main axis."""
    chosen, axis = reads
    rows, columns = rig.detector
    volumes, lanes, real, steps = len(views), store.lanes, store.values.dtype.type, steps_of(rig, store, axis)
    for column in range(len(chosen) * columns):
        m, u = chosen[column // columns], column % columns
        line, here = rig.lines[m], pixel(rig, u, 0)
        if main_axis(line, here[0], here[1]) != axis:
            continue
        ray, height = _upright(rig, line, axis, u)
        span = within(ray, low, high)
        if span[0] >= span[1]:
            continue
        count = _pieces(rig, ray, span, steps, room)
        level = height[2] == 0 and height[3] == 0
        room.values[:] = 0
        for v in range(rows):
            length = real(slab_length(line, axis, here[0], v - (rows - 1) / 2))
            for n in range(volumes):
                room.values[n // lanes, v * lanes + n % lanes] = length * views[n, m, v, u]
        for group in range(len(room.values)):
            for i in range(count):
                extent = _extent(height, room.pieces[2, i], rows, rig.sizes[2])
                weights = real(room.pieces[0, i]), real(room.pieces[1, i]), np.int64(steps.far)
                if not level or i == 0:
                    _places(rig, height, room.pieces[2, i], room.pieces[3, i], room)
                    _write(room, lanes, group)
                    _gather(room, lanes, extent)
                _unblend(room, store, group * store.size + np.int64(room.index[i]), weights, extent)


def columnar(rig) -> np.ndarray:
    """Which views [m] of a `Rig` stand upright over the volume, and gain by it; never those of explicit rays."""
    rows, columns = rig.detector
    if rig.lines.shape[3] != 3 or rows < 8 or rig.sizes[2] < 8 or 2 * rows < rig.sizes[2]:
        return np.zeros(len(rig.lines), bool)
    direction, moment, start = rig.lines[:, DIRECTION], rig.lines[:, MOMENT], rig.lines[:, START]
    u, v = np.arange(columns) - (columns - 1) / 2, np.array([-0.5, 0.5]) * (rows - 1)
    level = np.abs(direction[:, :2, 0, None] * u + direction[:, :2, 2, None]).max(axis=1).min(axis=1)
    climb = direction[:, 2, 0, None, None] * u + direction[:, 2, 1, None, None] * v[:, None]
    climb = np.abs(climb + direction[:, 2, 2, None, None]).max(axis=(1, 2))
    tilt = np.concatenate([direction[:, :2, 1], start[:, :2, 1], moment[:, 2:, 1]], axis=1)
    scale = np.abs(direction).max(axis=(1, 2)) * (1 + np.abs(start).max(axis=(1, 2)))
    return (climb < 0.999 * level) & (np.abs(tilt).max(axis=1) * rows < 1e-13 * scale)
