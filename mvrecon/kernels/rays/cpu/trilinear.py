"""Trilinear sampling: a fixed number of samples per ray, at the centres of equal intervals.

The ray runs through the box enlarged by the interpolation's reach, half a voxel on every side, so
that no weight is cut off. A sample between two slabs is one bilinear cell in each, which
`joseph.sum` and `joseph.spread` process. `real` and `whole` are the types of weights and of flat
indices.
"""

from math import floor
from typing import Any, NamedTuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cpu.joseph import Cell, cell, course_of, face_at
from mvrecon.kernels.rays.cpu.trace import FAR, NEAR, OWN, Slopes, flat_index
from mvrecon.kernels.rays.occupancy import EDGE


class Sample(NamedTuple):
    """Position of a sample: its coordinate along the main axis, the slab before it, its cell in
    either slab.
    """

    x: Any
    slab: Any
    cell: Cell


@scalar
def sample_at(course, s, real):
    """The sample at s of a ray's course."""
    x = s + course.centre
    # only rounding moves a sample before slab -1, where the volume's values end
    return Sample(x, max(np.int32(floor(x)), np.int32(-1)), cell(course, s, real))


@scalar
def samples_in(ray, span, count):
    """The first sample of a ray that may be in the box and in a span of slabs, and one past the
    last, with a margin.
    """
    step = (ray.end - ray.begin) / count
    low = max(ray.enter, span[0] - ray.centre - 1)
    high = min(ray.leave, span[1] - ray.centre)
    if span[0] >= span[1] or low > high:
        return 0, 0
    # one more on each side, for rounding
    first, last = floor((low - ray.begin) / step - 1.5), floor((high - ray.begin) / step + 1.5)
    return int(min(max(first, 0.0), count)), int(min(max(last + 1, 0.0), count))


@scalar
def _local(flat, steps, sample):
    """The interpolated volume at a sample, and its slopes along the main, the far and the near
    axis.
    """
    place, x = sample.cell, sample.x - sample.slab
    k = flat_index(steps, sample.slab, place.iy, place.iz, np.int64)
    low, low_b, low_c = face_at(flat, k, steps, place.y, place.z)
    high, high_b, high_c = face_at(flat, k + steps.along, steps, place.y, place.z)
    return (
        low + x * (high - low),
        high - low,
        low_b + x * (high_b - low_b),
        low_c + x * (high_c - low_c),
    )


@scalar
def slopes(store, n, ray, steps):
    """Derivatives of a ray's sum by its position, with samples that move with its ends, as
    `trace.Slopes`: the last two for moving its own ends outwards.
    """
    flat, count = store.values[n * store.size : (n + 1) * store.size], steps.samples
    course, step = course_of(ray, np.float64), (ray.end - ray.begin) / count
    total = by_b = by_slope_b = by_c = by_slope_c = by_begin = by_end = 0.0
    first, last = samples_in(ray, (ray.first, ray.last), count)
    for j in range(first, last):
        way = (j + 0.5) / count
        s = ray.begin + (ray.end - ray.begin) * way
        sample = sample_at(course, s, np.float64)
        if not (
            ray.enter <= s <= ray.leave and ray.first <= sample.slab + 1 and sample.slab < ray.last
        ):
            continue
        value, along_a, along_b, along_c = _local(flat, steps, sample)
        along = along_a + ray.slope_b * along_b + ray.slope_c * along_c
        total += step * value
        by_b += step * along_b
        by_slope_b += step * s * along_b
        by_c += step * along_c
        by_slope_c += step * s * along_c
        by_begin += step * (1 - way) * along - value / count
        by_end += step * way * along + value / count
    if ray.first >= ray.last:
        return Slopes(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for face, place, change in ((ray.from_, ray.begin, by_begin), (ray.to, ray.end, by_end)):
        # an end on a face b + s slope = constant moves with b and the slope
        if face == FAR:
            by_b -= change / ray.slope_b
            by_slope_b -= place * change / ray.slope_b
        if face == NEAR:
            by_c -= change / ray.slope_c
            by_slope_c -= place * change / ray.slope_c
    at_begin = -by_begin if ray.from_ == OWN else 0.0
    at_end = by_end if ray.to == OWN else 0.0
    return Slopes(total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end)


@scalar
def cells(ray, span, steps, scratch):
    """Two cells of each sample: flat index of a bilinear cell, position in it towards b and c,
    weight; zero weight outside span.

    Returns:
        their number; start of their terms, see `summation.fold`.
    """
    index, y, z, share = scratch.index, scratch.one, scratch.two, scratch.three
    whole = index.dtype.type
    course, step = course_of(ray, np.float64), (ray.end - ray.begin) / steps.samples
    first, last = samples_in(ray, span, steps.samples)
    count = 0
    for j in range(first, last):
        s = ray.begin + (j + 0.5) * step
        sample = sample_at(course, s, np.float64)
        cell = sample.cell
        for slab in range(sample.slab, sample.slab + 2):
            counts = ray.enter <= s <= ray.leave and span[0] <= slab < span[1]
            index[count] = flat_index(steps, slab, cell.iy, cell.iz, whole) if counts else 0
            y[count], z[count] = cell.y, cell.z
            # the remaining weight is of the adjacent slab
            weight = max(0.0, 1.0 - abs(sample.x - np.float64(slab)))
            share[count] = step * weight if counts else 0
            count += 1
    return np.uint32(count), np.uint32(2 * first % EDGE)
