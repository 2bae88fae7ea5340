"""Voxel-driven back-projection on the CPU and its transpose, bitwise independent of the number of
threads.

A thread owns slabs of the volume, in the transpose rows of views, and accumulates in a fixed order.
Rows of voxels are cut to the part whose images touch the detector, see `rows.py`, so that later
loops test no bounds.

Upright views are read by columns: the images of a column of voxels along z are in one detector
column, at even steps. That holds for every circular orbit about z with detector columns along z,
and every stack of slices. The two adjacent detector columns are blended once, as contiguous
vectors, and a voxel takes a pair of neighbours from the blend: no division and two values instead
of four, with the same weights. These views are transposed so that detector columns are contiguous.
"""

from collections import namedtuple
from collections.abc import Sequence
from math import ceil, floor

import numpy as np
import torch
from torch import Tensor

from mvrecon.kernels import rows
from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.threads import parallel_for

#: maps [m 4 2 3], detector (u, v) and flat steps (u, v) of a padded view, window, whether distance
#: weights apply.
Sight = namedtuple("Sight", ["maps", "detector", "steps", "window", "weighted"])
#: The affine functions along a row of voxels: numerators u and v, denominator, fraction of the ray.
Row = namedtuple("Row", ["u", "v", "under", "fraction", "half", "count"])


@scalar
def _row_of(lines, shape, k, j):
    z, y = k - (shape[0] - 1) / 2, j - (shape[1] - 1) / 2
    u, v, under, fraction = (
        rows.affine(lines[0], y, z),
        rows.affine(lines[1], y, z),
        rows.affine(lines[2], y, z),
        rows.affine(lines[3], y, z),
    )
    return Row(u, v, under, fraction, (shape[2] - 1) / 2, shape[2])


@scalar
def _seen(row, sight):
    """The voxels first to last of a row whose images touch the detector, within the valid range of
    rays.
    """
    part = rows.positive(row.under[0], row.under[1], -row.half, row.half)
    part = rows.positive(row.fraction[0] - sight.window[0], row.fraction[1], part[0], part[1])
    part = rows.positive(sight.window[1] - row.fraction[0], -row.fraction[1], part[0], part[1])
    u, v = (sight.detector[0] + 1) / 2, (sight.detector[1] + 1) / 2
    part = rows.between(row.u, row.under, -u, u, part)
    return rows.whole(rows.between(row.v, row.under, -v, v, part), row.half, row.count)


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
        inverse = rows.over(row.under, i)
        pu = rows.cell(row.u, inverse, i, u, sight.detector[0])
        pv = rows.cell(row.v, inverse, i, v, sight.detector[1])
        iu, iv = np.int32(pu), np.int32(pv)
        weight[0, n], weight[1, n] = real(pu - iu), real(pv - iv)
        weight[2, n] = real(inverse * inverse) if sight.weighted else real(1)
        at[n] = number(number(iu) + number(number(iv) * sight.steps[1]))


@compiled
def backproject_rows(flat, sight, scratch, volumes, first, last):
    """Accumulate views [n m p] into the slabs first to last of volumes [n d h w]."""
    depth, height, width = volumes.shape[1:]
    at, weight = scratch.at, scratch.weight
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
                    image, line = rows.face(flat[n, m], sight.steps[1]), volumes[n, z, y, part[0] :]
                    for i in range(np.uint32(count)):
                        k = np.uint64(at[i])
                        line[i] += weight[2, i] * rows.bilinear(
                            image, k, weight[0, i], weight[1, i]
                        )


@compiled
def project_rows(volumes, sight, scratch, views, m, low, high):
    """Write the rows [low, high) of view m of [n m v u], the transpose for volumes [n d h w].

    The scratch's own is [n p], those rows and one on either side.
    """
    depth, height, width = volumes.shape[1:]
    across = sight.steps[1]
    at, weight, own = scratch.at, scratch.weight, scratch.own
    for number in range(depth * height):
        z, y = number // height, number % height
        row = _row_of(sight.maps[m], (depth, height, width), z, y)
        part = _seen(row, sight)
        if high - low < sight.detector[1]:
            part = rows.near(row, row.v, row.under, sight.detector[1], low, high, part)
        count = part[1] - part[0]
        if count <= 0:
            continue
        _cells(row, part, sight, at, weight)
        for i in range(count):
            at[i] -= low * across
        for n in range(len(volumes)):
            image, end = rows.face(own[n], across), np.uint64(len(own[n]) - across)
            line = volumes[n, z, y, part[0] :]
            for i in range(np.uint32(count)):
                k = np.uint64(at[i])
                # voxels reach beyond these detector rows, and unsigned indices must not be negative
                if k < end:
                    rows.lay(image, k, weight[0, i], weight[1, i], weight[2, i] * line[i])
    for n in range(len(volumes)):
        for v in range(low, high):
            begin = (v - low + 1) * across + 1
            for u in range(sight.detector[0]):
                views[n, m, v, u] = own[n, begin + u]


