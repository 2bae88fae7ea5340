"""Voxel-driven back-projection on CUDA devices, and its transpose: the same to the last bit in
every run.
"""

import math
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.cuda.field import Field
from mvrecon.kernels.cuda.launching import blocks, check_count, numbers_of, start
from mvrecon.kernels.cuda.sources import TILE, Part


def _field(
    maps: Tensor, views: Tensor, volumes: Tensor, window: Sequence[float], weighted: bool
) -> Field:
    return Field().put(
        maps=maps,
        source=(views.shape[3], views.shape[2], 1),
        shape=tuple(volumes.shape[:0:-1]),
        kinds=len(maps),
        window=(float(window[0]), float(window[1])),
        weighted=weighted,
    )


def look(
    views: Float[Tensor, "n m v u"],
    maps: Float[Tensor, "m 4 2 3"],
    window: Sequence[float],
    weighted: bool,
    shape: Sequence[int],
) -> Float[Tensor, "n d h w"]:
    """What every voxel sees in all views; see `voxels.reference.look`."""
    y = views.detach().contiguous()
    volumes = y.new_empty(len(y), *shape)
    numbers = numbers_of(maps)
    field = _field(numbers, y, volumes, window, weighted).put(origin=y, result=volumes)
    check_count(math.prod(map(int, shape)))
    tiles = math.prod(-(-int(n) // edge) for n, edge in zip(shape[::-1], TILE, strict=True))
    start(Part("look", y.dtype), "look", field, y, tiles, len(y))
    return volumes


def show(
    volumes: Float[Tensor, "n d h w"],
    maps: Float[Tensor, "m 4 2 3"],
    window: Sequence[float],
    weighted: bool,
    detector: Sequence[int],
) -> Float[Tensor, "n m v u"]:
    """The exact transpose of `look`."""
    x = volumes.detach().contiguous()
    views = x.new_empty(len(x), len(maps), *detector)
    numbers = numbers_of(maps)
    field = _field(numbers, views, x, window, weighted).put(origin=x, result=views)
    start(Part("look", x.dtype), "show", field, x, blocks(math.prod(views.shape[1:])), len(x))
    return views
