"""The compiled warps of the CPU. Every result is the same to the last bit for any number of
threads.

Each output row belongs to one thread; in the transpose so does each slab of a source volume, and it
meets the rows in one order.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.padding import padded, room, steps
from mvrecon.kernels.threads import share
from mvrecon.kernels.warps.loops import spread_slabs, vary_planes, warp_rows
from mvrecon.kernels.warps.trilinear import Warp


def _warp(maps: Tensor, source: Sequence[int], shape: Sequence[int]) -> Warp:
    numbers = np.ascontiguousarray(maps.numpy(), dtype=np.float64)
    sizes = (int(source[2]), int(source[1]), int(source[0]))
    return Warp(numbers, sizes, steps(source), (int(shape[0]), int(shape[1]), int(shape[2])))


def warp(
    volumes: Float[Tensor, "n s c d h w"], maps: Float[Tensor, "s k 5 2 3"], shape: Sequence[int]
) -> Float[Tensor, "n s k c d h w"]:
    """Volumes on other lattices; see `warp_reference.warp`."""
    plan = _warp(maps, volumes.shape[3:], shape)
    flat = padded(volumes.numpy(), 3)
    out = volumes.new_empty(*volumes.shape[:2], maps.shape[1], volumes.shape[2], *shape)
    rows = maps.shape[0] * maps.shape[1] * plan.shape[0] * plan.shape[1]

    def work(first: int, last: int) -> None:
        warp_rows(flat, plan, room(plan.shape[2], plan.steps, flat.dtype), out.numpy(), first, last)

    share(work, rows, out.numel(), 4)
    return out


def warp_back(
    values: Float[Tensor, "n s k c d h w"], maps: Float[Tensor, "s k 5 2 3"], shape: Sequence[int]
) -> Float[Tensor, "n s c d h w"]:
    """The exact transpose of `warp`."""
    plan = _warp(maps, shape, values.shape[4:])
    samples = np.ascontiguousarray(values.numpy())
    volumes = values.new_empty(*values.shape[:2], values.shape[3], *shape)
    slabs = int(shape[0])

    def work(first: int, last: int) -> None:
        for s in range(first // slabs, (last - 1) // slabs + 1):
            low, high = max(0, first - s * slabs), min(slabs, last - s * slabs)
            own = (samples.shape[0], samples.shape[3], (high - low + 2) * int(plan.steps[2]))
            rows = room(plan.shape[2], plan.steps, samples.dtype, own)
            spread_slabs(samples, plan, rows, volumes.numpy(), s, low, high)

    share(work, len(maps) * slabs, values.numel())
    return volumes


def warp_vjp(
    volumes: Float[Tensor, "n s c d h w"],
    values: Float[Tensor, "n s k c d h w"],
    maps: Float[Tensor, "s k 5 2 3"],
) -> Float[Tensor, "s k 5 2 3"]:
    """The derivative of <values, warp(volumes, maps)> by the maps, by hand; float64."""
    plan = _warp(maps, volumes.shape[3:], values.shape[4:])
    flat, samples = padded(volumes.numpy(), 3), np.ascontiguousarray(values.numpy())
    planes = np.zeros([*maps.shape[:2], plan.shape[0], 5, 2, 3])
    count = planes.shape[0] * planes.shape[1] * planes.shape[2]

    def work(first: int, last: int) -> None:
        rows = room(plan.shape[2], plan.steps, flat.dtype, (3, plan.shape[2]))
        vary_planes(flat, plan, rows, samples, planes, first, last)

    share(work, count, values.numel(), 4)
    return torch.from_numpy(planes.sum(axis=2))
