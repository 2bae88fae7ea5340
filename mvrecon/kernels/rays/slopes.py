"""How the integral along one ray changes with its place, for kernels that keep nothing from step to
step.

Each function returns the sum in voxels of the main axis; its derivatives by b, slope_b, c, slope_c;
and the volume where the ray begins and ends inside the box. `loops.pull_back` makes derivatives by
the geometry of them.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays import corners, march

#: As much of `packed_volume.Store` as is read here: padded volumes in one row, and the size of one.
Values = namedtuple("Values", ["values", "size"])


@scalar
def joseph(held, n, ray, steps):
    """How a ray's sum by Joseph's method changes with its place; see `joseph.slopes`."""
    flat, real = held.values, held.values.dtype.type
    offset, half, none = np.int64(n * held.size), real(0.5), real(0)
    total = by_b = by_slope_b = by_c = by_slope_c = at_begin = at_end = none
    for k in range(ray.first, ray.last):
        s = real(k) - real(ray.centre)
        iy, iz, y, z = corners.cell(ray, s, real)
        at = offset + np.int64(corners.place(steps, k, iy, iz, np.int64))
        share = corners.share_of(ray, s, real)
        value, along_b, along_c = march.face(flat, at, steps, y, z)
        total += share * value
        by_b += share * along_b
        by_slope_b += s * share * along_b
        by_c += share * along_c
        by_slope_c += s * share * along_c
        at_begin += value if s - half < real(ray.begin) else none
        at_end += value if s + half > real(ray.end) else none
    return total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end


@scalar
def siddon(held, n, ray, steps):
    """How a ray's sum by Siddon's method changes with its place: at each plane by the difference of
    the two cells.
    """
    flat, offset = held.values, np.int64(n * held.size)
    total = by_b = by_slope_b = by_c = by_slope_c = at_begin = at_end = 0.0
    per_b, per_c = (
        1 / ray.slope_b if ray.slope_b != 0 else 0.0,
        1 / ray.slope_c if ray.slope_c != 0 else 0.0,
    )
    for k in range(ray.first, ray.last):
        s0, length, to_b, to_c, cells = corners.crossings(ray, k, np.float64)
        index = corners.three(steps, k, (to_b < to_c, cells), np.int64)
        one, two, three = flat[offset + index[0]], flat[offset + index[1]], flat[offset + index[2]]
        first, last = min(to_b, to_c), max(to_b, to_c)
        total += first * one + (last - first) * two + (length - last) * three
        # without a crossing both cells are the same
        jump_b, jump_c = (two - one, three - two) if to_b < to_c else (three - two, two - one)
        by_b += jump_b * per_b
        by_slope_b += (s0 + to_b) * jump_b * per_b
        by_c += jump_c * per_c
        by_slope_c += (s0 + to_c) * jump_c * per_c
        at_begin += one if k - ray.centre - 0.5 < ray.begin else 0.0
        at_end += three if k - ray.centre + 0.5 > ray.end else 0.0
    return total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end


@scalar
def trilinear(held, n, ray, steps):
    """How a ray's sum over samples changes with its place."""
    return march.slopes(held, n, steps, ray)
