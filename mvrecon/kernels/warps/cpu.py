"""The compiled warps on the CPU: forward, transpose, and derivative by the maps, bitwise
independent of the number of threads.

Each output row belongs to one thread; in the transpose so does each slab of a source volume, which
processes the rows in a fixed order. `cells` computes a row's cells (a loop without gathers, in
float64); `fetch`, `spread` and `slopes` use them. Volumes are padded and flat. See
`geometry/lattice.py` for the maps, and `rows.py`.
"""

from collections import namedtuple
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mvrecon.kernels import rows
from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.threads import parallel_for

#: maps [s k 5 2 3]; the source's sizes and, with its border, flat steps (x, y, z); shape (d, h, w)
#: of the output.
Warp = namedtuple("Warp", ["maps", "sizes", "steps", "shape"])
#: The affine functions along a row: numerators x, y, z, the denominator of x and y, and that of z.
Row = namedtuple("Row", ["x", "y", "z", "across", "depth", "half", "count"])


@scalar
def row_of(lines, shape, k, j):
    """The row (k, j) of the output."""
    z, y = k - (shape[0] - 1) / 2, j - (shape[1] - 1) / 2
    x_, y_, z_ = (
        rows.affine(lines[0], y, z),
        rows.affine(lines[1], y, z),
        rows.affine(lines[2], y, z),
    )
    return Row(
        x_,
        y_,
        z_,
        rows.affine(lines[3], y, z),
        rows.affine(lines[4], y, z),
        (shape[2] - 1) / 2,
        shape[2],
    )


@scalar
def inside(row, sizes):
    """The positions first to last of a row whose cells touch the source."""
    part = rows.positive(row.across[0], row.across[1], -row.half, row.half)
    part = rows.positive(row.depth[0], row.depth[1], part[0], part[1])
    x, y, z = (sizes[0] + 1) / 2, (sizes[1] + 1) / 2, (sizes[2] + 1) / 2
    part = rows.between(row.x, row.across, -x, x, part)
    part = rows.between(row.y, row.across, -y, y, part)
    part = rows.between(row.z, row.depth, -z, z, part)
    return rows.whole(part, row.half, row.count)


@scalar
def cells(row, part, sizes, steps, at, weight):
    """Per position: flat index of the trilinear cell, and the weights towards x, y, z."""
    real, number = weight.dtype.type, at.dtype.type
    x, y, z = (sizes[0] + 1) / 2, (sizes[1] + 1) / 2, (sizes[2] + 1) / 2
    start = part[0] - row.half
    for n in range(np.uint32(max(0, part[1] - part[0]))):
        i = np.float64(np.int32(n)) + start
        across = rows.over(row.across, i)
        px = rows.cell(row.x, across, i, x, sizes[0])
        py = rows.cell(row.y, across, i, y, sizes[1])
        pz = rows.cell(row.z, rows.over(row.depth, i), i, z, sizes[2])
        ix, iy, iz = np.int32(px), np.int32(py), np.int32(pz)
        weight[0, n], weight[1, n], weight[2, n] = real(px - ix), real(py - iy), real(pz - iz)
        at[n] = number(
            number(ix) + number(number(number(iy) * steps[1]) + number(number(iz) * steps[2]))
        )


@scalar
def corners(flat, steps):
    """The lower and the upper face of a volume's cells."""
    return rows.face(flat, steps[1]), rows.face(flat[steps[2] :], steps[1])


@scalar
def fetch(flat, steps, count, at, weight, out):
    """The volume's values along a row."""
    low, high = corners(flat, steps)
    for n in range(np.uint32(count)):
        k, x, y = np.uint64(at[n]), weight[0, n], weight[1, n]
        below = rows.bilinear(low, k, x, y)
        out[n] = below + weight[2, n] * (rows.bilinear(high, k, x, y) - below)


