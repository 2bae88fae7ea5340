"""Trilinear sampling along one ray: a fixed number of samples, each at the middle of its share of
the ray.

The ray runs through the box grown by the kernel's reach, half a voxel on every side, so that no
weight is cut off. A sample lies between two slabs; in each it is one bilinear cell, so `joseph.sum`
and `joseph.spread` read these cells.
"""

from math import floor

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.occupancy import EDGE
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
def cells(ray, span, steps, room):
    """Two of each sample: flat index of a bilinear cell, place in it towards b and c, weight; no
    weight beyond span.

    Returns:
        how many there are; where their terms begin, see `summation.fold`.
    """
    at, y, z, share = room.index, room.one, room.two, room.three
    step = (ray.end - ray.begin) / steps.samples
    first, last = samples_in(ray, steps.samples)
    found = 0
    for j in range(first, last):
        s = ray.begin + (j + 0.5) * step
        py, pz, px = ray.b + s * ray.slope_b, ray.c + s * ray.slope_c, s + ray.centre
        below, iy, iz = int(floor(px)), int(py), int(pz)
        for slab in range(below, below + 2):
            held = ray.enter <= s <= ray.leave and span[0] <= slab < span[1]
            at[found] = (slab + 1) * steps.along + iy * steps.far + iz - steps.origin if held else 0
            y[found], z[found] = py - iy, pz - iz
            share[found] = step * (1 - abs(px - slab)) if held else 0
            found += 1
    return found, np.uint32(2 * first % EDGE)


@scalar
def face(flat, k, steps, y, z):
    """The interpolated volume in one slab, and its slopes along the far and the near axis."""
    above = k + steps.far
    low_z, high_z = flat[k + steps.near] - flat[k], flat[above + steps.near] - flat[above]
    lower, upper = flat[k] + z * low_z, flat[above] + z * high_z
    return lower + y * (upper - lower), upper - lower, low_z + y * (high_z - low_z)


@scalar
def _local(flat, steps, px, py, pz):
    """The interpolated volume at a place, and its slopes along the main, the far and the near
    axis.
    """
    below, iy, iz = int(floor(px)), int(py), int(pz)
    k, x = (below + 1) * steps.along + iy * steps.far + iz * steps.near - steps.origin, px - below
    low, low_b, low_c = face(flat, k, steps, py - iy, pz - iz)
    high, high_b, high_c = face(flat, k + steps.along, steps, py - iy, pz - iz)
    return (
        low + x * (high - low),
        high - low,
        low_b + x * (high_b - low_b),
        low_c + x * (high_c - low_c),
    )


@scalar
def slopes(store, n, steps, ray):
    """How a ray's `sum` changes with its place, its samples moving with its ends.

    Returns:
        the sum; its derivatives by b, slope_b, c, slope_c; what it gains when the ray's own ends
        move outwards.
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
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for face, place, change in ((ray.from_, ray.begin, by_begin), (ray.to, ray.end, by_end)):
        # an end on a face b + s slope = constant moves with b and the slope
        if face == FAR:
            by_b -= change / ray.slope_b
            by_slope_b -= place * change / ray.slope_b
        if face == NEAR:
            by_c -= change / ray.slope_c
            by_slope_c -= place * change / ray.slope_c
    at_begin = -by_begin if ray.from_ == OWN else 0.0
    return total, by_b, by_slope_b, by_c, by_slope_c, at_begin, by_end if ray.to == OWN else 0.0
