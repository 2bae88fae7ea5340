"""Upright views, whose rays of a detector column share all but z, so that slabs are read by whole
rows along z.

If a step between detector rows is along the volume's z axis (every circular orbit about it, every
stack of slices), the rays of a detector column are in one vertical plane: one path through the rows
of voxels, and a height for each ray. In a slab they all meet the same two rows of voxels along z
(joseph) or one or two (siddon). These rows are blended once, as contiguous vectors, and each ray
takes one pair of neighbours from the blend: a third of the work of `loops.py`, less in the
horizontal plane, with the same weights. The volume must be transposed so that z is contiguous, see
`packed_volume.py`.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.cpu import trace
from mvrecon.kernels.rays.cpu.loops import all_zero
from mvrecon.kernels.rays.cpu.packed_volume import Store, store_of
from mvrecon.kernels.rays.lines import DIRECTION, JOSEPH, MOMENT, START
from mvrecon.kernels.rays.occupancy import EDGE

#: Positions of a column's rays along z, from the padding before the first voxel: (at_zero + v
#: per_row) + s (climb + v steeper) of detector row v, at s along the main axis.
Height = namedtuple("Height", ["at_zero", "per_row", "climb", "steeper"])
#: A blend of two rows of voxels: flat index of the lower one, their weights, its range along the
#: main axis.
Piece = namedtuple("Piece", ["index", "low", "high", "begin", "end"])
#: Larger than any volume: a column is not clipped along z.
ENDLESS = 1 << 40


@scalar
def upright(rig, line, axis, u):
    """A column's ray in the horizontal plane, and the `Height` of its rays."""
    pixel, box = trace.from_centre(rig, u, 0), rig.box
    tall = trace.Space(
        rig.window,
        (rig.sizes[0], rig.sizes[1], ENDLESS),
        (box[0], box[1], 0, box[3], box[4], ENDLESS),
    )
    ray = trace.trace(line, axis, 2, pixel, tall, rig.method)
    D = trace.at(line, 0, axis, pixel[0], pixel[1])
    zero = trace.crossing(line, axis, 2, pixel[0], pixel[1])
    per_row = trace.crossing(line, axis, 2, pixel[0], pixel[1] + 1) - zero
    climb = trace.at(line, 0, 2, pixel[0], pixel[1]) / D
    steeper = line[0, 2, 1] / D
    # centres (joseph) or faces (siddon) at whole numbers
    first = (rig.sizes[2] - 1) / 2.0 + (1.0 if rig.method == JOSEPH else 1.5)
    return ray, Height(zero + first, per_row, climb, steeper)


@scalar
def _occupied(rig, axis, k, y):
    """The occupied range along z in slab k of row y of voxels and the next one."""
    if not rig.heights.size:
        return rig.box[2], rig.box[5]
    i, j = k // EDGE, min(max(y, 0), rig.sizes[1 - axis] - 1) // EDGE
    occupied = rig.heights[j, i] if axis == 0 else rig.heights[i, j]
    return max(occupied[0], rig.box[2]), min(occupied[1], rig.box[5])


@scalar
def _put(rig, scratch, count, piece, occupied):
    scratch.index[count] = piece.index
    scratch.pieces[0, count], scratch.pieces[1, count] = piece.low, piece.high
    scratch.pieces[2, count], scratch.pieces[3, count] = piece.begin, piece.end
    if rig.heights.size:
        scratch.occupied[0, count], scratch.occupied[1, count] = occupied[0], occupied[1]


@scalar
def clipped(low, high, span):
    """The part of a span from low to high."""
    return min(max(low, span[0]), span[1]), min(max(high, span[0]), span[1])


@scalar
def within_occupied(rig, scratch, i, span):
    """The part of a span along z that is occupied in piece i."""
    if not rig.heights.size:
        return span
    return clipped(scratch.occupied[0, i], scratch.occupied[1, i], span)


