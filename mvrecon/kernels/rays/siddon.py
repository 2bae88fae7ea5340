"""Siddon's method on one ray: the exact lengths in the cells that it crosses, taken slab by slab of
the main axis.

R. L. Siddon, Fast calculation of the exact radiological path for a three-dimensional CT array, Med.
Phys. 12, 1985.

Within a slab the ray crosses at most one plane of each other axis, so it meets at most three cells:
no search, no sorting, no state from slab to slab. Cells are half-open: a ray on a face belongs to
the cell above it.
"""

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.summation import fold


@scalar
def reach(low, high, before, per_slope, length):
    """How far into the slab a ray passes from cell `low` to cell `high`; the whole length when it
    stays.
    """
    way = min(max((max(low, high) - before) * per_slope, length * 0), length)
    return way if low != high else length


@scalar
def cells(ray, count, steps, room):
    """Per slab that `summation.visit` has chosen: flat indices of the cells that the ray crosses in
    order, lengths.

    Crossings are found in float64 and rounded last: a ray that is all but along a plane moves its
    crossing by many times what a place is rounded by.
    """
    index0, index1, index2, part0, part1, part2 = (
        room.index,
        room.index_b,
        room.index_c,
        room.one,
        room.two,
        room.three,
    )
    real, whole = part0.dtype.type, index0.dtype.type
    b, slope_b, c, slope_c = ray.b + 0.5, ray.slope_b, ray.c + 0.5, ray.slope_c
    # a ray without slope stays in its cell, and this is never used
    per_b, per_c = 1 / ray.slope_b if ray.slope_b else 0.0, 1 / ray.slope_c if ray.slope_c else 0.0
    begin, end, first = ray.begin, ray.end, ray.centre + 1
    along, far, origin = whole(steps.along), whole(steps.far), whole(steps.origin)
    for i in range(np.uint32(count)):
        s = np.float64(room.four[i])
        s0, s1 = max(begin, s - 0.5), min(end, s + 0.5)
        length = s1 - s0
        y0, z0 = b + s0 * slope_b, c + s0 * slope_c
        b0, b1 = np.int32(y0), np.int32(b + s1 * slope_b)
        c0, c1 = np.int32(z0), np.int32(c + s1 * slope_c)
        to_b = reach(np.float64(b0), np.float64(b1), y0, per_b, length)
        to_c = reach(np.float64(c0), np.float64(c1), z0, per_c, length)
        one, two = min(to_b, to_c), max(to_b, to_c)
        part0[i], part1[i], part2[i] = real(one), real(two - one), real(length - two)
        base = whole(whole(whole(np.int32(s + first)) * along) - origin)
        along_b0, along_b1 = whole(whole(b0) * far), whole(whole(b1) * far)
        index0[i] = whole(base + whole(along_b0 + whole(c0)))
        index1[i] = whole(
            base + whole(along_b1 + whole(c0) if to_b < to_c else along_b0 + whole(c1))
        )
        index2[i] = whole(base + whole(along_b1 + whole(c1)))


@scalar
def sum(store, n, visited, room):
    """The sum of volume n along a ray, in voxels of the main axis; visited = (how many slabs, lead
    of their terms).
    """
    count, lead = visited
    index0, index1, index2, part0, part1, part2 = (
        room.index,
        room.index_b,
        room.index_c,
        room.one,
        room.two,
        room.three,
    )
    flat, offset, terms = store.values, np.uint64(n * store.size), room.terms[lead:]
    for i in range(np.uint32(count)):
        first, middle = flat[np.uint64(index0[i]) + offset], flat[np.uint64(index1[i]) + offset]
        last = flat[np.uint64(index2[i]) + offset]
        terms[i] = part0[i] * first + part1[i] * middle + part2[i] * last
    return fold(room.terms, lead, count)


@scalar
def spread(store, n, count, room, value):
    """Add a value to volume n along a ray with the weights of `sum`: its transpose."""
    index0, index1, index2, part0, part1, part2 = (
        room.index,
        room.index_b,
        room.index_c,
        room.one,
        room.two,
        room.three,
    )
    flat, offset = store.values, np.uint64(n * store.size)
    for i in range(np.uint32(count)):
        flat[np.uint64(index0[i]) + offset] += part0[i] * value
        flat[np.uint64(index1[i]) + offset] += part1[i] * value
        flat[np.uint64(index2[i]) + offset] += part2[i] * value
