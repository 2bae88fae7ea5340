"""Warping one row: trilinear values of a volume at the places that a bilinear map of indices gives.

`cells` writes where the row goes (a loop without gathers, in float64); `fetch`, `spread` and
`slopes` read it. The volume is padded and flat. See `geometry/lattice.py` for the maps, and
`rows.py`.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.faces import bilinear, face, lay
from mvrecon.kernels.rows import affine, between, cell, over, positive, whole

#: maps [s k 5 2 3]; the source's sizes and, with its border, flat steps (x, y, z); shape (d, h, w)
#: of the output.
Warp = namedtuple("Warp", ["maps", "sizes", "steps", "shape"])
#: The affine functions along a row: numerators x, y, z, the denominator of x and y, and that of z.
Row = namedtuple("Row", ["x", "y", "z", "across", "depth", "half", "count"])


@scalar
def row_of(lines, shape, k, j):
    """The row (k, j) of the output."""
    z, y = k - (shape[0] - 1) / 2, j - (shape[1] - 1) / 2
    x_, y_, z_ = affine(lines[0], y, z), affine(lines[1], y, z), affine(lines[2], y, z)
    return Row(
        x_, y_, z_, affine(lines[3], y, z), affine(lines[4], y, z), (shape[2] - 1) / 2, shape[2]
    )


@scalar
def inside(row, sizes):
    """The positions first to last of a row whose cells touch the source."""
    part = positive(row.across[0], row.across[1], -row.half, row.half)
    part = positive(row.depth[0], row.depth[1], part[0], part[1])
    x, y, z = (sizes[0] + 1) / 2, (sizes[1] + 1) / 2, (sizes[2] + 1) / 2
    part = between(row.x, row.across, -x, x, part)
    part = between(row.y, row.across, -y, y, part)
    part = between(row.z, row.depth, -z, z, part)
    return whole(part, row.half, row.count)


@scalar
def near_slabs(row, sizes, low, high, part):
    """The positions of a row that can touch the slabs [low, high), with half a voxel to spare for
    rounding.
    """
    centre = (sizes[2] - 1) / 2
    interval = between(
        row.z, row.depth, low - 1.5 - centre, high + 0.5 - centre, (-row.half, row.half)
    )
    first, last = whole(interval, row.half, row.count)
    return max(part[0], first), min(part[1], last)


@scalar
def cells(row, part, sizes, steps, at, weight):
    """Per position: flat index of the trilinear cell, and the weights towards x, y, z."""
    real, number = weight.dtype.type, at.dtype.type
    x, y, z = (sizes[0] + 1) / 2, (sizes[1] + 1) / 2, (sizes[2] + 1) / 2
    start = part[0] - row.half
    for n in range(np.uint32(max(0, part[1] - part[0]))):
        i = np.float64(np.int32(n)) + start
        across = over(row.across, i)
        px = cell(row.x, across, i, x, sizes[0])
        py = cell(row.y, across, i, y, sizes[1])
        pz = cell(row.z, over(row.depth, i), i, z, sizes[2])
        ix, iy, iz = np.int32(px), np.int32(py), np.int32(pz)
        weight[0, n], weight[1, n], weight[2, n] = real(px - ix), real(py - iy), real(pz - iz)
        at[n] = number(
            number(ix) + number(number(number(iy) * steps[1]) + number(number(iz) * steps[2]))
        )


@scalar
def corners(flat, steps):
    """The lower and the upper face of a volume's cells."""
    return face(flat, steps[1]), face(flat[steps[2] :], steps[1])


@scalar
def fetch(flat, steps, count, at, weight, out):
    """The volume's values along a row."""
    low, high = corners(flat, steps)
    for n in range(np.uint32(count)):
        k, x, y = np.uint64(at[n]), weight[0, n], weight[1, n]
        below = bilinear(low, k, x, y)
        out[n] = below + weight[2, n] * (bilinear(high, k, x, y) - below)


@scalar
def spread(flat, steps, count, at, weight, values):
    """Add a row's values to a volume, or to some slabs of one, with the weights of `fetch`: its
    transpose.
    """
    low, high = corners(flat, steps)
    end = np.uint64(len(flat) - steps[2])
    for n in range(np.uint32(count)):
        k = np.uint64(at[n])
        if k < end:  # rows reach beyond the slabs, and no unsigned index lies before them
            above = weight[2, n] * values[n]
            lay(low, k, weight[0, n], weight[1, n], values[n] - above)
            lay(high, k, weight[0, n], weight[1, n], above)


@scalar
def slopes(flat, steps, count, at, weight, values, change):
    """Add to `change` [3 n] how the sum of values * (the volume's values) changes with each
    place.
    """
    low, high = corners(flat, steps)
    for n in range(count):
        k, x, y, z, value = np.uint64(at[n]), weight[0, n], weight[1, n], weight[2, n], values[n]
        by_x0 = (1 - y) * (low[1][k] - low[0][k]) + y * (low[3][k] - low[2][k])
        by_x1 = (1 - y) * (high[1][k] - high[0][k]) + y * (high[3][k] - high[2][k])
        by_y0 = (1 - x) * (low[2][k] - low[0][k]) + x * (low[3][k] - low[1][k])
        by_y1 = (1 - x) * (high[2][k] - high[0][k]) + x * (high[3][k] - high[1][k])
        change[0, n] += value * (by_x0 + z * (by_x1 - by_x0))
        change[1, n] += value * (by_y0 + z * (by_y1 - by_y0))
        change[2, n] += value * (bilinear(high, k, x, y) - bilinear(low, k, x, y))
