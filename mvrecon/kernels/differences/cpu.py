"""The compiled steps of total variation on the CPU: primal volumes and dual fields, bitwise
independent of the number of threads: a thread owns slices, and a voxel's terms are added in a fixed
order.

The neighbour beyond the last row of an axis is the row itself, so that the difference is zero.
Loops write one array each, else the compiler does not vectorise them.
"""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.differences import Shrinkage, Stride
from mvrecon.kernels.threads import parallel_for


class Dual(NamedTuple):
    """An extrapolated dual field, p + momentum (p - q), and its step.

    Args:
        values: p [3 n d h w].
        last: the previous values q, overwritten by a step; p itself for zero momentum.
        momentum: momentum, without a unit.
        rates: step length / voxel size along (z, y, x).
        one: 1 as the fields' type of number.
    """

    values: np.ndarray
    last: np.ndarray
    momentum: np.floating
    rates: tuple[np.floating, np.floating, np.floating]
    one: np.floating


class Primal(NamedTuple):
    """Arguments of the primal volume z - strength D^T p, clipped.

    Args:
        volume: z [n d h w].
        strength: [d h w].
        slopes: 1 / voxel size along (z, y, x).
        least: lower bound of values.
    """

    volume: np.ndarray
    strength: np.ndarray
    slopes: tuple[np.floating, np.floating, np.floating]
    least: np.floating


class Scratch(NamedTuple):
    """Memory of a thread: rows of a field [3 w], of sizes [w], and two slices [2 h w]."""

    field: np.ndarray
    size: np.ndarray
    slices: np.ndarray


@scalar
def _add(p, q, momentum, factor, out):
    """Add the factor times a row of p + momentum (p - q)."""
    for x in range(len(out)):
        out[x] += factor * (p[x] + momentum * (p[x] - q[x]))


@scalar
def _primal_row(dual, primal, n, z, y, out):
    """Write a row of the primal volume; D^T first."""
    p, q, momentum, slopes = dual.values, dual.last, dual.momentum, primal.slopes
    out[:] = 0
    inner = len(out) - 1
    _add(p[2, n, z, y, :inner], q[2, n, z, y, :inner], momentum, -slopes[2], out[:inner])
    _add(p[2, n, z, y, :inner], q[2, n, z, y, :inner], momentum, slopes[2], out[1:])
    if y + 1 < p.shape[3]:
        _add(p[1, n, z, y], q[1, n, z, y], momentum, -slopes[1], out)
    if y > 0:
        _add(p[1, n, z, y - 1], q[1, n, z, y - 1], momentum, slopes[1], out)
    if z + 1 < p.shape[2]:
        _add(p[0, n, z, y], q[0, n, z, y], momentum, -slopes[0], out)
    if z > 0:
        _add(p[0, n, z - 1, y], q[0, n, z - 1, y], momentum, slopes[0], out)
    volume, strength, least = primal.volume[n, z, y], primal.strength[z, y], primal.least
    for x in range(len(out)):
        value = volume[x] - strength[x] * out[x]
        out[x] = least if value < least else value


@scalar
def _ahead(p, q, momentum, rate, after, before, out):
    """Write a row of p + momentum (p - q) + rate (after - before)."""
    for x in range(len(out)):
        out[x] = p[x] + momentum * (p[x] - q[x]) + rate * (after[x] - before[x])


@scalar
def _dual_rows(dual, above, below, scratch, n, z):
    """Write slice z of a field's step: along the gradient of the volume between the slices `above`
    and `below` [h w], vectors longer than 1 shortened to 1.
    """
    p, q, momentum, rates, one = dual
    field, size = scratch.field, scratch.size
    height, width = above.shape
    for y in range(height):
        row, after = above[y], above[min(y + 1, height - 1)]
        _ahead(p[0, n, z, y], q[0, n, z, y], momentum, rates[0], below[y], row, field[0])
        _ahead(p[1, n, z, y], q[1, n, z, y], momentum, rates[1], after, row, field[1])
        inner, px, qx = width - 1, p[2, n, z, y], q[2, n, z, y]
        _ahead(px, qx, momentum, rates[2], row[1:], row, field[2, :inner])
        field[2, inner] = px[inner] + momentum * (px[inner] - qx[inner])
        for x in range(width):
            square = field[0, x] ** 2 + field[1, x] ** 2 + field[2, x] ** 2
            size[x] = one / sqrt(max(square, one))
        for axis in range(3):
            new, old = q[axis, n, z, y], field[axis]
            for x in range(width):
                new[x] = old[x] * size[x]


@compiled
def primal_slices(dual, primal, out, first, last):
    """Write the slices first to last, counted through (n, d), of the primal volumes [n d h w]."""
    depth = out.shape[1]
    for number in range(first, last):
        n, z = number // depth, number % depth
        for y in range(out.shape[2]):
            _primal_row(dual, primal, n, z, y, out[n, z, y])


@compiled
def dual_slices(dual, volumes, scratch, first, last):
    """Step the slices first to last, counted through (n, d), of a field along the gradient of
    volumes [n d h w].
    """
    depth = volumes.shape[1]
    for number in range(first, last):
        n, z = number // depth, number % depth
        _dual_rows(dual, volumes[n, z], volumes[n, min(z + 1, depth - 1)], scratch, n, z)


