"""The voxels that a ray meets at one step, and their weights, for kernels that keep nothing from
step to step.

The CPU writes whole rays into rooms (`joseph.py`, `siddon.py`, `march.py`); a thread of a GPU has
no room and does one step after the other in registers. A step is a slab (joseph, siddon), or a
sample and one of its two slabs (trilinear). The volume is padded, see `padding.py`, in any layout;
`real` and `whole` are the types of weights and of flat indices.
"""

from math import floor

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.march import samples_in
from mvrecon.kernels.rays.trace import TRILINEAR


@scalar
def steps_in(ray, steps, method):
    """The first step of a ray, and the one behind the last; small integers, which a GPU counts
    faster.
    """
    if method != TRILINEAR:
        return np.int32(ray.first), np.int32(ray.last)
    first, last = samples_in(ray, steps.samples)
    return np.int32(2 * first), np.int32(2 * last)


@scalar
def place(steps, k, iy, iz, whole):
    """The flat index in the store of a voxel: slab k counted from the volume, the others from its
    padding.
    """
    slab, row = whole(whole(k + 1) * whole(steps.along)), whole(whole(iy) * whole(steps.far))
    return whole(
        whole(whole(slab + row) + whole(whole(iz) * whole(steps.near))) - whole(steps.origin)
    )


@scalar
def cell(ray, s, real):
    """The bilinear cell that a ray meets at s, and the place in it towards b and c."""
    py, pz = real(ray.b) + s * real(ray.slope_b), real(ray.c) + s * real(ray.slope_c)
    iy, iz = np.int32(py), np.int32(pz)
    return iy, iz, py - real(iy), pz - real(iz)


@scalar
def four(steps, at, share, whole):
    """The four corners of the cell at (slab, iy, iz, y, z), and what each gets of a share."""
    k, iy, iz, y, z = at
    low = place(steps, k, iy, iz, whole)
    high, near = whole(low + whole(steps.far)), whole(steps.near)
    upper = share * y
    lower = share - upper
    low_z, high_z = lower * z, upper * z
    return (low, whole(low + near), high, whole(high + near)), (
        lower - low_z,
        low_z,
        upper - high_z,
        high_z,
    )


@scalar
def share_of(ray, s, real):
    """The length of a ray in the slab about s."""
    return min(real(ray.end), s + real(0.5)) - max(real(ray.begin), s - real(0.5))


@scalar
def joseph(ray, steps, k, real, whole):
    """Flat indices and weights of the four voxels of slab k."""
    s = real(k) - real(ray.centre)
    iy, iz, y, z = cell(ray, s, real)
    return four(steps, (k, iy, iz, y, z), share_of(ray, s, real), whole)


@scalar
def trilinear(ray, steps, k, real, whole):
    """Flat indices and weights of four of the eight voxels about sample k // 2."""
    step = real((ray.end - ray.begin) / steps.samples)
    s = real(ray.begin) + (real(k // 2) + real(0.5)) * step
    px = s + real(ray.centre)
    below = max(np.int32(floor(px)), np.int32(-1))
    x, slab = px - real(below), below + k % 2
    if not (real(ray.enter) <= s <= real(ray.leave) and ray.first <= slab < ray.last):
        none, zero = whole(0), real(0)
        return (none, none, none, none), (zero, zero, zero, zero)
    iy, iz, y, z = cell(ray, s, real)
    return four(steps, (slab, iy, iz, y, z), step * (x if k % 2 else real(1) - x), whole)


@scalar
def crossings(ray, k, real):
    """Where a ray crosses planes in slab k: its begin and length there, the way to b's and to c's
    plane, the cells.
    """
    s, half = real(k) - real(ray.centre), real(0.5)
    s0, length = max(real(ray.begin), s - half), share_of(ray, s, real)
    b, slope_b, c, slope_c = (
        real(ray.b) + half,
        real(ray.slope_b),
        real(ray.c) + half,
        real(ray.slope_c),
    )
    y, z = b + s0 * slope_b, c + s0 * slope_c
    b0, b1 = np.int32(y), np.int32(b + (s0 + length) * slope_b)
    c0, c1 = np.int32(z), np.int32(c + (s0 + length) * slope_c)
    to_b, to_c = length, length
    if b0 != b1:
        to_b = min(max((real(max(b0, b1)) - y) / slope_b, length * real(0)), length)
    if c0 != c1:
        to_c = min(max((real(max(c0, c1)) - z) / slope_c, length * real(0)), length)
    return s0, length, to_b, to_c, (b0, b1, c0, c1)


@scalar
def three(steps, k, order, whole):
    """Flat indices of the cells that a ray crosses, given whether it comes to b's plane first, and
    the cells.
    """
    b_first, (b0, b1, c0, c1) = order
    middle = place(steps, k, b1, c0, whole) if b_first else place(steps, k, b0, c1, whole)
    return place(steps, k, b0, c0, whole), middle, place(steps, k, b1, c1, whole)


@scalar
def siddon(ray, steps, k, real, whole):
    """Flat indices of the at most three cells that a ray crosses in slab k, and its lengths in
    them.
    """
    _, length, to_b, to_c, cells = crossings(ray, k, real)
    one, two = min(to_b, to_c), max(to_b, to_c)
    return three(steps, k, (to_b < to_c, cells), whole), (one, two - one, length - two)
