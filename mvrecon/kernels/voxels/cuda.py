"""Voxel-driven back-projection on CUDA devices, and its transpose; deterministic."""

import math
from collections.abc import Sequence

from torch import Tensor

from mvrecon.kernels.cuda import launch

#: Voxels of a block along x, y and z, as in `3_voxels.cu`.
TILE = (16, 8, 8)


def _field(
    maps: Tensor, views: Tensor, volumes: Tensor, window: Sequence[float], weighted: bool
) -> launch.Field:
    return launch.Field().put(
        maps=maps,
        source=(views.shape[3], views.shape[2], 1),
        shape=tuple(volumes.shape[:0:-1]),
        kinds=len(maps),
        window=(float(window[0]), float(window[1])),
        weighted=weighted,
    )


def backproject(views, maps, window, weighted, shape):
    """Sum all views at the images of every voxel; see `backproject_reference`."""
    y = views.detach().contiguous()
    volumes = y.new_empty(len(y), *shape)
    numbers = launch.numbers_of(maps)
    field = _field(numbers, y, volumes, window, weighted).put(origin=y, result=volumes)
    launch.check_count(math.prod(map(int, shape)))
    tiles = math.prod(-(-int(n) // edge) for n, edge in zip(shape[::-1], TILE, strict=True))
    launch.start(
        launch.Variant(launch.VOXELS, y.dtype), "voxel_backproject", field, y, tiles, len(y)
    )
    return volumes


def project(volumes, maps, window, weighted, detector):
    """The exact transpose of `backproject`."""
    x = volumes.detach().contiguous()
    views = x.new_empty(len(x), len(maps), *detector)
    numbers = launch.numbers_of(maps)
    field = _field(numbers, views, x, window, weighted).put(origin=x, result=views)
    launch.start(
        launch.Variant(launch.VOXELS, x.dtype),
        "voxel_project",
        field,
        x,
        launch.blocks(math.prod(views.shape[1:])),
        len(x),
    )
    return views