@scalar
def pieces(rig, ray, span, steps, scratch):
    """Write the pieces of a column's path into its scratch, and count them.

    Joseph's and Siddon's method are duplicated here: using the methods' own steps costs 7 to 15 %
    of a projection at 128^3.
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
                _put(rig, scratch, count, Piece(row, low, high, s, s), occupied)
                count += 1
            continue
        y0, y1 = int(ray.b + 0.5 + s0 * ray.slope_b), int(ray.b + 0.5 + s1 * ray.slope_b)
        turn = s1 if y0 == y1 else min(max((max(y0, y1) - 0.5 - ray.b) / ray.slope_b, s0), s1)
        for y, one, two in ((y0, s0, turn), (y1, turn, s1)):
            occupied = _occupied(rig, ray.axis, k, y - 1)
            if two > one and occupied[0] < occupied[1]:
                row = (k + 1) * steps.along + y * steps.far + 1 - steps.origin
                _put(rig, scratch, count, Piece(row, two - one, 0.0, one, two), occupied)
                count += 1
    return count


@scalar
def places(rig, height, begin, end, rays, scratch):
    """Positions of a half-open range of rays in a padded row: the lower neighbour, the upper one's
    share.
    """
    places, shares = scratch.places, scratch.shares
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
    """The half-open range of occupied voxels along z that rays of a column meet at s."""
    step = height.per_row + s * height.steeper
    bottom = height.at_zero + s * height.climb + rays[0] * step
    top = bottom + (rays[1] - 1 - rays[0]) * step
    # two more on each side: the pair of neighbours, and the rounding of single precision
    low, high = min(bottom, top) - 3.0, max(bottom, top) + 3.0
    first, last = clipped(low, high, occupied)
    return int(first), int(last)


def columnar(rig) -> np.ndarray:
    """Whether views [m] of a `Rig` are upright and profit from it; false for explicit rays."""
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


#: Two rows of voxels along z: flat index of the lower one, their weights, the step to the other.
Rows = namedtuple("Rows", ["index", "low", "high", "far"])
#: Consecutive rays add to different rows, so that no addition waits for the previous one.
ROWS = 4


@scalar
def rows_of(scratch, i, real, steps):
    """The two rows of voxels of piece i."""
    low, high = real(scratch.pieces[0, i]), real(scratch.pieces[1, i])
    return Rows(np.int64(scratch.index[i]), low, high, np.int64(steps.far))


@scalar
def _blend(scratch, store, group, rows, span, add):
    """A group's row of the scratch = low * (voxels along z of a row) + high * (those of the next),
    accumulated if `add`.
    """
    row, flat, low, high = scratch.row, store.values, rows.low, rows.high
    first, lanes = np.uint64((group * scratch.width + 1) * store.lanes), store.lanes
    below = np.uint64((group * store.size + rows.index) * lanes)
    above = below + np.uint64(rows.far * lanes)
    for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
        mixed = low * flat[below + z] + high * flat[above + z]
        row[first + z] = mixed + row[first + z] if add else mixed


@scalar
def _read_lanes(scratch, group, rays):
    """`_read` of four adjacent volumes."""
    places, row, shares, sums = scratch.places, scratch.row, scratch.shares, scratch.values[group]
    four, start, one = (
        np.uint64(trace.LANES),
        np.uint64(group * scratch.width * trace.LANES),
        scratch.shares.dtype.type(1),
    )
    for v in range(np.uint32(rays[0]), np.uint32(rays[1])):
        below, place = np.uint64(places[v]) * four + start, np.uint64(v) * four
        value = trace.mix(
            trace.take(row, below), trace.take(row, below + four), shares[v], one - shares[v]
        )
        trace.put(sums, place, trace.more(trace.take(sums, place), one, value))


@scalar
def _read(scratch, lanes, group, rays):
    """Add to a group's values each ray's share of its two neighbours in the group's row."""
    if lanes > 1:
        _read_lanes(scratch, group, rays)
        return
    first = group * scratch.width
    start, count = (
        rays[0],
        np.uint32(rays[1] - rays[0]),
    )  # loops start at zero, which compilers vectorise
    places, pairs, row, parts = (
        scratch.places[start:],
        scratch.pairs[start:],
        scratch.row_pairs,
        scratch.parts[2 * start :],
    )
    shares, sums, one = (
        scratch.shares[start:],
        scratch.values[group][start:],
        scratch.shares.dtype.type(1),
    )
    for v in range(count):
        pairs[v] = row[np.uint64(places[v]) + np.uint64(first)]
    for v in range(count):
        sums[v] += trace.blend(parts[2 * v], parts[2 * v + 1], shares[v], one - shares[v])


