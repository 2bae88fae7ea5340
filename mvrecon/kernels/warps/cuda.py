"""Warps on CUDA devices: the same three operators as on the CPU; deterministic."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mvrecon.kernels.cuda import launch
from mvrecon.kernels.cuda.driver import BLOCK, WARP
from mvrecon.kernels.operator import accumulation_dtype

#: Channels of a thread, as in `2_warp.cu`; numbers of a map.
PLANES, MAP = 8, 30
#: Threads of a derivative by the maps, which splits small warps over blocks.
THREADS = 2**18


def part_of(stored: Tensor) -> launch.Variant:
    """The kernels for a stored type, including half precision; they write in the type of
    arithmetic.
    """
    return launch.Variant(launch.WARPS, accumulation_dtype(stored.dtype), stored.dtype)


def _field(
    maps: Tensor, items: int, channels: int, source: Sequence[int], shape: Sequence[int]
) -> launch.Field:
    return launch.Field().put(
        maps=maps,
        source=tuple(map(int, reversed(source))),
        shape=tuple(map(int, reversed(shape))),
        sources=maps.shape[0],
        kinds=maps.shape[1],
        items=items,
        channels=channels,
    )


def warp(volumes, maps, shape):
    """Warp volumes to other lattices; see `warp_reference`."""
    x, numbers, part = volumes.detach().contiguous(), launch.numbers_of(maps), part_of(volumes)
    items, sources, channels = x.shape[:3]
    values = x.new_empty(items, sources, maps.shape[1], channels, *shape, dtype=part.real)
    field = _field(numbers, items, channels, x.shape[3:], shape)
    field.put(origin=x, result=values, blocks=launch.blocks(math.prod(shape)))
    launch.blocks(math.prod(x.shape[3:]))
    across = sources * maps.shape[1] * field.blocks
    launch.start(part, "warp", field, x, across, items * -(-channels // PLANES))
    return values


def warp_transpose(values, maps, shape):
    """The exact transpose of `warp`: every voxel finds its samples by the inverse maps."""
    y, numbers, part = values.detach().contiguous(), launch.numbers_of(maps), part_of(values)
    items, sources, kinds, channels = y.shape[:4]
    volumes = y.new_empty(items, sources, channels, *shape, dtype=part.real)
    inverse = torch.empty(maps.shape, dtype=torch.float32, device=y.device)
    field = _field(numbers, items, channels, shape, y.shape[4:])
    field.put(origin=y, result=volumes, inverse=inverse, blocks=launch.blocks(math.prod(shape)))
    launch.check_count(math.prod(y.shape[4:]))
    launch.start(part, "invert", field, y, launch.blocks(sources * kinds))
    launch.start(
        part, "warp_back", field, y, sources * field.blocks, items * -(-channels // PLANES)
    )
    return volumes


def warp_vjp(volumes, values, maps):
    """The derivative of <values, warp(volumes, maps)> by the maps; float64."""
    x, numbers, part = volumes.detach().contiguous(), launch.numbers_of(maps), part_of(volumes)
    y = values.detach().to(part.real).contiguous()
    pairs = maps.shape[0] * maps.shape[1]
    field = _field(numbers, len(x), x.shape[2], x.shape[3:], y.shape[4:])
    count = min(launch.blocks(math.prod(y.shape[4:])), max(1, THREADS // BLOCK // max(1, pairs)))
    sums = numbers.new_zeros(pairs, count * BLOCK // WARP, MAP)
    field.put(origin=x, by=y, result=sums, blocks=count)
    launch.start(part, "warp_vary", field, x, pairs * count)
    return sums.sum(dim=1).view(maps.shape)
