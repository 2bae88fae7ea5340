"""Siddon's method: the exact lengths in the cells that a ray crosses in a slab of the main axis.

R. L. Siddon, Fast calculation of the exact radiological path for a three-dimensional CT array, Med.
Phys. 12, 1985.

Within a slab the ray crosses at most one plane of each other axis, hence at most three cells,
without search, sorting, or state between slabs. Cells are half-open: a ray on a face belongs to the
cell above it. `real` and `whole` are the types of weights and of flat indices.
"""

from typing import Any, NamedTuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cpu.trace import Slopes, flat_index, fold


class Course(NamedTuple):
    """The course of a ray, see `trace.Ray`, relative to faces, and its inverse slopes."""

    b: Any
    slope_b: Any
    per_b: Any
    c: Any
    slope_c: Any
    per_c: Any
    begin: Any
    end: Any
    centre: Any


class Passage(NamedTuple):
    """A ray's start in a slab, its length there, its distance to the plane between the cells b0 and
    b1 along the far axis, and to that between c0 and c1 along the near one.
    """

    begin: Any
    length: Any
    to_b: Any
    to_c: Any
    b0: Any
    b1: Any
    c0: Any
    c1: Any


@scalar
def course_of(ray, real):
    """The course of a ray; without slope it stays in its cell, and 1 / slope is not used."""
    half, one, none = real(0.5), real(1), real(0)
    b, slope_b, c, slope_c = (
        real(ray.b) + half,
        real(ray.slope_b),
        real(ray.c) + half,
        real(ray.slope_c),
    )
    per_b, per_c = one / slope_b if slope_b else none, one / slope_c if slope_c else none
    return Course(
        *(b, slope_b, per_b, c, slope_c, per_c),
        *(real(ray.begin), real(ray.end), real(ray.centre)),
    )


@scalar
def reach(low, high, before, per_slope, length):
    """Distance in the slab from entering to passing from cell `low` to cell `high`; the whole
    length if it does not.
    """
    way = min(max((max(low, high) - before) * per_slope, length * 0), length)
    return way if low != high else length


@scalar
def crossing(course, s, real):
    """The plane crossings of a ray in the slab about s."""
    half = real(0.5)
    s0, s1 = max(course.begin, s - half), min(course.end, s + half)
    length = s1 - s0
    y, z = course.b + s0 * course.slope_b, course.c + s0 * course.slope_c
    b0, b1 = np.int32(y), np.int32(course.b + s1 * course.slope_b)
    c0, c1 = np.int32(z), np.int32(course.c + s1 * course.slope_c)
    to_b = reach(real(b0), real(b1), y, course.per_b, length)
    to_c = reach(real(c0), real(c1), z, course.per_c, length)
    return Passage(s0, length, to_b, to_c, b0, b1, c0, c1)


@scalar
def lengths(passage):
    """A ray's lengths in the cells that it crosses, in order."""
    one, two = min(passage.to_b, passage.to_c), max(passage.to_b, passage.to_c)
    return one, two - one, passage.length - two


@scalar
def three(steps, k, passage, whole):
    """Flat indices of the cells that a ray crosses in slab k, in order."""
    middle = (
        flat_index(steps, k, passage.b1, passage.c0, whole)
        if passage.to_b < passage.to_c
        else flat_index(steps, k, passage.b0, passage.c1, whole)
    )
    return (
        flat_index(steps, k, passage.b0, passage.c0, whole),
        middle,
        flat_index(steps, k, passage.b1, passage.c1, whole),
    )


@scalar
def slopes(store, n, ray, steps):
    """Derivatives of a ray's sum by its position, as `trace.Slopes`: at each plane the difference
    of the two cells.
    """
    flat, offset, course = store.values, np.int64(n * store.size), course_of(ray, np.float64)
    total = by_b = by_slope_b = by_c = by_slope_c = at_begin = at_end = 0.0
    for k in range(ray.first, ray.last):
        passage = crossing(course, k - ray.centre, np.float64)
        index, parts = three(steps, k, passage, np.int64), lengths(passage)
        first_cell, middle, last_cell = (
            flat[offset + index[0]],
            flat[offset + index[1]],
            flat[offset + index[2]],
        )
        total += parts[0] * first_cell + parts[1] * middle + parts[2] * last_cell
        # without a crossing both cells are the same
        first, last = middle - first_cell, last_cell - middle
        jump_b, jump_c = (first, last) if passage.to_b < passage.to_c else (last, first)
        by_b += jump_b * course.per_b
        by_slope_b += (passage.begin + passage.to_b) * jump_b * course.per_b
        by_c += jump_c * course.per_c
        by_slope_c += (passage.begin + passage.to_c) * jump_c * course.per_c
        at_begin += first_cell if k - ray.centre - 0.5 < ray.begin else 0.0
        at_end += last_cell if k - ray.centre + 0.5 > ray.end else 0.0
    return Slopes(total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end)


@scalar
def crossed(scratch):
    """Of the three cells that a ray may cross in a slab: flat indices, and lengths in them."""
    return scratch.index, scratch.index_b, scratch.index_c, scratch.one, scratch.two, scratch.three


@scalar
def cells(ray, count, steps, scratch):
    """For each slab of `summation.traverse`: flat indices of the crossed cells in order, and
    lengths.

    Crossings are computed in float64 and rounded last: for rays almost in a plane they amplify
    rounding.
    """
    index0, index1, index2, part0, part1, part2 = crossed(scratch)
    real, whole = part0.dtype.type, index0.dtype.type
    course = course_of(ray, np.float64)
    for i in range(np.uint32(count)):
        s = np.float64(scratch.four[i])
        passage = crossing(course, s, np.float64)
        first, middle, last = lengths(passage)
        part0[i], part1[i], part2[i] = real(first), real(middle), real(last)
        k = np.int32(s + course.centre)
        index0[i], index1[i], index2[i] = three(steps, k, passage, whole)


@scalar
def sum(store, n, traversed, scratch):
    """The sum of volume n along a ray, in voxels of the main axis; traversed = (number of slabs,
    lead of their terms).
    """
    count, lead = traversed
    index0, index1, index2, part0, part1, part2 = crossed(scratch)
    flat, offset, terms = store.values, np.uint64(n * store.size), scratch.terms[lead:]
    for i in range(np.uint32(count)):
        first, middle = flat[np.uint64(index0[i]) + offset], flat[np.uint64(index1[i]) + offset]
        last = flat[np.uint64(index2[i]) + offset]
        terms[i] = part0[i] * first + part1[i] * middle + part2[i] * last
    return fold(scratch.terms, lead, count)


@scalar
def spread(store, n, count, scratch, value):
    """Add a value to volume n along a ray with the weights of `sum`: its transpose."""
    index0, index1, index2, part0, part1, part2 = crossed(scratch)
    flat, offset = store.values, np.uint64(n * store.size)
    for i in range(np.uint32(count)):
        flat[np.uint64(index0[i]) + offset] += part0[i] * value
        flat[np.uint64(index1[i]) + offset] += part1[i] * value
        flat[np.uint64(index2[i]) + offset] += part2[i] * value
