"""Siddon's method on one ray: the exact lengths in the cells that it crosses, taken slab by slab of the main axis.

R. L. Siddon, Fast calculation of the exact radiological path for a three-dimensional CT array, Med. Phys. 12, 1985.

Within a slab the ray crosses at most one plane of each other axis, so it meets at most three cells: no search, no
sorting, no state from slab to slab. Cells are half-open: a ray on a face belongs to the cell above it.
The volume is padded and flat; `steps` are the flat steps towards b and c.
"""

import numpy as np

from mvrecon.kernels.compiling import scalar


@scalar
def crossing(low, high, before, per_slope, length):
    """How far into the slab a ray passes from cell `low` to cell `high`; the whole length when it stays."""
    way = min(max((max(low, high) - before) * per_slope, length * 0), length)
    return way if low != high else length


@scalar
def cells(ray, strides, at, part):
    """Per slab of a ray: flat indices of the cells that it crosses in order, and the lengths in them."""
    index0, index1, index2, part0, part1, part2 = at[0], at[1], at[2], part[0], part[1], part[2]
    real, whole = part.dtype.type, at.dtype.type
    half = real(0.5)
    b, slope_b, c, slope_c = real(ray.b) + half, real(ray.slope_b), real(ray.c) + half, real(ray.slope_c)
    # a ray without slope stays in its cell, and this is never used
    per_b, per_c = real(1 / ray.slope_b if ray.slope_b else 0), real(1 / ray.slope_c if ray.slope_c else 0)
    begin, end, start, first = real(ray.begin), real(ray.end), real(ray.first - ray.centre), whole(ray.first + 1)
    along, across, up = strides[ray.axis], strides[(ray.axis + 1) % 3], strides[(ray.axis + 2) % 3]
    for i in range(np.uint32(max(0, ray.last - ray.first))):
        s = real(whole(i)) + start
        s0, s1 = max(begin, s - half), min(end, s + half)
        length = s1 - s0
        y0, z0 = b + s0 * slope_b, c + s0 * slope_c
        b0, b1 = np.int32(y0), np.int32(b + s1 * slope_b)
        c0, c1 = np.int32(z0), np.int32(c + s1 * slope_c)
        to_b = crossing(real(b0), real(b1), y0, per_b, length)
        to_c = crossing(real(c0), real(c1), z0, per_c, length)
        one, two = min(to_b, to_c), max(to_b, to_c)
        part0[i], part1[i], part2[i] = one, two - one, length - two
        base = whole(whole(first + whole(i)) * along)
        along_b0, along_b1 = whole(whole(b0) * across), whole(whole(b1) * across)
        along_c0, along_c1 = whole(whole(c0) * up), whole(whole(c1) * up)
        index0[i] = whole(base + whole(along_b0 + along_c0))
        index1[i] = whole(base + whole(along_b1 + along_c0 if to_b < to_c else along_b0 + along_c1))
        index2[i] = whole(base + whole(along_b1 + along_c1))


@scalar
def sum(flat, steps, count, at, part):
    """The sum of the volume along a ray, in voxels of the main axis."""
    index0, index1, index2, part0, part1, part2 = at[0], at[1], at[2], part[0], part[1], part[2]
    total = flat.dtype.type(0)
    for i in range(np.uint32(count)):
        first, middle, last = flat[np.uint64(index0[i])], flat[np.uint64(index1[i])], flat[np.uint64(index2[i])]
        total += part0[i] * first + part1[i] * middle + part2[i] * last
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
