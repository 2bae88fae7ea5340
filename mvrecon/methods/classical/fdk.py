"""FDK of cone beams and FBP of parallel and fan beams: rows are weighted, filtered and
back-projected block by block, so that views may be larger than memory.
"""

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import half_fan
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.methods.classical.orbit import along, beyond_rows, warn_of_axial_errors, warn_of_ends
from mvrecon.methods.classical.redundancy import RedundancyWeights, redundancy_weights
from mvrecon.methods.classical.solver import declares
from mvrecon.methods.classical.truncation import (
    PARTS,
    ROW_BLOCKS,
    continuation,
    edges_of,
    reach_rows,
    truncated,
    warn_of_truncation,
)
from mvrecon.operators.checks import check_floating, check_measured, check_views
from mvrecon.operators.memo import grid_key, kept, place
from mvrecon.operators.operator import Projector, Scaled
from mvrecon.operators.voxel_driven import (
    Images,
    add_backprojection,
    backproject_images,
    image_maps,
)

Filter = Literal["ram-lak", "shepp-logan", "cosine", "hamming", "hann"]

#: Windows of the ramp as functions of frequency over the band limit, from 0 to 1.
WINDOWS: dict[str, Callable[[Tensor], Tensor]] = {
    "ram-lak": torch.ones_like,
    "shepp-logan": lambda f: torch.sinc(f / 2),
    "cosine": lambda f: torch.cos(math.pi / 2 * f),
    "hamming": lambda f: 0.54 + 0.46 * torch.cos(math.pi * f),
    "hann": lambda f: 0.5 + 0.5 * torch.cos(math.pi * f),
}


#: Columns of the kernels from which those of shorter rows are taken.
KERNEL = 2**15


def padded_length(columns: int) -> int:
    """The least even length of at least twice the columns without a prime factor above 5, so that
    one period of the filter holds a row and its whole response.
    """
    length = max(2, 2 * columns)
    while length % 2 or _rough(length):
        length += 1
    return length


def _rough(length: int) -> bool:
    for prime in (2, 3, 5):
        while length % prime == 0:
            length //= prime
    return length > 1