#: Columns of voxels computed before they are written, to fill cache lines.
TILE = 16
#: Number of voxels along z from which on it pays.
LEAST_DEPTH = 8
COMPLEX = {np.dtype(np.float32): np.complex64, np.dtype(np.float64): np.complex128}

#: Memory of a thread: the blended column [n p] flat, each value and the next as one complex number
#: in the same memory; per voxel its position and share of the upper neighbour, the pair and its
#: parts; sums [n x z] of a tile.
Column = namedtuple("Column", ["blend", "pairs", "places", "shares", "taken", "parts", "sums"])
#: Images of a column: padded position along u, of the first voxel along v and step, the distance
#: weight, and the voxels first to last whose images touch the detector.
Image = namedtuple("Image", ["u", "v", "step", "weight", "first", "last"])


def upright(maps: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Whether views [m] of maps [m 4 2 3] are upright, up to rounding."""
    if shape[0] < LEAST_DEPTH:
        return np.zeros(len(maps), bool)
    level = maps[:, [0, 2, 3]]
    rising = np.abs(level[:, :, 1]).sum(axis=2) * shape[0]
    return (rising <= 1e-13 * np.abs(level[:, :, 0]).sum(axis=2)).all(axis=1)


def turned(views: np.ndarray) -> np.ndarray:
    """Views [n m v u] as padded columns [n m u+3 v+3]."""
    n, m, v, u = views.shape
    columns = np.zeros((n, m, u + 3, v + 3), views.dtype)
    columns[:, :, 1:-2, 1:-2] = views.swapaxes(2, 3)
    return columns


def scratch_of(columns: np.ndarray, depth: int) -> Column:
    """Memory of a thread."""
    count, _, _, width = columns.shape
    real, pair = columns.dtype, COMPLEX[columns.dtype]
    blend, taken = np.zeros(count * width, real), np.empty(depth, pair)
    pairs = np.ndarray((len(blend) - 1,), pair, blend, strides=blend.strides)
    sums = np.empty((count, TILE, depth), real)
    places, shares = np.empty(depth, np.uint32), np.empty(depth, real)
    return Column(blend, pairs, places, shares, taken, taken.view(real), sums)


@scalar
def _image(lines, sight, i, j, depth):
    nowhere = Image(0.0, 0.0, 0.0, 0.0, 0, 0)
    under = lines[2, 0, 0] * i + lines[2, 0, 1] * j + lines[2, 0, 2]
    fraction = lines[3, 0, 0] * i + lines[3, 0, 1] * j + lines[3, 0, 2]
    if under <= 0 or fraction <= sight.window[0] or fraction >= sight.window[1]:
        return nowhere
    inverse, border = 1.0 / under, sight.detector[1] + 1.0
    u = (lines[0, 0, 0] * i + lines[0, 0, 1] * j + lines[0, 0, 2]) * inverse
    u += (sight.detector[0] + 1) / 2
    if u <= 0 or u >= sight.detector[0] + 1:
        return nowhere
    step = lines[1, 1, 2] * inverse
    v = (lines[1, 0, 0] * i + lines[1, 0, 1] * j + lines[1, 0, 2]) * inverse + border / 2
    v -= step * (depth - 1) / 2
    low, high = 0.0, depth - 1.0
    if step > 0:
        low, high = max(low, -v / step), min(high, (border - v) / step)
    elif step < 0:
        low, high = max(low, (border - v) / step), min(high, -v / step)
    elif v <= 0 or v >= border:
        return nowhere
    if low > high:
        return nowhere
    weight = inverse * inverse if sight.weighted else 1.0
    return Image(u, v, step, weight, int(ceil(low)), int(floor(high)) + 1)


@scalar
def _places(image, scratch):
    """Lower neighbours of a column's images, and the upper ones' shares."""
    real, places, shares = scratch.shares.dtype.type, scratch.places, scratch.shares
    v, step = real(image.v + image.first * image.step), real(image.step)
    for k in range(np.uint32(image.last - image.first)):
        place = v + real(np.int32(k)) * step
        below = np.int32(place)
        places[k], shares[k] = np.uint32(below), place - real(below)


@scalar
def _blend(image, columns, blend):
    """Blend the detector's columns at u, times the weight, where images are."""
    real, left = blend.dtype.type, int(image.u)
    share = image.u - left
    low, high = real((1 - share) * image.weight), real(share * image.weight)
    one = image.v + image.first * image.step
    other = image.v + (image.last - 1) * image.step
    first = max(0, int(min(one, other)) - 1)
    last = min(columns.shape[1], int(max(one, other)) + 3)
    one, two = columns[left], columns[left + 1]
    for v in range(np.uint32(first), np.uint32(last)):
        blend[v] = low * one[v] + high * two[v]


@scalar
def _add_tile(columns, sight, scratch, tile, volumes):
    """The sums of all views over the voxels tile = (y, first x, one behind the last x)."""
    depth, height, width = volumes.shape[1:]
    (y, start, end), taken, parts = tile, scratch.taken, scratch.parts
    scratch.sums[:] = 0
    for x in range(start, end):
        for m in range(len(sight.maps)):
            i, j = x - (width - 1) / 2, y - (height - 1) / 2
            image = _image(sight.maps[m], sight, i, j, depth)
            if image.first >= image.last:
                continue
            _places(image, scratch)
            for n in range(len(volumes)):
                begin = n * columns.shape[3]
                _blend(image, columns[n, m], scratch.blend[begin:])
                line = scratch.sums[n, x - start, image.first :]
                for k in range(np.uint32(image.last - image.first)):
                    taken[k] = scratch.pairs[np.uint64(scratch.places[k]) + np.uint64(begin)]
                for k in range(np.uint32(image.last - image.first)):
                    lower = parts[2 * k]
                    line[k] += lower + scratch.shares[k] * (parts[2 * k + 1] - lower)


@compiled
def backproject_columns(columns, sight, scratch, volumes, first, last):
    """Accumulate views into the rows first to last along y of volumes [n d h w]."""
    depth, _, width = volumes.shape[1:]
    for y in range(first, last):
        for start in range(0, width, TILE):
            end = min(start + TILE, width)
            _add_tile(columns, sight, scratch, (y, start, end), volumes)
            for n in range(len(volumes)):
                for z in range(depth):
                    for x in range(start, end):
                        volumes[n, z, y, x] += scratch.sums[n, x - start, z]


def _sight(maps: Tensor, detector: Sequence[int], window: Sequence[float], weighted: bool) -> Sight:
    numbers = np.ascontiguousarray(maps.numpy(), dtype=np.float64)
    ends = (float(window[0]), float(window[1]))
    return Sight(
        numbers,
        (int(detector[1]), int(detector[0])),
        rows.flat_steps(detector),
        ends,
        bool(weighted),
    )


def backproject(views, maps, window, weighted, shape):
    """Sum all views at the images of every voxel; see `backproject_reference`."""
    volumes = torch.zeros(len(views), *map(int, shape), dtype=views.dtype)
    add_backprojection(volumes, views, maps, window, weighted)
    return volumes


def add_backprojection(volumes, views, maps, window, weighted):
    """Add all views at the images of every voxel to volumes [n d h w], in place."""
    sight, sums = _sight(maps, views.shape[2:], window, weighted), volumes.numpy()
    level = upright(sight.maps, sums.shape[1:])
    for mask, by_columns in ((~level, False), (level, True)):
        if mask.any():
            part = sight._replace(maps=np.ascontiguousarray(sight.maps[mask]))
            stack = views.numpy() if mask.all() else views.numpy()[:, mask]
            (_add_by_columns if by_columns else _add_by_rows)(stack, part, sums)


def _add_by_rows(views: np.ndarray, sight: Sight, volumes: np.ndarray) -> None:
    flat, (_, depth, _, width) = rows.padded(views, 2), volumes.shape

    def work(first: int, last: int) -> None:
        backproject_rows(
            flat, sight, rows.row_scratch(width, sight.steps, flat.dtype), volumes, first, last
        )

    parallel_for(work, depth, volumes.size * len(sight.maps), 4)


def _add_by_columns(views: np.ndarray, sight: Sight, volumes: np.ndarray) -> None:
    columns, (_, depth, height, _) = turned(views), volumes.shape

    def work(first: int, last: int) -> None:
        backproject_columns(columns, sight, scratch_of(columns, depth), volumes, first, last)

    parallel_for(work, height, volumes.size * len(sight.maps), 4)


def project(volumes, maps, window, weighted, detector):
    """The exact transpose of `backproject`."""
    sight = _sight(maps, detector, window, weighted)
    values, height = np.ascontiguousarray(volumes.numpy()), int(detector[0])
    views = volumes.new_empty(len(volumes), len(maps), *detector)

    def work(first: int, last: int) -> None:
        for m in range(first // height, (last - 1) // height + 1):
            low, high = max(0, first - m * height), min(height, last - m * height)
            own = (len(values), (high - low + 2) * int(sight.steps[1]))
            project_rows(
                values,
                sight,
                rows.row_scratch(values.shape[3], sight.steps, values.dtype, own),
                views.numpy(),
                m,
                low,
                high,
            )

    parallel_for(work, len(maps) * height, values.size * len(maps))
    return views
