"""Filtered back-projection block by block, so that views may be larger than memory."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit
from mvrecon.kernels.device_cache import device_cached, grid_key
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.methods.classical.filtered.filters import Filter, filter_rows, ramp_response
from mvrecon.methods.classical.filtered.scan_weights import (
    Scan,
    ScanKind,
    along,
    fan_coordinate,
    redundancy,
    scan_of,
)
from mvrecon.operators.checks import check_floating, check_views
from mvrecon.operators.voxel_driven import Images, backproject_images, image_maps


def pixel_weights(
    rig: Cameras, scan: Scan, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "m v u"]:
    """The weights of views' pixels, without unit: radian per pixel times mm per mm.

    Args:
        rig: the views' cameras.
        scan: of these views, on the cameras' device.
        dtype: of the arithmetic over pixels; geometry is float64.
    """
    orbit, device = scan.orbit, rig.source.device
    v, u = (torch.arange(n, dtype=dtype, device=device) for n in rig.shape)
    tangents, rows, pitch = orbit.tangents, unit(rig.u), rig.u.norm(dim=-1)
    slant = (tangents * rows).sum(dim=-1)
    angle = (scan.steps / pitch).to(dtype)[:, None, None]
    fan = _fan(rig, scan, u, v)
    share = redundancy(scan, fan) * angle
    if rig.parallel:
        return share / slant.abs().to(dtype)[:, None, None]
    start = rig.origin - rig.source
    by_row, by_motion = along(start, rig, rows, u, v), along(start, rig, tangents, u, v)
    square = _squares(rig, u, v)
    motion = slant.to(dtype)[:, None, None] * square - by_row * by_motion
    return share * orbit.radius * motion.abs() * square.rsqrt() / (square - by_row.square())


def _fan(
    rig: Cameras, scan: Scan, u: Float[Tensor, " u"], v: Float[Tensor, " v"]
) -> Float[Tensor, "m v u"]:
    """Fan coordinates; of one pixel a view where the shares do not depend on them."""
    if scan.kind == "full":
        return u.new_zeros(len(rig), 1, 1)
    return fan_coordinate(rig, scan.orbit, u, v)


def _squares(
    rig: Cameras, u: Float[Tensor, " u"], v: Float[Tensor, " v"]
) -> Float[Tensor, "m v u"]:
    """Squared distances of pixels from the source in mm^2."""
    axis_u, axis_v = unit(rig.u), unit(rig.v)
    normal = unit(torch.linalg.cross(axis_u, axis_v))
    start = rig.origin - rig.source
    level = torch.linalg.cross(normal, axis_u)
    parts = (along(start, rig, axis, u, v).square() for axis in (axis_u, level))
    depth = (start * normal).sum(dim=-1).square().to(u)[:, None, None]
    return sum(parts, start=depth)


#: Pixels in memory at a time, weighted and filtered: 8 bytes for each of them.
BLOCK_PIXELS = 2**24
#: Pixels filtered at a time, which takes about 24 bytes for each of them.
FILTERED_PIXELS = 2**21

#: read(first, last): the views [b c first..last v u].
Read = Callable[[int, int], Tensor]


@dataclass(frozen=True, eq=False)
class Filtering:
    """How views are weighted and filtered; see `fdk`."""

    filter: Filter = "ram-lak"
    cutoff: float = 1.0
    scan: ScanKind = "auto"
    weights_from: Cameras | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """What is computed of a rig before any view is filtered.

    Args:
        rig: that weights and filter belong to.
        scan: of this rig.
        response: of the filter.
        images: where every voxel is seen in the filtered views.
        pixels: of a filtered view.
    """

    rig: Cameras
    scan: Scan
    response: Float[Tensor, " frequency"]
    images: Images
    pixels: int

    def to(self, device: torch.device) -> "Plan":
        """The same on a device."""
        rig, scan, response = (x.to(device) for x in (self.rig, self.scan, self.response))
        images = self.images._replace(maps=self.images.maps.to(device))
        return replace(self, rig=rig, scan=scan, response=response, images=images)

    def filtered(self, views: Float[Tensor, "b c k v u"], part: slice) -> Tensor:
        """Some of the views, weighted and filtered, a few at a time."""
        volumes, rows = views.shape[0] * views.shape[1], []
        size = max(1, FILTERED_PIXELS // (volumes * self.pixels))
        for some in _slices(part.start, part.stop, size):
            weights = pixel_weights(self.rig[some], self.scan.of(some), views.dtype)
            block = views[:, :, some.start - part.start : some.stop - part.start]
            block = pad(block * weights, self.scan.columns)
            rows.append(filter_rows(block, self.response).contiguous())
        return rows[0] if len(rows) == 1 else torch.cat(rows, dim=2)


def _plan(cameras: Cameras, grid: Grid, filtering: Filtering) -> Plan:
    rig = cameras if filtering.weights_from is None else filtering.weights_from
    scan = scan_of(rig, grid, filtering.scan)
    target = _widened(cameras, *scan.columns)
    response = ramp_response(target.shape[1], filtering.filter, filtering.cutoff)
    maps = image_maps(target, grid)
    images = Images(maps, target.ray_extent, grid.shape)
    return Plan(rig, scan, response, images, math.prod(target.shape))


def _known(
    cameras: Cameras, grid: Grid, filtering: Filtering, like: Tensor, make: Callable[[], Plan]
) -> Plan:
    """A plan that is made once on each device, but with weights from another rig, which may be
    written to.
    """
    if filtering.weights_from is not None:
        return make()
    options = filtering.filter, filtering.cutoff, filtering.scan
    return device_cached(cameras, ("filtering", grid_key(grid), *options), like, make)


def _slices(first: int, last: int, size: int) -> Iterator[slice]:
    """Consecutive parts of a range, each of so many at most."""
    for start in range(first, last, size):
        yield slice(start, min(start + size, last))


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
    plan = _known(cameras, grid, filtering, cameras.source, lambda: _plan(cameras, grid, filtering))
    size = max(1, BLOCK_PIXELS // (volumes * plan.pixels))
    total = None
    for part in _slices(0, len(cameras), size):
        views = read(part.start, part.stop)
        check_views(views, cameras[part])
        check_floating(views, "views")
        near = _known(cameras, grid, filtering, views, lambda to=views.device: plan.to(to))
        images = near.images._replace(maps=near.images.maps[part])
        volume = backproject_images(
            near.filtered(to_accumulation_dtype(views), part), images, weighted=True
        )
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
