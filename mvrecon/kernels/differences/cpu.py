"""The compiled steps of the total variation on the CPU. Every result is the same to the last bit
for any number of threads: a thread owns slices, and a voxel's terms are added in one order.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.differences.loops import (
    Dual,
    Primal,
    Room,
    dual_slabs,
    dual_slices,
    first_slices,
    primal_slices,
)
from mvrecon.kernels.differences.shrinkage import Shrinkage, Stride
from mvrecon.kernels.threads import share

#: Slices of a slab; one more is computed for it.
THICKNESS = 16


def _flat(volume: Tensor) -> np.ndarray:
    """Volumes [n d h w]."""
    return volume.detach().contiguous().flatten(0, 1).numpy()


def _field(dual: Tensor, volume: Tensor) -> np.ndarray:
    """The fields [3 n d h w] of volumes, to be written into; the loops test no bounds."""
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


def _room(volumes: np.ndarray) -> Room:
    height, width = volumes.shape[2:]
    field, size = (np.empty(shape, volumes.dtype) for shape in ((3, width), width))
    return Room(field, size, np.empty((2, height, width), volumes.dtype))


def primal(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    shrinkage: Shrinkage,
) -> Float[Tensor, "b c d h w"]:
    """z - strength D^T p, clipped; see `reference.primal`."""
    out = torch.empty(volume.shape, dtype=volume.dtype)
    flat, field = _flat(out), _field(dual, volume)
    of, to = _dual(field, field, Stride(0.0), shrinkage.steps), _primal(volume, shrinkage)

    def work(first: int, last: int) -> None:
        primal_slices(of, to, flat, first, last)

    share(work, len(flat) * flat.shape[1], flat.size)
    return out


def dual_step(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    rate: float,
    steps: Sequence[float],
) -> Float[Tensor, "3 b c d h w"]:
    """p + rate D x, shortened, in place; see `reference.dual_step`."""
    flat, field = _flat(volume), _field(dual, volume)
    of = _dual(field, field, Stride(rate), steps)

    def work(first: int, last: int) -> None:
        dual_slices(of, flat, _room(flat), first, last)

    share(work, len(flat) * flat.shape[1], flat.size)
    return dual


def proximal_step(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    last: Float[Tensor, "3 b c d h w"],
    stride: Stride,
    shrinkage: Shrinkage,
) -> Float[Tensor, "3 b c d h w"]:
    """One step of fast gradient projection, written over `last`; see `reference.proximal_step`."""
    fields = _field(dual, volume), _field(last, volume)
    of, to = _dual(*fields, stride, shrinkage.steps), _primal(volume, shrinkage)
    batch, depth, *slice_shape = to.volume.shape
    slabs = -(-depth // THICKNESS)
    heads = np.empty((batch, slabs, *slice_shape), to.volume.dtype)

    def begin(first: int, end: int) -> None:
        first_slices(of, to, THICKNESS, heads, first, end)

    def work(first: int, end: int) -> None:
        dual_slabs(of, to, THICKNESS, heads, _room(to.volume), first, end)

    share(begin, batch * slabs, heads.size)
    share(work, batch * slabs, to.volume.size)
    return last
