"""Siddon's method on one ray of the CPU, its cells in a room; the step is `methods/siddon.py`."""

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cpu.summation import fold
from mvrecon.kernels.rays.methods import siddon as step


@scalar
def crossed(room):
    """Of the three cells that a ray may cross in a slab: flat indices, and lengths in them."""
    return room.index, room.index_b, room.index_c, room.one, room.two, room.three


@scalar
def cells(ray, count, steps, room):
    """Per slab that `summation.visit` has chosen: flat indices of the cells that the ray crosses in
    order, lengths.

    Crossings are found in float64 and rounded last: a ray that is all but along a plane moves its
    crossing by many times what a place is rounded by.
    """
    index0, index1, index2, part0, part1, part2 = crossed(room)
    real, whole = part0.dtype.type, index0.dtype.type
    course = step.course_of(ray, np.float64)
    for i in range(np.uint32(count)):
        s = np.float64(room.four[i])
        passage = step.crossing(course, s, np.float64)
        one, two, three = step.lengths(passage)
        part0[i], part1[i], part2[i] = real(one), real(two), real(three)
        k = np.int32(s + course.centre)
        index0[i], index1[i], index2[i] = step.three(steps, k, passage, whole)


@scalar
def sum(store, n, visited, room):
    """The sum of volume n along a ray, in voxels of the main axis; visited = (how many slabs, lead
    of their terms).
    """
    count, lead = visited
    index0, index1, index2, part0, part1, part2 = crossed(room)
    flat, offset, terms = store.values, np.uint64(n * store.size), room.terms[lead:]
    for i in range(np.uint32(count)):
        first, middle = flat[np.uint64(index0[i]) + offset], flat[np.uint64(index1[i]) + offset]
        last = flat[np.uint64(index2[i]) + offset]
        terms[i] = part0[i] * first + part1[i] * middle + part2[i] * last
    return fold(room.terms, lead, count)


@scalar
def spread(store, n, count, room, value):
    """Add a value to volume n along a ray with the weights of `sum`: its transpose."""
    index0, index1, index2, part0, part1, part2 = crossed(room)
    flat, offset = store.values, np.uint64(n * store.size)
    for i in range(np.uint32(count)):
        flat[np.uint64(index0[i]) + offset] += part0[i] * value
        flat[np.uint64(index1[i]) + offset] += part1[i] * value
        flat[np.uint64(index2[i]) + offset] += part2[i] * value
