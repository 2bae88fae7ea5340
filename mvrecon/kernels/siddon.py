"""Siddon's method on one ray: the exact lengths in the cells that it crosses, taken slab by slab of the main axis.

R. L. Siddon, Fast calculation of the exact radiological path for a three-dimensional CT array, Med. Phys. 12, 1985.

Within a slab the ray crosses at most one plane of each other axis, so it meets at most three cells: no search, no
sorting, no state from slab to slab. Cells are half-open: a ray on a face belongs to the cell above it.
The volume is padded and flat; `steps` are the flat steps towards b and c.
"""

import numpy as np

from mvrecon.kernels.rays import scalar


@scalar
def crossing(low, high, before, slope, length):
    """How far into the slab a ray passes from cell `low` to cell `high`; the whole length when it stays."""
    if low == high:
        return length
    return min(max((max(low, high) - before) / slope, length * 0), length)


@scalar
def cells(ray, strides, at, part):
    """Per slab of a ray: flat indices of the cells that it crosses in order, and the lengths in them."""
    real, whole = part.dtype.type, at.dtype.type
    half = real(0.5)
    b, slope_b, c, slope_c = real(ray.b) + half, real(ray.slope_b), real(ray.c) + half, real(ray.slope_c)
    begin, end, centre = real(ray.begin), real(ray.end), real(ray.centre)
    along, across, up = strides[ray.axis], strides[(ray.axis + 1) % 3], strides[(ray.axis + 2) % 3]
    for i in range(max(0, ray.last - ray.first)):
        k = ray.first + i
        s = real(k) - centre
        s0, s1 = max(begin, s - half), min(end, s + half)
        length = s1 - s0
        y0, z0 = b + s0 * slope_b, c + s0 * slope_c
        b0, b1 = np.int32(y0), np.int32(b + s1 * slope_b)
        c0, c1 = np.int32(z0), np.int32(c + s1 * slope_c)
        to_b = crossing(real(b0), real(b1), y0, slope_b, length)
        to_c = crossing(real(c0), real(c1), z0, slope_c, length)
        one, two = min(to_b, to_c), max(to_b, to_c)
        part[0, i], part[1, i], part[2, i] = one, two - one, length - two
        base = whole(k + 1) * along
        at[0, i] = base + whole(b0) * across + whole(c0) * up
        at[1, i] = base + whole(b1 if to_b < to_c else b0) * across + whole(c0 if to_b < to_c else c1) * up
        at[2, i] = base + whole(b1) * across + whole(c1) * up


@scalar
def sum(flat, steps, count, at, part):
    """The sum of the volume along a ray, in voxels of the main axis."""
    total = flat.dtype.type(0)
    for i in range(np.uint32(count)):
        first, middle, last = flat[np.uint64(at[0, i])], flat[np.uint64(at[1, i])], flat[np.uint64(at[2, i])]
        total += part[0, i] * first + part[1, i] * middle + part[2, i] * last
    return total


@scalar
def spread(flat, steps, count, at, part, value):
    """Add a value along a ray with the weights of `sum`: its transpose."""
    for i in range(np.uint32(count)):
        flat[np.uint64(at[0, i])] += part[0, i] * value
        flat[np.uint64(at[1, i])] += part[1, i] * value
        flat[np.uint64(at[2, i])] += part[2, i] * value


@scalar
def slopes(flat, steps, count, at, part, ray):
    """How a ray's `sum` changes with its place: at each plane that it crosses, by the difference of the two cells.

    Returns:
        the sum; its derivatives by b, slope_b, c, slope_c; the volume where the ray begins and ends inside the box.
    """
    total = by_b = by_slope_b = by_c = by_slope_c = at_begin = at_end = 0.0
    for i in range(count):
        middle = i + ray.first - ray.centre
        s = max(ray.begin, middle - 0.5)
        for cell in range(3):
            value = flat[at[cell, i]]
            total += part[cell, i] * value
            s += part[cell, i]
            step = abs(at[min(cell + 1, 2), i] - at[cell, i])
            jump = value - flat[at[min(cell + 1, 2), i]]
            if step == steps[0]:
                by_b -= jump / ray.slope_b
                by_slope_b -= s * jump / ray.slope_b
            if step == steps[1]:
                by_c -= jump / ray.slope_c
                by_slope_c -= s * jump / ray.slope_c
        at_begin += flat[at[0, i]] if middle - 0.5 < ray.begin else 0.0
        at_end += flat[at[2, i]] if middle + 0.5 > ray.end else 0.0
    return total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end