def ramp_response(
    columns: int, filter: Filter = "ram-lak", cutoff: float = 1.0
) -> Float[Tensor, " frequency"]:
    """The windowed ramp filter's frequency response for rows of pixels 1 mm wide, in 1/mm.

    The transform of the spatially sampled ramp, h(0) = 1/4, h(n) = -1 / (pi n)^2 for odd n, else 0,
    which preserves constants (Kak and Slaney, Principles of Computerized Tomographic Imaging, 1988,
    ch. 3, eq. 61), or of as many values of the windowed ramp's kernel.

    Args:
        columns: pixels of a row.
        filter: the window, "ram-lak" (none), "shepp-logan", "cosine", "hamming" or "hann".
        cutoff: the band limit as a fraction of the Nyquist frequency, in (0, 1].

    Raises:
        ValueError: an unknown filter, or a band limit outside (0, 1].
    """
    if filter not in WINDOWS:
        raise ValueError(f"Unknown filter {filter!r}. Known: {', '.join(WINDOWS)}")
    if not 0 < cutoff <= 1:
        raise ValueError(
            f"Expected cutoff as a fraction of the Nyquist frequency in (0, 1], got {cutoff!r}"
        )
    # longer than rows, which all take their part of one windowed kernel
    length, every = padded_length(columns), padded_length(max(KERNEL, 2 * columns))
    n = torch.arange(every, dtype=torch.float64)
    n = torch.minimum(n, every - n)
    kernel = torch.where(n % 2 == 1, -1 / (math.pi * n.clamp_min(1)) ** 2, 0.0)
    kernel[0] = 0.25
    fraction = torch.linspace(0, 1, every // 2 + 1, dtype=torch.float64) / cutoff
    window = torch.where(fraction <= 1, WINDOWS[filter](fraction), 0.0)
    kernel = torch.fft.irfft(torch.fft.rfft(kernel).real * window, n=every)[: length // 2 + 1]
    return torch.fft.rfft(torch.cat([kernel, kernel[1:-1].flip(0)])).real


def filter_rows(
    views: Float[Tensor, "*n u"], response: Float[Tensor, " frequency"]
) -> Float[Tensor, "*n u"]:
    """Convolve rows with a filter of `ramp_response`; in (unit of the views) / pixel.

    Divide by the pixel pitch in mm for (unit of the views) / mm. Rows are zero-padded.
    """
    length = 2 * (len(response) - 1)
    spectrum = torch.fft.rfft(views, n=length)
    spectrum *= response.to(views)  # in place: it takes twice the memory of the views
    return torch.fft.irfft(spectrum, n=length)[..., : views.shape[-1]]


def pixel_weights(
    rig: Cameras, scan: RedundancyWeights, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "m v u"]:
    """Return the weight of each pixel of the views, in radians per pixel.

    Args:
        rig: cameras of the views.
        scan: weights of these views' rays, on the cameras' device.
        dtype: type of the computation over pixels; geometry is float64.
    """
    device, tangents, rows = rig.source.device, scan.orbit.tangents, unit(rig.u)
    v, u = (torch.arange(n, dtype=dtype, device=device) for n in rig.shape)
    slant = (tangents * rows).sum(dim=-1)
    share = scan.of_rays(rig, u, v) / rig.u.norm(dim=-1).to(dtype)[:, None, None]
    if rig.parallel:
        return share / slant.abs().to(dtype)[:, None, None]
    start = rig.origin - rig.source
    by_row, by_motion = along(start, rig, rows, u, v), along(start, rig, tangents, u, v)
    # squared distances of pixels from the source in mm^2
    normal = unit(torch.linalg.cross(rows, unit(rig.v)))
    level = along(start, rig, torch.linalg.cross(normal, rows), u, v)
    square = (start * normal).sum(dim=-1).square().to(u)[:, None, None]
    square = square + by_row.square() + level.square()
    motion = slant.to(dtype)[:, None, None] * square - by_row * by_motion
    # rows tilted against the plane of the sources are further apart than their filter has them
    level = 1 - (rows @ scan.orbit.axis).square().to(dtype)[:, None, None]
    weight = scan.orbit.radius * motion.abs() * square.rsqrt() / (square - by_row.square())
    return share * weight / level


#: Pixels weighted and held in memory at a time, of 8 bytes each.
BLOCK_PIXELS = 2**24
#: Pixels filtered at a time, of about 24 bytes each, of 72 where rows are continued.
FILTERED_PIXELS = 2**20

#: read(first, last) returns the views [b c first..last v u].
Read = Callable[[int, int], Tensor]


@dataclass(frozen=True, eq=False)
class Filtering:
    """Options of weighting and filtering; see `fdk`."""

    filter: Filter = "ram-lak"
    cutoff: float = 1.0
    max_missing: float = 0.1
    weights_from: Cameras | None = None
    extrapolate: bool = True


@dataclass(frozen=True, eq=False)
class FilterPlan:
    """Quantities of a rig that are computed before any view is filtered.

    Args:
        rig: cameras for weights and filter.
        scan: weights of this rig's rays.
        response: frequency response of the filter.
        longer: frequency response of the filter of rows that are continued by `beyond` columns on
            each side; None: none are.
        beyond: these columns.
        images: images of all voxels in the filtered views.
        pixels: number of pixels of a filtered view.
        beyond_rows: the voxels that rows of views do not reach, in words; None: few.
    """

    rig: Cameras
    scan: RedundancyWeights
    response: Float[Tensor, " frequency"]
    longer: Float[Tensor, " frequency"] | None
    beyond: int
    images: Images
    pixels: int
    beyond_rows: str | None

    def to(self, device: torch.device) -> "FilterPlan":
        """Move to a device."""
        rig, scan, response = (x.to(device) for x in (self.rig, self.scan, self.response))
        longer = None if self.longer is None else self.longer.to(device)
        images = self.images._replace(maps=self.images.maps.to(device))
        return replace(self, rig=rig, scan=scan, response=response, longer=longer, images=images)

    def filtered(
        self, views: Float[Tensor, "b c k v u"], part: slice
    ) -> tuple[Tensor, Float[Tensor, "b c k 10 i"]]:
        """Weight and filter a part of the views, a few at a time; also returns their `edges_of`."""
        volumes, rows = views.shape[0] * views.shape[1], views.new_empty(0)
        edges = views.new_empty(*views.shape[:3], sum(PARTS), min(ROW_BLOCKS, views.shape[3]))
        size = max(1, FILTERED_PIXELS // (volumes * self.pixels))
        for some in _slices(part.start, part.stop, size):
            weights = pixel_weights(self.rig[some], self.scan.of(some), views.dtype)
            own = slice(some.start - part.start, some.stop - part.start)
            raw = views[:, :, own]
            block = raw * weights
            edges[:, :, own] = edges_of(raw.detach(), weights)
            cut = truncated(edges[:, :, own])
            # a GPU would have to be waited for to know that no view is cut
            if self.longer is None or (cut.is_cpu and not cut.any()):
                block = filter_rows(pad(block, self.scan.columns), self.response)
            else:
                ends = (end * cut for end in continuation(raw, weights, self.beyond))
                block = filter_rows(torch.cat([next(ends), block, next(ends)], dim=-1), self.longer)
                before, behind = self.scan.columns
                block = block[..., self.beyond - before : block.shape[-1] - self.beyond + behind]
            if not len(rows):
                rows = block.new_empty(*views.shape[:3], block.shape[3] + 2, block.shape[4])
            rows[:, :, own, 1:-1] = block
        rows[..., 0, :], rows[..., -1, :] = rows[..., 1, :], rows[..., -2, :]
        return rows, edges


def _plan(cameras: Cameras, grid: Grid, filtering: Filtering) -> FilterPlan:
    # a copy, as the plan is cached beside the cameras, which would never be released
    rig = (cameras if filtering.weights_from is None else filtering.weights_from)[:]
    scan = redundancy_weights(rig, grid, filtering.max_missing)
    warn_of_axial_errors(rig, scan.orbit, grid)
    warn_of_ends(rig, scan.orbit, grid)
    if not rig.parallel and half_fan(rig):
        _warn_of_distances((rig.source - scan.orbit.centre).norm(dim=-1))
    # empty columns before and behind the rig's own, and its outermost rows once more, as the
    # back-projection fades to zero from their centres on, and they reach half a pixel further
    before, behind = scan.columns
    shape = (cameras.shape[0] + 2, cameras.shape[1] + before + behind)
    first = cameras.source.new_tensor([[-before, -1]])
    target = replace(cameras.shifted(first), shape=shape)
    window, longer, beyond = (filtering.filter, filtering.cutoff), None, 0
    response = ramp_response(target.shape[1], *window)
    if filtering.extrapolate:
        beyond = max(cameras.shape[1], before, behind)
        longer = ramp_response(target.shape[1] + beyond, *window)
    images = Images(image_maps(target, grid), target.ray_extent, grid.shape)
    low = beyond_rows(rig, scan.orbit, grid)
    return FilterPlan(rig, scan, response, longer, beyond, images, math.prod(target.shape), low)


#: Deviation of a source's distance from the axis, relative to its mean, from which on a half fan
#: reads values wrong by 2 %: up to 2.2 times as much, of three or five periods a turn.
MAX_DISTANCE_DEVIATION = 0.009


def _warn_of_distances(distances: Float[Tensor, " m"]) -> None:
    """Warn of a half fan's sources at different distances in mm: the opposite rays, with which
    other scans average this, are not measured.
    """
    deviation = (distances / distances.mean() - 1).abs().max().item()
    if deviation > MAX_DISTANCE_DEVIATION:
        warnings.warn(
            f"The sources' distances from the axis of rotation differ from their mean by up to "
            f"{deviation:.1%}: of a half fan filtered back-projection can be off by "
            f"{2.2 * deviation:.0%}; use sirt",
            stacklevel=2,
        )


def _known(
    cameras: Cameras, grid: Grid, filtering: Filtering, like: Tensor, make: Callable[[], FilterPlan]
) -> FilterPlan:
    """Return the plan, cached on each device; not cached with another rig's weights, which may
    change.
    """
    if filtering.weights_from is not None:
        return make()
    window = filtering.filter, filtering.cutoff
    options = *window, filtering.max_missing, filtering.extrapolate
    return kept(cameras, ("filtering", grid_key(grid), *options, place(like)), make)


def _slices(first: int, last: int, size: int) -> Iterator[slice]:
    """Consecutive parts of a range, each of at most `size`."""
    for start in range(first, last, size):
        yield slice(start, min(start + size, last))


def filtered_backprojection(
    read: Read, cameras: Cameras, grid: Grid, volumes: int, filtering: Filtering
) -> Float[Tensor, "b c d h w"]:
    """FBP or FDK of views [b c m v u] that are read in blocks.

    Args:
        read: returns a block of views.
        cameras: all cameras.
        grid: the voxels.
        volumes: b c, which determines the size of the blocks.
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
    total, edges, ends = None, [], []
    for part in _slices(0, len(cameras), size):
        views = read(part.start, part.stop)
        check_views(views, cameras[part])
        check_floating(views, "views")
        near = _known(cameras, grid, filtering, views, lambda to=views.device: plan.to(to))
        images = near.images._replace(maps=near.images.maps[part])
        views = to_accumulation_dtype(views)
        filtered, sides = near.filtered(views, part)
        edges.append(sides)
        # all that a single row sees extends beyond it, and a GPU would have to be waited for
        if plan.beyond_rows and cameras.shape[0] > 1 and views.is_cpu:
            ends.append(edges_of(views.detach().mT))
        if total is None:
            total = backproject_images(filtered, images, weighted=True)
        elif torch.is_grad_enabled():
            total.add_(backproject_images(filtered, images, weighted=True))
        else:
            add_backprojection(total, filtered, images)
    assert total is not None  # a rig has at least one camera
    if edges[0].is_cpu:  # a GPU would have to be waited for
        warn_of_truncation(torch.cat(edges, dim=2), filtering.extrapolate)
    if plan.beyond_rows and (not ends or reach_rows(torch.cat(ends, dim=2))):
        warnings.warn(plan.beyond_rows, stacklevel=2)
    return total


def fdk_streamed(
    read: Callable[[int, int], Any],
    cameras: Cameras,
    grid: Grid,
    filter: Filter = "ram-lak",
    cutoff: float = 1.0,
    max_missing: float = 0.1,
    weights_from: Cameras | None = None,
    extrapolate: bool = True,
) -> Float[Tensor, "1 1 d h w"]:
    """FDK of views that are read block by block, in (unit of the views) / mm.

    Memory: the volume, and a few blocks of about 16 million pixels. Blocks are read in order, each
    view once.

    Args:
        read: read(first, last) returns the views first to last - 1 as an array [m v u].
        cameras: all cameras.
        grid: the voxels.
        filter, cutoff, max_missing, weights_from, extrapolate: see `fdk`.

    Returns:
        The volume on the grid, as `fdk` of all views at once.

    Raises:
        ValueError: a rig, option or block of views that does not fit.

    Examples:
        >>> rig = mv.circular(60, sid=200, sdd=300, detector={"pixels": [24, 40], "pixel_mm": 3.0})
        >>> A = mv.Drr(mv.Grid.centred(16, spacing=2.0), rig)
        >>> views = A(torch.ones(1, 1, 16, 16, 16))  # in practice read from a file
        >>> volume = mv.fdk_streamed(lambda first, last: views[0, 0, first:last], rig, A.grid)
        >>> torch.allclose(volume, mv.fdk(A, views), atol=1e-5)
        True
    """

    def block(first: int, last: int) -> Tensor:
        return torch.as_tensor(read(first, last))[None, None]

    with torch.no_grad():
        filtering = Filtering(filter, cutoff, max_missing, weights_from, extrapolate)
        return filtered_backprojection(block, cameras, grid, 1, filtering)


@declares(streamed=fdk_streamed)
def fdk(
    A: Projector,
    views: Float[Tensor, "b c m v u"],
    filter: Filter = "ram-lak",
    cutoff: float = 1.0,
    max_missing: float = 0.1,
    weights_from: Cameras | None = None,
    extrapolate: bool = True,
) -> Float[Tensor, "b c d h w"]:
    """FDK, filtered back-projection of a circular cone-beam scan, in (unit of the views) / mm; of
    parallel beams it is `fbp`.

    Supports cameras whose sources lie roughly on a circle and whose rows run across its axis; steps
    may be uneven, detectors shifted and turned. Exact in the plane of the sources, approximate
    above and below it. Differentiable in the views, and linear but for the continued rows of views
    that end inside the object (Feldkamp, Davis and Kress, Practical cone-beam algorithm, JOSA A 1,
    1984).

    Args:
        A: the operator, whose grid and cameras are used.
        views: line integrals.
        filter: the ramp's window, "ram-lak" (none), "shepp-logan", "cosine", "hamming" or "hann".
        cutoff: band limit as a fraction of the detector's Nyquist frequency, in (0, 1].
        max_missing: greatest share of the lines through the grid's inscribed cylinder, in the
            plane of the sources, that no ray measures. A warning names the lines from 1 % on.
        weights_from: the rig for weights and filter if it differs from A's, such as the ideal
            geometry of a misaligned scanner (Karolczak and others, Med. Phys. 28, 2001).
        extrapolate: continue the rows of views that end inside the object, as those of ellipses.

    Returns:
        The volume on the operator's grid.

    Raises:
        ValueError: sources that are not on a circle, too many lines that no ray
            measures, views of another shape or with non-finite values, an unknown option, or an
            operator with weights.

    Examples:
        >>> rig = mv.circular(60, sid=200, sdd=300, detector={"pixels": [24, 40], "pixel_mm": 3.0})
        >>> A = mv.Drr(mv.Grid.centred(16, spacing=2.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 8, 8, 8), [4] * 6)  # a cube
        >>> volume = mv.fdk(A, A(x))
        >>> round(volume[0, 0, 8, 8, 8].item(), 1)
        1.0
    """
    _plain(A, "fdk")
    filtering = Filtering(filter, cutoff, max_missing, weights_from, extrapolate)
    return _reconstruct(A, views, filtering)


def fbp(
    A: Projector,
    views: Float[Tensor, "b c m v u"],
    filter: Filter = "ram-lak",
    cutoff: float = 1.0,
    max_missing: float = 0.1,
    extrapolate: bool = True,
) -> Float[Tensor, "b c d h w"]:
    """Filtered back-projection of parallel or fan beams, in (unit of the views) / mm.

    Parallel beams: one slice, a stack of slices, or a volume; angles in any order, over at least
    180 degrees, with uneven steps. Fan beams: one slice, from a flat detector of one row in the
    plane of the sources; for a stack of slices use a batch. Differentiable in the views, and linear
    but for the continued rows of views that end inside the object (Kak and Slaney, Principles of
    Computerized Tomographic Imaging, 1988, ch. 3).

    Args:
        A: the operator, whose grid and cameras are used.
        views: line integrals.
        filter, cutoff, max_missing, extrapolate: see `fdk`.

    Returns:
        The volume on the operator's grid.

    Raises:
        ValueError: a cone beam, insufficient angles, views of another shape or with non-finite
            values, an unknown option, or an operator with weights.

    Examples:
        >>> rig = mv.parallel(60, detector={"pixels": [1, 48], "pixel_mm": 1.0})
        >>> A = mv.Radon(mv.Grid.centred(size=(32, 32, 1), spacing=1.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 1, 16, 16), [8] * 4)  # a square
        >>> volume = mv.fbp(A, A(x))
        >>> round(volume[0, 0, 0, 16, 16].item(), 1)
        1.0
    """
    cameras = _plain(A, "fbp")
    if not cameras.parallel and cameras.shape[0] > 1:
        raise ValueError(
            f"fbp needs parallel beams or fans of one row, got a cone beam of {cameras.shape[0]} "
            f"rows; use fdk"
        )
    filtering = Filtering(filter, cutoff, max_missing, extrapolate=extrapolate)
    return _reconstruct(A, views, filtering)


def _plain(A: Projector, name: str) -> Cameras:
    """The cameras of an operator that computes plain line integrals."""
    if isinstance(A, Scaled):
        raise ValueError(
            f"{name} needs plain line integrals, got an operator with weights, "
            f"{type(A).__name__}; use sirt or mlem"
        )
    if not (hasattr(A, "grid") and hasattr(A, "cameras")):
        raise ValueError(
            f"{name} needs an operator with a grid and cameras, got {type(A).__name__}; use sirt"
        )
    return A.cameras


def _reconstruct(
    A: Projector, views: Float[Tensor, "b c m v u"], filtering: Filtering
) -> Float[Tensor, "b c d h w"]:
    check_measured(views, "views [b c m v u]", (len(A.cameras), *A.cameras.shape), views.device)

    def read(first: int, last: int) -> Tensor:
        return views[:, :, first:last]

    volumes = views.shape[0] * views.shape[1]
    x = filtered_backprojection(read, A.cameras, A.grid, volumes, filtering)
    support = getattr(A, "support", None)
    return x if support is None else torch.where(support, x, 0)
