"""Filtered back-projection block by block, so that views may be larger than memory."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.precision import wide
from mvrecon.projectors.checks import check_floating, check_views
from mvrecon.projectors.voxel_driven import backproject
from mvrecon.reconstruct.filtered.filters import Filter, filter_rows, ramp_response
from mvrecon.reconstruct.filtered.pixel_weights import pixel_weights
from mvrecon.reconstruct.filtered.scan_weights import ScanKind, scan_of

#: Pixels in memory at a time; filtering takes about 24 bytes for each of them.
BLOCK_PIXELS = 2**24

#: read(first, last): the views [b c first..last v u].
Read = Callable[[int, int], Tensor]


@dataclass(frozen=True, eq=False)
class Filtering:
    """How views are weighted and filtered; see `fdk`."""

    filter: Filter = "ram-lak"
    cutoff: float = 1.0
    scan: ScanKind = "auto"
    weights_from: Cameras | None = None


def filtered_backprojection(
    read: Read, cameras: Cameras, grid: Grid, volumes: int, filtering: Filtering
) -> Float[Tensor, "b c d h w"]:
    """FBP or FDK of views [b c m v u] that are read in blocks.

    Args:
        read: gives a block of views.
        cameras: the rig, of all views.
        grid: the voxels.
        volumes: b c, for the size of the blocks.
        filtering: the options.

    Raises:
        ValueError: a rig, option or block of views that does not fit.
    """
    ideal = cameras if filtering.weights_from is None else filtering.weights_from
    if (len(ideal), ideal.shape) != (len(cameras), cameras.shape):
        raise ValueError(
            f"Expected weights_from as a rig of {len(cameras)} views of {cameras.shape}, got "
            f"{len(ideal)} of {ideal.shape}"
        )
    plan = scan_of(ideal, grid, filtering.scan)
    target = _widened(cameras, *plan.columns)
    response = ramp_response(target.shape[1], filtering.filter, filtering.cutoff)
    size = max(1, BLOCK_PIXELS // (volumes * math.prod(target.shape)))
    total = None
    for first in range(0, len(cameras), size):
        part = slice(first, min(first + size, len(cameras)))
        views = read(part.start, part.stop)
        check_views(views, cameras[part])
        check_floating(views, "views")
        weights = pixel_weights(ideal, plan, part, wide(views).dtype).to(views.device)
        rows = filter_rows(pad(wide(views) * weights, plan.columns), response)
        volume = backproject(rows, target[part], grid, "distance")
        total = volume if total is None else total.add_(volume)
    assert total is not None  # a rig has at least one camera
    return total


def _widened(cameras: Cameras, before: int, behind: int) -> Cameras:
    """The rig with further columns before and behind its own."""
    shift, shape = before * cameras.u, (cameras.shape[0], cameras.shape[1] + before + behind)
    source = cameras.source - shift if cameras.parallel else cameras.source
    return replace(cameras, source=source, origin=cameras.origin - shift, shape=shape)


def fdk_streamed(
    read: Callable[[int, int], Any],
    cameras: Cameras,
    grid: Grid,
    filter: Filter = "ram-lak",
    cutoff: float = 1.0,
    scan: ScanKind = "auto",
    weights_from: Cameras | None = None,
) -> Float[Tensor, "1 1 d h w"]:
    """FDK of views that are read block by block, in (unit of the views) / mm.

    Memory: twice the volume, and a block of about 16 million pixels. The blocks come in order, each
    view once.

    Args:
        read: read(first, last) gives the views first to last - 1 as an array [m v u].
        cameras: the rig, of all views.
        grid: the voxels.
        filter, cutoff, scan, weights_from: as `fdk`.

    Raises:
        ValueError: a rig, option or block of views that does not fit.
    """

    def block(first: int, last: int) -> Tensor:
        return torch.as_tensor(read(first, last))[None, None]

    with torch.no_grad():
        filtering = Filtering(filter, cutoff, scan, weights_from)
        return filtered_backprojection(block, cameras, grid, 1, filtering)
