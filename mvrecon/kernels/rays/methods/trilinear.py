"""Trilinear sampling, one step of a ray: a fixed number of samples, each at the middle of its share
of the ray.

The ray runs through the box grown by the kernel's reach, half a voxel on every side, so that no
weight is cut off. A sample lies between two slabs; in each it is one bilinear cell, that of
`joseph.py`. `real` and `whole` are the types of weights and of flat indices.
"""

from math import floor

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.methods.joseph import Slopes, cell, course_of, face_at, four
from mvrecon.kernels.rays.trace import FAR, NEAR, OWN


@scalar
def samples_in(ray, count):
    """The first sample of a ray that may lie in the box, and the one behind the last; some beyond
    it are among them.
    """
    step = (ray.end - ray.begin) / count
    low = max(ray.enter, ray.first - ray.centre - 1)
    high = min(ray.leave, ray.last - ray.centre)
    if ray.first >= ray.last or low > high:
        return 0, 0
    # one more on each side, for rounding
    first, last = floor((low - ray.begin) / step - 1.5), floor((high - ray.begin) / step + 1.5)
    return int(min(max(first, 0.0), count)), int(min(max(last + 1, 0.0), count))


@scalar
def corners(ray, steps, k, real, whole):
    """Flat indices and weights of four of the eight voxels about sample k // 2."""
    course = course_of(ray, real)
    step = real((ray.end - ray.begin) / steps.samples)
    s = course.begin + (real(k // 2) + real(0.5)) * step
    px = s + course.centre
    below = max(np.int32(floor(px)), np.int32(-1))
    x, slab = px - real(below), below + k % 2
    if not (real(ray.enter) <= s <= real(ray.leave) and ray.first <= slab < ray.last):
        none, zero = whole(0), real(0)
        return (none, none, none, none), (zero, zero, zero, zero)
    iy, iz, y, z = cell(course, s, real)
    return four(steps, (slab, iy, iz, y, z), step * (x if k % 2 else real(1) - x), whole)


@scalar
def _local(flat, steps, px, py, pz):
    """The interpolated volume at a place, and its slopes along the main, the far and the near
    axis.
    """
    below, iy, iz = int(floor(px)), int(py), int(pz)
    k, x = (below + 1) * steps.along + iy * steps.far + iz * steps.near - steps.origin, px - below
    low, low_b, low_c = face_at(flat, k, steps, py - iy, pz - iz)
    high, high_b, high_c = face_at(flat, k + steps.along, steps, py - iy, pz - iz)
    return (
        low + x * (high - low),
        high - low,
        low_b + x * (high_b - low_b),
        low_c + x * (high_c - low_c),
    )


@scalar
def slopes(store, n, ray, steps):
    """How a ray's sum changes with its place, its samples moving with its ends, as `joseph.Slopes`:
    the last two are what it gains when the ray's own ends move outwards.
    """
    flat, count = store.values[n * store.size : (n + 1) * store.size], steps.samples
    step = (ray.end - ray.begin) / count
    total = by_b = by_slope_b = by_c = by_slope_c = by_begin = by_end = 0.0
    first, last = samples_in(ray, count)
    for j in range(first, last):
        way = (j + 0.5) / count
        s = ray.begin + (ray.end - ray.begin) * way
        below = int(floor(s + ray.centre))
        if not (ray.enter <= s <= ray.leave and ray.first <= below + 1 and below < ray.last):
            continue
        py, pz = ray.b + s * ray.slope_b, ray.c + s * ray.slope_c
        value, along_a, along_b, along_c = _local(flat, steps, s + ray.centre, py, pz)
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
