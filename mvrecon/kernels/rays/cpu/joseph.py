"""Joseph's method on one ray of the CPU, its cells in a room; the step is `methods/joseph.py`.

`cells` writes where the ray goes; `sum`, `spread` and `slopes` read it. The two corners of a cell
that lie beside each other in memory are fetched as one complex number, and all arithmetic is left
to loops without gathers, which every CPU vectorises.
"""

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cpu.lanes import LANES, between, mix, more, plus, put, take, times
from mvrecon.kernels.rays.cpu.summation import fold
from mvrecon.kernels.rays.methods import joseph as step
from mvrecon.kernels.rays.methods.strides import flat_index
from mvrecon.kernels.rays.pose_gradient import Slopes


@scalar
def cells(ray, count, steps, room):
    """Per slab that `summation.visit` has chosen: flat index of a bilinear cell, place in it
    towards b and c, length.
    """
    index, y, z, share, slab = room.index, room.one, room.two, room.three, room.four
    real, whole = y.dtype.type, index.dtype.type
    course, half = step.course_of(ray, real), real(0.5)
    for i in range(np.uint32(count)):
        s = slab[i]
        iy, iz, y[i], z[i] = step.cell(course, s, real)
        share[i] = step.overlap(course.begin, course.end, s, half)
        index[i] = flat_index(steps, np.int32(s + course.centre), iy, iz, whole)


@scalar
def fetch(pairs, offset, far, count, room):
    """The two pairs of corners of every cell, as complex numbers."""
    index, low, high = room.index, room.low, room.high
    above = np.uint64(offset) + np.uint64(far)
    for i in range(np.uint32(count)):
        k = np.uint64(index[i])
        low[i], high[i] = pairs[k + np.uint64(offset)], pairs[k + above]


@scalar
def sum(store, n, steps, visited, room):
    """The sum of volume n along a ray, in voxels of the main axis; visited = (how many cells, lead
    of their terms).
    """
    count, lead = visited
    fetch(store.pairs, n * store.size, steps.far, count, room)
    y, z, share, low, high = room.one, room.two, room.three, room.low_parts, room.high_parts
    terms, one = room.terms[lead:], y.dtype.type(1)
    for i in range(np.uint32(count)):
        rest = one - z[i]
        lower = between(low[2 * i], low[2 * i + 1], z[i], rest)
        upper = between(high[2 * i], high[2 * i + 1], z[i], rest)
        terms[i] = share[i] * between(lower, upper, y[i], one - y[i])
    return fold(room.terms, lead, count)


@scalar
def spread(store, n, steps, count, room, value):
    """Add a value to volume n along a ray with the weights of `sum`: its transpose."""
    y, z, share, low, high = room.one, room.two, room.three, room.low_parts, room.high_parts
    one = y.dtype.type(1)
    for i in range(np.uint32(count)):
        both, rest = value * share[i], one - z[i]
        lower, upper = both * (one - y[i]), both * y[i]
        low[2 * i], low[2 * i + 1] = lower * rest, lower * z[i]
        high[2 * i], high[2 * i + 1] = upper * rest, upper * z[i]
    pairs, index, lowers, uppers = store.pairs, room.index, room.low, room.high
    offset, above = np.uint64(n * store.size), np.uint64(n * store.size) + np.uint64(steps.far)
    for i in range(np.uint32(count)):
        k = np.uint64(index[i])
        pairs[k + offset] += lowers[i]
        pairs[k + above] += uppers[i]


@scalar
def sum_lanes(store, group, steps, count, room):
    """The sums of four volumes along a ray, in voxels of the main axis, into room.totals."""
    index, y, z, share, values = room.index, room.one, room.two, room.three, store.values
    first, four = np.uint64(group * store.size) * np.uint64(LANES), np.uint64(LANES)
    far, none, one = np.uint64(steps.far) * four, y.dtype.type(0), y.dtype.type(1)
    totals = (none, none, none, none)
    for i in range(np.uint32(count)):
        k, rest = np.uint64(index[i]) * four + first, one - z[i]
        lower = mix(take(values, k), take(values, k + four), z[i], rest)
        upper = mix(take(values, k + far), take(values, k + far + four), z[i], rest)
        totals = plus(totals, times(share[i], mix(lower, upper, y[i], one - y[i])))
    put(room.totals, np.uint64(0), totals)


@scalar
def spread_lanes(store, group, steps, count, room):
    """Add room.totals to four volumes along a ray: the transpose of `sum_lanes`."""
    index, y, z, share, values = room.index, room.one, room.two, room.three, store.values
    first, four = np.uint64(group * store.size) * np.uint64(LANES), np.uint64(LANES)
    far, totals, one = np.uint64(steps.far) * four, take(room.totals, np.uint64(0)), y.dtype.type(1)
    for i in range(np.uint32(count)):
        k, rest = np.uint64(index[i]) * four + first, one - z[i]
        low, high = share[i] * (one - y[i]), share[i] * y[i]
        put(values, k, more(take(values, k), low * rest, totals))
        put(values, k + four, more(take(values, k + four), low * z[i], totals))
        put(values, k + far, more(take(values, k + far), high * rest, totals))
        put(values, k + far + four, more(take(values, k + far + four), high * z[i], totals))


@scalar
def slopes(store, n, steps, count, room, ray):
    """How a ray's `sum` changes with its place, as `pose_gradient.Slopes`."""
    fetch(store.pairs, n * store.size, steps.far, count, room)
    y, z, share, slab, low, high = (
        room.one,
        room.two,
        room.three,
        room.four,
        room.low_parts,
        room.high_parts,
    )
    real = y.dtype.type
    course, none = step.course_of(ray, real), real(0)
    sums = Slopes(none, none, none, none, none, none, none)
    for i in range(np.uint32(count)):
        place = step.face(low[2 * i], low[2 * i + 1], high[2 * i], high[2 * i + 1], y[i], z[i])
        sums = step.bent(sums, course, slab[i], share[i], place)
    return step.in_double(sums)
