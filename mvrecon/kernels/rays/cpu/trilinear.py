"""Trilinear sampling on one ray of the CPU, its cells in a room, which `joseph.sum` and
`joseph.spread` read.
"""

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.methods import trilinear
from mvrecon.kernels.rays.methods.joseph import course_of
from mvrecon.kernels.rays.methods.strides import flat_index
from mvrecon.kernels.rays.occupancy import EDGE


@scalar
def cells(ray, span, steps, room):
    """Two of each sample: flat index of a bilinear cell, place in it towards b and c, weight; no
    weight beyond span.

    Returns:
        how many there are; where their terms begin, see `summation.fold`.
    """
    index, y, z, share = room.index, room.one, room.two, room.three
    whole = index.dtype.type
    course, step = course_of(ray, np.float64), (ray.end - ray.begin) / steps.samples
    first, last = trilinear.samples_in(ray, steps.samples)
    count = 0
    for j in range(first, last):
        s = ray.begin + (j + 0.5) * step
        sample = trilinear.sample_at(course, s, np.float64)
        cell = sample.cell
        for slab in range(sample.slab, sample.slab + 2):
            counts = ray.enter <= s <= ray.leave and span[0] <= slab < span[1]
            index[count] = flat_index(steps, slab, cell.iy, cell.iz, whole) if counts else 0
            y[count], z[count] = cell.y, cell.z
            share[count] = step * trilinear.share(sample, slab, np.float64) if counts else 0
            count += 1
    return count, np.uint32(2 * first % EDGE)
