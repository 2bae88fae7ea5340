"""Voxel-driven back-projection on the CPU, and its transpose: the same to the last bit for any
number of threads.

A thread owns slabs of the volume, in the transpose rows of views, and meets what adds to them in
one order.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.padding import padded, room, steps
from mvrecon.kernels.threads import share
from mvrecon.kernels.voxels.columns import look_up_columns, room_of, turned, upright
from mvrecon.kernels.voxels.loops import Sight, look_up, show_rows


def _sight(maps: Tensor, detector: Sequence[int], window: Sequence[float], weighted: bool) -> Sight:
    numbers = np.ascontiguousarray(maps.numpy(), dtype=np.float64)
    ends = (float(window[0]), float(window[1]))
    return Sight(
        numbers, (int(detector[1]), int(detector[0])), steps(detector), ends, bool(weighted)
    )


def look(
    views: Float[Tensor, "n m v u"],
    maps: Float[Tensor, "m 4 2 3"],
    window: Sequence[float],
    weighted: bool,
    shape: Sequence[int],
) -> Float[Tensor, "n d h w"]:
    """What every voxel sees in all views; see `voxel_reference.look`."""
    sight = _sight(maps, views.shape[2:], window, weighted)
    depth, height, width = map(int, shape)
    volumes = np.zeros([len(views), depth, height, width], dtype=views.numpy().dtype)
    level = upright(sight.maps, (depth, height, width))
    for mask, by_columns in ((~level, False), (level, True)):
        if mask.any():
            part = sight._replace(maps=np.ascontiguousarray(sight.maps[mask]))
            stack = views.numpy() if mask.all() else views.numpy()[:, mask]
            (_add_by_columns if by_columns else _add_by_rows)(stack, part, volumes)
    return torch.from_numpy(volumes)


def _add_by_rows(views: np.ndarray, sight: Sight, volumes: np.ndarray) -> None:
    flat, (_, depth, _, width) = padded(views, 2), volumes.shape

    def work(first: int, last: int) -> None:
        look_up(flat, sight, room(width, sight.steps, flat.dtype), volumes, first, last)

    share(work, depth, volumes.size * len(sight.maps), 4)


def _add_by_columns(views: np.ndarray, sight: Sight, volumes: np.ndarray) -> None:
    columns, (_, depth, height, _) = turned(views), volumes.shape

    def work(first: int, last: int) -> None:
        look_up_columns(columns, sight, room_of(columns, depth), volumes, first, last)

    share(work, height, volumes.size * len(sight.maps), 4)


def show(
    volumes: Float[Tensor, "n d h w"],
    maps: Float[Tensor, "m 4 2 3"],
    window: Sequence[float],
    weighted: bool,
    detector: Sequence[int],
) -> Float[Tensor, "n m v u"]:
    """The exact transpose of `look`."""
    sight = _sight(maps, detector, window, weighted)
    values, rows = np.ascontiguousarray(volumes.numpy()), int(detector[0])
    views = volumes.new_empty(len(volumes), len(maps), *detector)

    def work(first: int, last: int) -> None:
        for m in range(first // rows, (last - 1) // rows + 1):
            low, high = max(0, first - m * rows), min(rows, last - m * rows)
            own = (len(values), (high - low + 2) * int(sight.steps[1]))
            show_rows(
                values,
                sight,
                room(values.shape[3], sight.steps, values.dtype, own),
                views.numpy(),
                m,
                low,
                high,
            )

    share(work, len(maps) * rows, values.size * len(maps))
    return views