@scalar
def spread(flat, steps, count, at, weight, values):
    """Add a row's values to a volume, or to some slabs of one, with the weights of `fetch`: its
    transpose.
    """
    low, high = corners(flat, steps)
    end = np.uint64(len(flat) - steps[2])
    for n in range(np.uint32(count)):
        k = np.uint64(at[n])
        if k < end:  # rows reach beyond the slabs, and unsigned indices must not be negative
            above = weight[2, n] * values[n]
            rows.lay(low, k, weight[0, n], weight[1, n], values[n] - above)
            rows.lay(high, k, weight[0, n], weight[1, n], above)


@scalar
def slopes(flat, steps, count, at, weight, values, change):
    """Add to `change` [3 n] the derivatives of the sum of values * (the volume's values) by each
    position.
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
        change[2, n] += value * (rows.bilinear(high, k, x, y) - rows.bilinear(low, k, x, y))


@compiled
def warp_rows(flat, warp, scratch, out, first, last):
    """Write the rows first to last, counted through (s, k, d, h), of the warped volumes [n s k c d
    h w].
    """
    at, weight = scratch.at, scratch.weight
    depth, height, width = warp.shape
    kinds = warp.maps.shape[1]
    for number in range(first, last):
        z, y = number // height % depth, number % height
        k, s = number // (height * depth) % kinds, number // (height * depth * kinds)
        row = row_of(warp.maps[s, k], warp.shape, z, y)
        part = inside(row, warp.sizes)
        count = max(0, part[1] - part[0])
        cells(row, part, warp.sizes, warp.steps, at, weight)
        for n in range(flat.shape[0]):
            for c in range(flat.shape[2]):
                line = out[n, s, k, c, z, y]
                line[: part[0]] = 0
                line[part[0] + count :] = 0
                fetch(flat[n, s, c], warp.steps, count, at, weight, line[part[0] :])


@compiled
def spread_slabs(values, warp, scratch, volumes, s, low, high):
    """Accumulate values [n s k c d h w] into the slabs [low, high) of volume s of [n s c d h w].

    The scratch's own is [n c p], those slabs and one on either side.
    """
    at, weight, own = scratch.at, scratch.weight, scratch.own
    depth, height, width = warp.shape
    batch, channels = values.shape[0], values.shape[3]
    for number in range(warp.maps.shape[1] * depth * height):
        k, z, y = number // (height * depth), number // height % depth, number % height
        row = row_of(warp.maps[s, k], warp.shape, z, y)
        part = inside(row, warp.sizes)
        if high - low < warp.sizes[2]:
            part = rows.near(row, row.z, row.depth, warp.sizes[2], low, high, part)
        count = part[1] - part[0]
        if count <= 0:
            continue
        cells(row, part, warp.sizes, warp.steps, at, weight)
        for i in range(count):
            at[i] -= low * warp.steps[2]
        for n in range(batch):
            for c in range(channels):
                line = values[n, s, k, c, z, y]
                spread(own[n, c], warp.steps, count, at, weight, line[part[0] :])
    for n in range(batch):
        for c in range(channels):
            for z in range(low, high):
                for y in range(warp.sizes[1]):
                    begin = (z - low + 1) * warp.steps[2] + (y + 1) * warp.steps[1] + 1
                    for x in range(warp.sizes[0]):
                        volumes[n, s, c, z, y, x] = own[n, c, begin + x]


@scalar
def _pull_back(row, part, place, slopes, change):
    """Add to `change` [5 2 3] the derivative by a row's map, given its `slopes` [3 n].

    Each numerator t and denominator w give t / w: its change is (dt - (t / w) dw) / w.
    """
    y, z = place
    for n in range(part[1] - part[0]):
        i = n + part[0] - row.half
        across, depth = row.across[0] + i * row.across[1], row.depth[0] + i * row.depth[1]
        by_x, by_y, by_z = slopes[0, n] / across, slopes[1, n] / across, slopes[2, n] / depth
        by_across = -(by_x * (row.x[0] + i * row.x[1]) + by_y * (row.y[0] + i * row.y[1])) / across
        by_depth = -by_z * (row.z[0] + i * row.z[1]) / depth
        for r, by in enumerate((by_x, by_y, by_z, by_across, by_depth)):
            for c, factor in enumerate((i, y, 1.0)):
                change[r, 0, c] += by * factor
                change[r, 1, c] += by * factor * z


@compiled
def vary_planes(flat, warp, scratch, values, change, first, last):
    """Into `change` [s k d 5 2 3]: per plane of the output, the derivative of sum(values * warped)
    by the maps.
    """
    at, weight = scratch.at, scratch.weight
    depth, height, width = warp.shape
    kinds = warp.maps.shape[1]
    for number in range(first, last):
        z, k, s = number % depth, number // depth % kinds, number // (depth * kinds)
        for y in range(height):
            row = row_of(warp.maps[s, k], warp.shape, z, y)
            part = inside(row, warp.sizes)
            count = max(0, part[1] - part[0])
            cells(row, part, warp.sizes, warp.steps, at, weight)
            scratch.own[:] = 0
            for n in range(flat.shape[0]):
                for c in range(flat.shape[2]):
                    line = values[n, s, k, c, z, y]
                    slopes(
                        flat[n, s, c], warp.steps, count, at, weight, line[part[0] :], scratch.own
                    )
            place = (y - (height - 1) / 2, z - (depth - 1) / 2)
            _pull_back(row, part, place, scratch.own, change[s, k, z])


def _warp(maps: Tensor, source: Sequence[int], shape: Sequence[int]) -> Warp:
    numbers = np.ascontiguousarray(maps.numpy(), dtype=np.float64)
    sizes = (int(source[2]), int(source[1]), int(source[0]))
    return Warp(
        numbers, sizes, rows.flat_steps(source), (int(shape[0]), int(shape[1]), int(shape[2]))
    )


def warp(volumes, maps, shape):
    """Warp volumes to other lattices; see `warp_reference`."""
    x = to_accumulation_dtype(volumes)
    plan = _warp(maps, x.shape[3:], shape)
    flat = rows.padded(x.numpy(), 3)
    out = x.new_empty(*x.shape[:2], maps.shape[1], x.shape[2], *shape)
    count = maps.shape[0] * maps.shape[1] * plan.shape[0] * plan.shape[1]

    def work(first: int, last: int) -> None:
        warp_rows(
            flat,
            plan,
            rows.row_scratch(plan.shape[2], plan.steps, flat.dtype),
            out.numpy(),
            first,
            last,
        )

    parallel_for(work, count, out.numel(), 4)
    return out


def warp_transpose(values, maps, shape):
    """The exact transpose of `warp`."""
    plan = _warp(maps, shape, values.shape[4:])
    samples = np.ascontiguousarray(to_accumulation_dtype(values).numpy())
    volumes = to_accumulation_dtype(values[:0]).new_empty(
        *values.shape[:2], values.shape[3], *shape
    )
    slabs = int(shape[0])

    def work(first: int, last: int) -> None:
        for s in range(first // slabs, (last - 1) // slabs + 1):
            low, high = max(0, first - s * slabs), min(slabs, last - s * slabs)
            own = (samples.shape[0], samples.shape[3], (high - low + 2) * int(plan.steps[2]))
            scratch = rows.row_scratch(plan.shape[2], plan.steps, samples.dtype, own)
            spread_slabs(samples, plan, scratch, volumes.numpy(), s, low, high)

    parallel_for(work, len(maps) * slabs, values.numel())
    return volumes


def warp_vjp(volumes, values, maps):
    """The derivative of <values, warp(volumes, maps)> by the maps, by hand; float64."""
    plan = _warp(maps, volumes.shape[3:], values.shape[4:])
    flat, samples = (
        rows.padded(to_accumulation_dtype(volumes).numpy(), 3),
        np.ascontiguousarray(to_accumulation_dtype(values).numpy()),
    )
    planes = np.zeros([*maps.shape[:2], plan.shape[0], 5, 2, 3])
    count = planes.shape[0] * planes.shape[1] * planes.shape[2]

    def work(first: int, last: int) -> None:
        scratch = rows.row_scratch(plan.shape[2], plan.steps, flat.dtype, (3, plan.shape[2]))
        vary_planes(flat, plan, scratch, samples, planes, first, last)

    parallel_for(work, count, values.numel(), 4)
    return torch.from_numpy(planes.sum(axis=2))
