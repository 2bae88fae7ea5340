"""Trilinear sampling on one ray of the CPU, its cells in a room, which `joseph.sum` and
`joseph.spread` read.
"""

from math import floor

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.methods import trilinear
from mvrecon.kernels.rays.occupancy import EDGE


@scalar
def cells(ray, span, steps, room):
    """Two of each sample: flat index of a bilinear cell, place in it towards b and c, weight; no
    weight beyond span.

    Returns:
        how many there are; where their terms begin, see `summation.fold`.
    """
    at, y, z, share = room.index, room.one, room.two, room.three
    step = (ray.end - ray.begin) / steps.samples
    first, last = trilinear.samples_in(ray, steps.samples)
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
