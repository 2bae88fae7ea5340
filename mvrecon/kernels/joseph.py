"""Joseph's method on one ray: in each slab of the main axis, bilinear in the two other axes.

P. M. Joseph, An improved algorithm for reprojecting rays through pixel images, IEEE Trans. Med. Imaging 1, 1982.

`cells` writes where the ray goes (a loop without gathers, that every CPU vectorises); `sum`, `spread` and `slopes`
read it. The volume is padded and flat; `steps` are the flat steps towards b and c.
"""

import numpy as np

from mvrecon.kernels.compiling import scalar


@scalar
def cells(ray, strides, at, part):
    """Per slab of a ray: flat index of its bilinear cell, weights towards b and c, part of the slab that counts."""
    index, y, z, share = at[0], part[0], part[1], part[2]
    real, whole = part.dtype.type, at.dtype.type
    b, slope_b, c, slope_c = real(ray.b), real(ray.slope_b), real(ray.c), real(ray.slope_c)
    begin, end, half = real(ray.begin), real(ray.end), real(0.5)
    start, first = real(ray.first - ray.centre), whole(ray.first + 1)
    along, across, up = strides[ray.axis], strides[(ray.axis + 1) % 3], strides[(ray.axis + 2) % 3]
    for i in range(np.uint32(max(0, ray.last - ray.first))):
        s = real(whole(i)) + start
        share[i] = min(end, s + half) - max(begin, s - half)
        py, pz = b + s * slope_b, c + s * slope_c
        iy, iz = np.int32(py), np.int32(pz)
        y[i], z[i] = py - real(iy), pz - real(iz)
        base = whole(whole(first + whole(i)) * along)
        index[i] = whole(base + whole(whole(whole(iy) * across) + whole(whole(iz) * up)))


@scalar
def corners(flat, steps):
    """The volume as seen from the four corners of a bilinear cell, so that one index serves all."""
    return flat, flat[steps[0] :], flat[steps[1] :], flat[steps[0] + steps[1] :]


@scalar
def sum(flat, steps, count, at, part):
    """The sum of the volume along a ray, in voxels of the main axis."""
    index, y, z, share = at[0], part[0], part[1], part[2]
    f00, f10, f01, f11 = corners(flat, steps)
    total = flat.dtype.type(0)
    for i in range(np.uint32(count)):
        k = np.uint64(index[i])
        low, high = f00[k] + y[i] * (f10[k] - f00[k]), f01[k] + y[i] * (f11[k] - f01[k])
        total += share[i] * (low + z[i] * (high - low))
    return total


@scalar
def spread(flat, steps, count, at, part, value):
    """Add a value along a ray with the weights of `sum`: its transpose."""
    index, y, z, share = at[0], part[0], part[1], part[2]
    f00, f10, f01, f11 = corners(flat, steps)
    for i in range(np.uint32(count)):
        k = np.uint64(index[i])
        both = share[i] * value
        high = both * z[i]
        low = both - high
        high_b, low_b = high * y[i], low * y[i]
        f00[k] += low - low_b
        f10[k] += low_b
        f01[k] += high - high_b
        f11[k] += high_b


@scalar
def slopes(flat, steps, count, at, part, ray):
    """How a ray's `sum` changes with its place.

    Returns:
        the sum; its derivatives by b, slope_b, c, slope_c; the volume where the ray begins and ends inside the box.
    """
    across, up = steps
    total = by_b = by_slope_b = by_c = by_slope_c = at_begin = at_end = 0.0
    for i in range(count):
        k, y, z, share = at[0, i], part[0, i], part[1, i], part[2, i]
        s = i + ray.first - ray.centre
        f00, f10, f01, f11 = flat[k], flat[k + across], flat[k + up], flat[k + across + up]
        low, high = f00 + y * (f10 - f00), f01 + y * (f11 - f01)
        value = low + z * (high - low)
        along_b = share * ((1 - z) * (f10 - f00) + z * (f11 - f01))
        along_c = share * (high - low)
        total += share * value
        by_b += along_b
        by_slope_b += s * along_b
        by_c += along_c
        by_slope_c += s * along_c
        at_begin += value if s - 0.5 < ray.begin else 0.0
        at_end += value if s + 0.5 > ray.end else 0.0
    return total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end
