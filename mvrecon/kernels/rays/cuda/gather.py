"""The adjoint of Joseph's method, voxel by voxel: no two threads write the same number, so none
waits for another.

A voxel X gets something from a ray of main axis a where the ray passes its slab less than a voxel
from X along both other axes. In a view these rays hit the picture of a square of two voxels about
X, which stays convex as long as it lies on one side of the source. Every pixel of the picture's box
is asked for the weight that `methods/joseph.py` gives it, so the result is the exact transpose also
where a view mixes main axes. Box and weights need nothing but scalars.
"""

from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.methods.joseph import hat, overlap
from mvrecon.kernels.rays.trace import JOSEPH, main_axis, trace

#: What is kept of each ray, the last its main axis, or -1 when it misses the volume.
B, SLOPE_B, C, SLOPE_C, BEGIN, END, LENGTH, AXIS = range(8)


class View(NamedTuple):
    """What one view gives to voxels: its matrix [3 4] from `projection_matrix`; rays [8 p] of
    `record`, values [n p'] of all pixels, and where the view begins in either; sizes (x, y, z) of
    the volume; detector (rows, columns).
    """

    frame: Any
    rays: Any
    values: Any
    first_ray: Any
    first_value: Any
    sizes: Any
    detector: Any


@scalar
def near_of(axis):
    """The axis nearest in memory, in a volume [d h w], of the two across a main axis."""
    return 0 if axis != 0 else 1


@scalar
def record(line, pixel, space, into, k):
    """Write into column k what `weight` needs of the ray of a pixel, and tell its main axis."""
    axis = main_axis(line, pixel[0], pixel[1])
    ray = trace(line, axis, near_of(axis), pixel, space, JOSEPH)
    into[B, k], into[SLOPE_B, k] = (
        ray.b - 1,
        ray.slope_b,
    )  # voxels are counted without their padding
    into[C, k], into[SLOPE_C, k] = ray.c - 1, ray.slope_c
    into[BEGIN, k], into[END, k], into[LENGTH, k] = ray.begin, ray.end, ray.length
    into[AXIS, k] = axis if ray.first < ray.last else -1
    return axis


@scalar
def limits(low, high, size, real):
    """The first and the last pixel from low to high, counted from the detector's centre, of `size`
    pixels.
    """
    # what rounding may move a corner by, in single precision
    slack, centre = real(0.02) + real(1e-5) * real(size), real(size - 1) / real(2)
    one = min(max(low - slack + centre, real(0)), real(size))
    two = min(max(high + slack + centre, real(-1)), real(size - 1))
    return np.int32(ceil(one)), np.int32(floor(two))


@scalar
def box(frame, point, axis, detector, real):
    """The pixels (first and last column, first and last row) whose rays can pass a voxel less than
    a voxel away.

    Args:
        frame: the view's matrix from `projection_matrix`, in the type `real`.
        point: the voxel (x, y, z), from the volume's centre.
        axis: the rays' main axis.
        detector: pixels (rows, columns).
        real: the type to compute in.
    """
    rows, columns = detector
    x, y, z = real(point[0]), real(point[1]), real(point[2])
    u = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3]
    v = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3]
    w = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3]
    near = near_of(axis)
    far = 3 - axis - near
    # on both sides of the source the picture is no longer convex: ask every pixel
    if abs(w) * real(0.999) <= abs(frame[2, far]) + abs(frame[2, near]):
        return np.int32(0), np.int32(columns - 1), np.int32(0), np.int32(rows - 1)
    one = real(1)
    low_u = low_v = real(1e30)
    high_u = high_v = real(-1e30)
    for i in (-one, one):
        for j in (-one, one):
            per = one / (w + i * frame[2, far] + j * frame[2, near])
            pu = (u + i * frame[0, far] + j * frame[0, near]) * per
            pv = (v + i * frame[1, far] + j * frame[1, near]) * per
            low_u, high_u, low_v, high_v = (
                min(low_u, pu),
                max(high_u, pu),
                min(low_v, pv),
                max(high_v, pv),
            )
    u0, u1 = limits(low_u, high_u, columns, real)
    v0, v1 = limits(low_v, high_v, rows, real)
    return u0, u1, v0, v1


@scalar
def weight(rays, k, s, b, c, real):
    """What the ray in column k gives to the voxel (b, c) of the slab at s; lengths in mm."""
    half, one = real(0.5), real(1)
    share = overlap(rays[BEGIN, k], rays[END, k], s, half)
    across = hat(rays[B, k] + s * rays[SLOPE_B, k] - b, one) * hat(
        rays[C, k] + s * rays[SLOPE_C, k] - c, one
    )
    return max(real(0), share) * rays[LENGTH, k] * across


@scalar
def collect(view, voxel, axis, first, totals, real):
    """Add to totals what the rays of one view and one main axis give to a voxel (x, y, z).

    Args:
        view: a `View`.
        voxel: its indices.
        axis: the rays' main axis.
        first: the first of the volumes, of which `totals` has a few.
        totals: a number per volume.
        real: the type to compute in.
    """
    sizes = view.sizes
    point = (
        voxel[0] - (sizes[0] - 1) / 2,
        voxel[1] - (sizes[1] - 1) / 2,
        voxel[2] - (sizes[2] - 1) / 2,
    )
    near = near_of(axis)
    s, b, c = real(point[axis]), real(voxel[3 - axis - near]), real(voxel[near])
    u0, u1, v0, v1 = box(view.frame, point, axis, view.detector, real)
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            place = v * view.detector[1] + u
            k, pixel = np.uint64(view.first_ray + place), np.uint64(view.first_value + place)
            if view.rays[AXIS, k] != axis:
                continue
            share = weight(view.rays, k, s, b, c, real)
            for n in range(len(totals)):
                if first + n < len(view.values):
                    totals[n] += share * view.values[np.uint64(first + n), pixel]