@compiled
def first_slices(dual, primal, thickness, heads, first, last):
    """Write the first slices of slabs first to last, counted through (n, slab), of the primal
    volumes to `heads` [n slab h w].
    """
    slabs = heads.shape[1]
    for number in range(first, last):
        n, slab = number // slabs, number % slabs
        for y in range(heads.shape[2]):
            _primal_row(dual, primal, n, slab * thickness, y, heads[n, slab, y])


@compiled
def dual_slabs(dual, primal, thickness, heads, scratch, first, last):
    """Step the slabs first to last, counted through (n, slab), of a field along the gradient of its
    own primal volume, which is never stored.

    A slice of the primal volume is computed before the step overwrites the slice of `last` above
    it; the first slices of slabs are in `heads` [n slab h w].
    """
    slabs, depth = heads.shape[1], dual.values.shape[2]
    for number in range(first, last):
        n, slab = number // slabs, number % slabs
        begin, end = slab * thickness, min(depth, (slab + 1) * thickness)
        above = heads[n, slab]
        for z in range(begin, end):
            if z + 1 < end:
                below = scratch.slices[z % 2]
                for y in range(below.shape[0]):
                    _primal_row(dual, primal, n, z + 1, y, below[y])
            else:
                below = heads[n, slab + 1] if end < depth else above
            _dual_rows(dual, above, below, scratch, n, z)
            above = below


#: Slices of a slab; one more is computed for it.
THICKNESS = 16


def _flat(volume: Tensor) -> np.ndarray:
    """Volumes [n d h w]."""
    return volume.detach().contiguous().flatten(0, 1).numpy()


def _field(dual: Tensor, volume: Tensor) -> np.ndarray:
    """The fields [3 n d h w] of volumes, to write into; the loops test no bounds."""
    shape = (3, *volume.shape)
    if dual.shape != shape or dual.dtype != volume.dtype or not dual.is_contiguous():
        raise ValueError(
            f"Expected a contiguous dual field {shape} in {volume.dtype}, got "
            f"{tuple(dual.shape)} in {dual.dtype} with strides {dual.stride()}"
        )
    return dual.flatten(1, 2).numpy()


def _dual(values: np.ndarray, last: np.ndarray, stride: Stride, steps: Sequence[float]) -> Dual:
    number = values.dtype.type
    z, y, x = (number(stride.rate / step) for step in steps)
    return Dual(values, last, number(stride.momentum), (z, y, x), number(1))


def _primal(volume: Tensor, shrinkage: Shrinkage) -> Primal:
    values = _flat(volume)
    number = values.dtype.type
    z, y, x = (number(1 / step) for step in shrinkage.steps)
    strength = shrinkage.strength.to(volume.dtype)[0, 0].expand(volume.shape[2:]).contiguous()
    least = number(0 if shrinkage.nonnegative else -np.inf)
    return Primal(values, strength.numpy(), (z, y, x), least)


def _scratch(volumes: np.ndarray) -> Scratch:
    height, width = volumes.shape[2:]
    field, size = (np.empty(shape, volumes.dtype) for shape in ((3, width), width))
    return Scratch(field, size, np.empty((2, height, width), volumes.dtype))


def primal(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    shrinkage: Shrinkage,
) -> Float[Tensor, "b c d h w"]:
    """z - strength D^T p, clipped; see `differences.primal`."""
    out = torch.empty(volume.shape, dtype=volume.dtype)
    flat, field = _flat(out), _field(dual, volume)
    of, to = _dual(field, field, Stride(0.0), shrinkage.steps), _primal(volume, shrinkage)

    def work(first: int, last: int) -> None:
        primal_slices(of, to, flat, first, last)

    parallel_for(work, len(flat) * flat.shape[1], flat.size)
    return out


def dual_step(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    rate: float,
    steps: Sequence[float],
) -> Float[Tensor, "3 b c d h w"]:
    """p + rate D x, shortened, in place; see `differences.dual_step`."""
    flat, field = _flat(volume), _field(dual, volume)
    of = _dual(field, field, Stride(rate), steps)

    def work(first: int, last: int) -> None:
        dual_slices(of, flat, _scratch(flat), first, last)

    parallel_for(work, len(flat) * flat.shape[1], flat.size)
    return dual


def proximal_step(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    last: Float[Tensor, "3 b c d h w"],
    stride: Stride,
    shrinkage: Shrinkage,
) -> Float[Tensor, "3 b c d h w"]:
    """One step of fast gradient projection, over `last`; see `differences.proximal_step`."""
    fields = _field(dual, volume), _field(last, volume)
    of, to = _dual(*fields, stride, shrinkage.steps), _primal(volume, shrinkage)
    batch, depth, *slice_shape = to.volume.shape
    slabs = -(-depth // THICKNESS)
    heads = np.empty((batch, slabs, *slice_shape), to.volume.dtype)

    def begin(first: int, end: int) -> None:
        first_slices(of, to, THICKNESS, heads, first, end)

    def work(first: int, end: int) -> None:
        dual_slabs(of, to, THICKNESS, heads, _scratch(to.volume), first, end)

    parallel_for(begin, batch * slabs, heads.size)
    parallel_for(work, batch * slabs, to.volume.size)
    return last
