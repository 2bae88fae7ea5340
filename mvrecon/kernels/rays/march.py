"""Trilinear sampling along one ray: a fixed number of samples, each at the middle of its share of the ray.

The ray runs through the box grown by the kernel's reach, half a voxel on every side, so that no weight is cut off. A
sample lies between two slabs; in each it is one bilinear cell, so `joseph.sum` and `joseph.spread` read these cells.
"""

from math import floor

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.trace import FAR, NEAR, OWN


@scalar
def cells(ray, span, steps, room):
    """Per sample and slab in span: flat index of a bilinear cell, place in it towards b and c, weight, place along.

    Returns:
        the number of cells, at most twice the number of samples.
    """
    at, y, z, share, place = room.index, room.one, room.two, room.three, room.four
    step, found = (ray.end - ray.begin) / steps.samples, 0
    for j in range(steps.samples if span[0] < span[1] else 0):
        s = ray.begin + (j + 0.5) * step
        py, pz, px = ray.b + s * ray.slope_b, ray.c + s * ray.slope_c, s + ray.centre
        below, iy, iz = int(floor(px)), int(py), int(pz)
        for slab in range(max(below, span[0]), min(below + 2, span[1])):
            at[found] = (slab + 1) * steps.along + iy * steps.far + iz
            y[found], z[found], place[found] = py - iy, pz - iz, s
            share[found] = step * (1 - abs(px - slab))
            found += 1
    return found


@scalar
def face(flat, k, steps, y, z):
    """The interpolated volume in one slab, and its slopes along the far and the near axis."""
    above = k + steps.far
    low_z, high_z = flat[k + steps.near] - flat[k], flat[above + steps.near] - flat[above]
    lower, upper = flat[k] + z * low_z, flat[above] + z * high_z
    return lower + y * (upper - lower), upper - lower, low_z + y * (high_z - low_z)


@scalar
def _local(flat, steps, px, py, pz):
    """The interpolated volume at a place, and its slopes along the main, the far and the near axis."""
    below, iy, iz = int(floor(px)), int(py), int(pz)
    k, x = (below + 1) * steps.along + iy * steps.far + iz * steps.near, px - below
    low, low_b, low_c = face(flat, k, steps, py - iy, pz - iz)
    high, high_b, high_c = face(flat, k + steps.along, steps, py - iy, pz - iz)
    return low + x * (high - low), high - low, low_b + x * (high_b - low_b), low_c + x * (high_c - low_c)


@scalar
def slopes(store, n, steps, ray):
    """How a ray's `sum` changes with its place, its samples moving with its ends.

    Returns:
        the sum; its derivatives by b, slope_b, c, slope_c; what it gains when the ray's own ends move outwards.
    """
    flat, count = store.values[n * store.size : (n + 1) * store.size], steps.samples
    step = (ray.end - ray.begin) / count
    total = by_b = by_slope_b = by_c = by_slope_c = by_begin = by_end = 0.0
    for j in range(count if ray.first < ray.last else 0):
        way = (j + 0.5) / count
        s = ray.begin + (ray.end - ray.begin) * way
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