#: Memory for one column: flat indices of its pieces, four numbers each, their occupied ranges; per
#: ray its position in a row of voxels, its share of the upper neighbour, its two neighbours whole
#: and in parts; values [g v l]; a blended row [z l]; rows.
Column = namedtuple(
    "Column",
    "index pieces occupied places shares pairs parts values blended row row_pairs width",
)


def column_of(rig: trace.Rig, store: Store, volumes: int) -> Column:
    """Memory for one column of a thread, with zero padded rows."""
    real, lanes, height = store.values.dtype, store.lanes, rig.detector[0]
    length, width = 2 * max(rig.sizes[:2]), rig.sizes[2] + 3
    pairs = np.empty(height, store.pairs.dtype)
    groups = -(-volumes // lanes)
    row, row_pairs, *_ = store_of(np.zeros((1, 1, 1, max(ROWS, groups) * width, lanes), real), 0)
    index, pieces, occupied = (
        np.empty(length, store.strides.dtype),
        np.empty((4, length)),
        np.empty((2, length), np.int64),
    )
    places, shares = np.empty(height, np.uint32), np.empty(height, real)
    values, blended = np.empty((groups, height * lanes), real), np.empty(rig.sizes[2] * lanes, real)
    return Column(
        *(index, pieces, occupied, places, shares, pairs, pairs.view(real), values, blended),
        *(row, row_pairs, width),
    )


@compiled
def project_columns(store, rig, scratch, reads, views, first, last):
    """Add to views [n m v u] the sums of the volumes along columns first to last, counted through
    the views of `Columns`, which is in `trace.py`.
    """
    columns = rig.detector[1]
    volumes, groups, lanes, real = (
        len(views),
        len(scratch.values),
        store.lanes,
        store.values.dtype.type,
    )
    for column in range(first, last):
        m, u = reads.views[column // columns], column % columns
        rays = reads.spans[column // columns, u, 0], reads.spans[column // columns, u, 1]
        if rays[0] >= rays[1]:
            continue
        line, pixel = rig.lines[m], trace.from_centre(rig, u, 0)
        axis = trace.main_axis(line, pixel[0], pixel[1])
        steps = trace.steps_of(rig, store, axis)
        ray, height = upright(rig, line, axis, u)
        count = pieces(rig, ray, (ray.first, ray.last), steps, scratch)
        level = height.climb == 0 and height.steeper == 0
        scratch.values[:] = 0
        for i in range(count):
            span = extent(height, scratch.pieces[2, i], rays, (rig.box[2], rig.box[5]))
            inside = within_occupied(rig, scratch, i, span)
            rows = rows_of(scratch, i, real, steps)
            if not level or i == 0:
                places(rig, height, scratch.pieces[2, i], scratch.pieces[3, i], rays, scratch)
            for group in range(groups):
                if rig.heights.size and (not level or i == 0):
                    first_of_row = np.uint64((group * scratch.width + 1) * lanes)
                    for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
                        scratch.row[first_of_row + z] = 0
                add = level and (i > 0 or rig.heights.size > 0)
                _blend(scratch, store, group, rows, inside, add)
                if not level or i == count - 1:
                    _read(scratch, lanes, group, rays)
        for v in range(rays[0], rays[1] if count else rays[0]):
            length = real(trace.slab_length(line, axis, pixel[0], trace.from_centre(rig, u, v)[1]))
            for n in range(volumes):
                views[n, m, v, u] += length * scratch.values[n // lanes, v * lanes + n % lanes]


@scalar
def _write_lanes(scratch, group, rays):
    """`_write` of four adjacent volumes."""
    places, row, shares, values = scratch.places, scratch.row, scratch.shares, scratch.values[group]
    four, width, one = (
        np.uint64(trace.LANES),
        np.uint32(scratch.width),
        scratch.shares.dtype.type(1),
    )
    for v in range(np.uint32(rays[0]), np.uint32(rays[1])):
        below = np.uint64(places[v] + np.uint32(v % np.uint32(ROWS)) * width) * four
        value = trace.take(values, np.uint64(v) * four)
        trace.put(row, below, trace.more(trace.take(row, below), one - shares[v], value))
        trace.put(row, below + four, trace.more(trace.take(row, below + four), shares[v], value))


@scalar
def _write(scratch, lanes, group, rays):
    """Spread a group's values over `ROWS` rows of neighbours in turn: the transpose of `_read`."""
    if lanes > 1:
        _write_lanes(scratch, group, rays)
        return
    start, count = rays[0], np.uint32(rays[1] - rays[0])
    places, pairs, row, parts = (
        scratch.places[start:],
        scratch.pairs[start:],
        scratch.row_pairs,
        scratch.parts[2 * start :],
    )
    shares, values = scratch.shares[start:], scratch.values[group][start:]
    one, width, lane = scratch.shares.dtype.type(1), np.uint32(scratch.width), np.uint32(start)
    for v in range(count):
        parts[2 * v], parts[2 * v + 1] = values[v] * (one - shares[v]), values[v] * shares[v]
    for v in range(count):
        row[np.uint64(places[v] + np.uint32(np.uint32(v + lane) % np.uint32(ROWS)) * width)] += (
            pairs[v]
        )


@scalar
def _gather(scratch, lanes, span):
    """The sum of the `ROWS` rows, without padding; resets them."""
    flat, blended, width = scratch.row[lanes:], scratch.blended, scratch.width * lanes
    one, two, three, four = flat, flat[width:], flat[2 * width :], flat[3 * width :]
    for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
        blended[z] = (one[z] + two[z]) + (three[z] + four[z])
    for z in range(np.uint32(ROWS * width)):
        scratch.row[z] = 0


@scalar
def _unblend(scratch, store, group, rows, span):
    """Add to two rows of voxels their shares of a row: the transpose of `_blend`."""
    values, flat, low, high, lanes = scratch.blended, store.values, rows.low, rows.high, store.lanes
    below = np.uint64((group * store.size + rows.index) * lanes)
    above = below + np.uint64(rows.far * lanes)
    for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
        flat[below + z] += low * values[z]
    if high != 0:
        for z in range(np.uint32(span[0] * lanes), np.uint32(span[1] * lanes)):
            flat[above + z] += high * values[z]


@scalar
def _not_zero(views, m, u, rays):
    """The half-open range of a column's rays on which a view is not zero.

    Inlined into the loop, it slows back-projection of small volumes down by a third.
    """
    first, last = rays
    while first < last and all_zero(views, m, first, u):
        first += 1
    while first < last and all_zero(views, m, last - 1, u):
        last -= 1
    return first, last


@compiled
def backproject_columns(store, rig, scratch, reads, views, slabs):
    """Spread views [n m v u] into slabs along columns; `Columns` and `Slabs` are in `trace.py`."""
    axis, columns = slabs.axis, rig.detector[1]
    volumes, lanes, real, steps = (
        len(views),
        store.lanes,
        store.values.dtype.type,
        trace.steps_of(rig, store, axis),
    )
    for column in range(len(reads.views) * columns):
        m, u = reads.views[column // columns], column % columns
        line, pixel = rig.lines[m], trace.from_centre(rig, u, 0)
        rays = reads.spans[column // columns, u, 0], reads.spans[column // columns, u, 1]
        if rays[0] >= rays[1] or trace.main_axis(line, pixel[0], pixel[1]) != axis:
            continue
        ray, height = upright(rig, line, axis, u)
        span, rays = trace.within(ray, slabs.low, slabs.high), _not_zero(views, m, u, rays)
        if span[0] >= span[1] or rays[0] >= rays[1]:
            continue
        count = pieces(rig, ray, span, steps, scratch)
        level = height.climb == 0 and height.steeper == 0
        scratch.values[:] = 0
        for v in range(rays[0], rays[1]):
            length = real(trace.slab_length(line, axis, pixel[0], trace.from_centre(rig, u, v)[1]))
            for n in range(volumes):
                scratch.values[n // lanes, v * lanes + n % lanes] = length * views[n, m, v, u]
        for group in range(len(scratch.values)):
            for i in range(count):
                span_z = extent(height, scratch.pieces[2, i], rays, (rig.box[2], rig.box[5]))
                inside = within_occupied(rig, scratch, i, span_z)
                rows = rows_of(scratch, i, real, steps)
                if not level or i == 0:
                    places(rig, height, scratch.pieces[2, i], scratch.pieces[3, i], rays, scratch)
                    _write(scratch, lanes, group, rays)
                    _gather(scratch, lanes, span_z)
                _unblend(scratch, store, group, rows, inside)
