"""The compiled loops of voxel-driven back-projection: every voxel looks up its image in every view;
and the transpose.

Rows of voxels are cut to the part whose images touch the detector, see `rows.py`; no later loop
tests a bound.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.faces import bilinear, face, lay
from mvrecon.kernels.rows import affine, between, cell, over, positive, whole

#: maps [m 4 2 3], detector (u, v) and flat steps (u, v) of a padded view, window, whether the
#: distance weighs.
Sight = namedtuple("Sight", ["maps", "detector", "steps", "window", "weighted"])
#: The affine functions along a row of voxels: numerators u and v, denominator, fraction of the ray.
Row = namedtuple("Row", ["u", "v", "under", "fraction", "half", "count"])


@scalar
def _row_of(lines, shape, k, j):
    z, y = k - (shape[0] - 1) / 2, j - (shape[1] - 1) / 2
    u, v, under, fraction = (
        affine(lines[0], y, z),
        affine(lines[1], y, z),
        affine(lines[2], y, z),
        affine(lines[3], y, z),
    )
    return Row(u, v, under, fraction, (shape[2] - 1) / 2, shape[2])


@scalar
def _seen(row, sight):
    """The voxels first to last of a row whose images touch the detector, where their rays count."""
    part = positive(row.under[0], row.under[1], -row.half, row.half)
    part = positive(row.fraction[0] - sight.window[0], row.fraction[1], part[0], part[1])
    part = positive(sight.window[1] - row.fraction[0], -row.fraction[1], part[0], part[1])
    u, v = (sight.detector[0] + 1) / 2, (sight.detector[1] + 1) / 2
    part = between(row.u, row.under, -u, u, part)
    return whole(between(row.v, row.under, -v, v, part), row.half, row.count)


@scalar
def _near_rows(row, sight, low, high, part):
    """The voxels that can touch the detector rows [low, high), with half a pixel to spare for
    rounding.
    """
    centre = (sight.detector[1] - 1) / 2
    interval = between(
        row.v, row.under, low - 1.5 - centre, high + 0.5 - centre, (-row.half, row.half)
    )
    first, last = whole(interval, row.half, row.count)
    return max(part[0], first), min(part[1], last)


@scalar
def _cells(row, part, sight, at, weight):
    """Per voxel: flat index of its bilinear cell, the weights towards u and v, and that of the
    distance.
    """
    real, number = weight.dtype.type, at.dtype.type
    u, v = (sight.detector[0] + 1) / 2, (sight.detector[1] + 1) / 2
    start = part[0] - row.half
    for n in range(np.uint32(max(0, part[1] - part[0]))):
        i = np.float64(np.int32(n)) + start
        inverse = over(row.under, i)
        pu = cell(row.u, inverse, i, u, sight.detector[0])
        pv = cell(row.v, inverse, i, v, sight.detector[1])
        iu, iv = np.int32(pu), np.int32(pv)
        weight[0, n], weight[1, n] = real(pu - iu), real(pv - iv)
        weight[2, n] = real(inverse * inverse) if sight.weighted else real(1)
        at[n] = number(number(iu) + number(number(iv) * sight.steps[1]))


@scalar
def _look(flat, across, count, at, weight, line):
    image = face(flat, across)
    for n in range(np.uint32(count)):
        line[n] += weight[2, n] * bilinear(image, np.uint64(at[n]), weight[0, n], weight[1, n])


@scalar
def _show(flat, across, count, at, weight, line):
    image, end = face(flat, across), np.uint64(len(flat) - across)
    for n in range(np.uint32(count)):
        k = np.uint64(at[n])
        if (
            k < end
        ):  # voxels reach beyond these detector rows, and no unsigned index lies before them
            lay(image, k, weight[0, n], weight[1, n], weight[2, n] * line[n])


@compiled
def look_up(flat, sight, room, volumes, first, last):
    """Add to the slabs first to last of the volumes [n d h w] what their voxels see in the views [n
    m p].
    """
    depth, height, width = volumes.shape[1:]
    at, weight = room.at, room.weight
    for z in range(first, last):
        for m in range(len(sight.maps)):
            for y in range(height):
                row = _row_of(sight.maps[m], (depth, height, width), z, y)
                part = _seen(row, sight)
                count = part[1] - part[0]
                if count <= 0:
                    continue
                _cells(row, part, sight, at, weight)
                for n in range(len(volumes)):
                    _look(
                        flat[n, m], sight.steps[1], count, at, weight, volumes[n, z, y, part[0] :]
                    )


@compiled
def show_rows(volumes, sight, room, views, m, low, high):
    """Write the rows [low, high) of view m of [n m v u]: what the voxels of [n d h w] put there.

    The room's own is [n p], those rows and one on either side.
    """
    depth, height, width = volumes.shape[1:]
    across = sight.steps[1]
    at, weight, own = room.at, room.weight, room.own
    for number in range(depth * height):
        z, y = number // height, number % height
        row = _row_of(sight.maps[m], (depth, height, width), z, y)
        part = _seen(row, sight)
        if high - low < sight.detector[1]:
            part = _near_rows(row, sight, low, high, part)
        count = part[1] - part[0]
        if count <= 0:
            continue
        _cells(row, part, sight, at, weight)
        for i in range(count):
            at[i] -= low * across
        for n in range(len(volumes)):
            _show(own[n], across, count, at, weight, volumes[n, z, y, part[0] :])
    for n in range(len(volumes)):
        for v in range(low, high):
            begin = (v - low + 1) * across + 1
            for u in range(sight.detector[0]):
                views[n, m, v, u] = own[n, begin + u]
