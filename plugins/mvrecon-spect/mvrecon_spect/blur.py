"""Collimator and intrinsic blur of pinholes by layers of magnification, with a matched adjoint.

For a pinhole with its detector at the distance l behind it, the image of a point at the depth z in
front of it is the hole's image, of the width d_re (1 + l / z), blurred by the detector's intrinsic
resolution R_i. Referred to the object, R^2 = (d_re (z + l) / l)^2 + (R_i z / l)^2 (Anger; Metzler &
Accorsi, Phys. Med. Biol. 50 (2005) 5005). The width is linear in l / z, so line integrals are
distributed linearly among a few layers at equal steps of l / z, and each layer is blurred as a
whole: with 8 layers over the depth range of a heart, the variance of a profile is accurate to 0.1
%.

Voxels behind a pinhole's plane do not contribute. Layers extend from the nearest to the farthest
visible point of the grid; a grid very close to a pinhole requires more layers, and points closer
than the first layer receive its blur.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from types import ModuleType
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import seen_depth_range
from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.operators.memo import FixedGeometry
from mvrecon.operators.operator import LinearOperator, Projector, check, check_floating
from mvrecon.operators.selection import ViewSelection
from mvrecon_spect.attenuated import (
    ACROSS,
    attenuated_kernels,
    check_mu,
    is_zero,
    kept_transmission,
)
from mvrecon_spect.extent import blurred, blurred_whole
from mvrecon_spect.hole import Hole
from mvrecon_spect.kernels.ops import SEGMENTS
from mvrecon_spect.kernels.reference import DISTANCE_DRIVEN
from mvrecon_spect.matter import Beyond
from mvrecon_spect.rays import spread

#: Layers of magnification that are blurred together; maximum number of values in layers of views in
#: memory at a time.
LAYERS, AT_ONCE = 8, 2**22
#: If 8 layers would be further apart than `STEP` in l / z, 16 or `MOST` are used, so that a
#: profile's variance between two layers is accurate to 1 %.
STEP, MOST = 0.2, 24
#: Subpixels per axis on which a hole's image is rasterised; FWHM in standard deviations.
PARTS, FWHM = 16, 2 * math.sqrt(2 * math.log(2))


class Optics(NamedTuple):
    """The hole, the intrinsic resolution of the detector (FWHM in mm, 0: none), and attenuation
    outside the grid.
    """

    hole: Hole
    intrinsic_mm: float = 0.0
    beyond: Beyond | None = None

    def weight(self, cameras: Cameras) -> Float[Tensor, "m v u"]:
        """Counts of each pixel per line integral in the grid, in mm^2."""
        weight = self.hole.weight(cameras)
        return weight if self.beyond is None else weight * self.beyond.transmission(cameras)

    def mean(self, cameras: Cameras, n: int) -> Float[Tensor, "m v u"]:
        """The mean of `weight` over n x n rays of each pixel."""
        return self.weight(spread(cameras, n)).unflatten(0, (-1, n**2)).mean(dim=1)


class BlurredPinholes(FixedGeometry):
    """Counts [b c m v u] behind blurring pinholes of volumes [b c d h w] in counts / mm^3, Blur(w *
    attenuated integral), and the matched adjoint.

    Activity outside the detector's field of view blurs into it. Empty layers and pixels are
    skipped, which changes only rounding errors of the convolution; on a GPU, where this would
    synchronise, nothing is skipped. Differentiable in the volume and mu, and in the cameras with
    the reference back end.

    Args:
        grid: grid of the activity. Voxels behind a pinhole's plane do not contribute.
        cameras: pinholes with detectors perpendicular to their axes.
        mu: linear attenuation on the grid in 1/mm; None: no attenuation.
        optics: hole and intrinsic resolution.
        method, backend: see `AttenuatedTransform`.
        rays_per_pixel: n; a pixel is the weighted sum of n x n rays, before the blur.

    Raises:
        ValueError: invalid attenuation (see `AttenuatedTransform`), or an unsupported method.
    """

    mu: Tensor

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras,
        mu: Float[Tensor, "d h w"] | None,
        optics: Optics,
        method: str = "joseph",
        backend: str = "auto",
        rays_per_pixel: int = 1,
    ):
        super().__init__()
        if method not in SEGMENTS:
            raise ValueError(f"Expected method {', '.join(SEGMENTS)} with blur, got {method!r}")
        self.built_from(grid, cameras)
        self.optics = optics
        self.method, self.backend, self.rays_per_pixel = method, backend, rays_per_pixel
        mu = torch.zeros(grid.shape) if mu is None else mu
        check_mu(mu, grid)
        self.register_buffer("mu", mu, persistent=False)
        self.longest = sum(grid.spacing)  # no segment in a slab or a cell is longer
        self.domain_shape, self.range_shape = grid.shape, (len(cameras), *cameras.shape)
        self.blocks = list(self._blocks())
        self.views: Tensor
        self.register_buffer("views", _order(self.blocks), persistent=False)

    @property
    def device(self) -> torch.device:
        return self.mu.device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "BlurredPinholes":
        super()._apply(fn, recurse)
        self.blocks = [block.to(self.device) for block in self.blocks]  # their precision stays
        return self

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """mu, or None if it is zero everywhere."""
        return None if is_zero(self.mu) else self.mu

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Project volumes to views.

        Raises:
            ValueError: a wrong rank, size, device or dtype.
            RuntimeError: see `check_unchanged`.
        """
        check(x, "a volume [b c d h w]", self.domain_shape, self.device)
        check_floating(x, "a volume")
        volume, views = to_accumulation_dtype(x).flatten(0, 1), []
        (name, ops), shape, (blocks, order) = self._ops(x), self.cameras.shape, self._layout()
        for part in self._parts(blocks, volume):
            along = part.detector, self.method
            rays = part.lines, part.nodes, self._window, self.longest
            kept = kept_transmission(name, volume, self.mu, part.lines, self._window, *along)
            layers = ops.project(volume, self.mu, *rays, *along, *kept) * part.weight[..., None]
            if self.rays_per_pixel > 1:
                layers = layers.unflatten(1, (part.count, -1)).sum(dim=2)
            images = [
                blurred_whole(some, kernels)
                if some.is_cuda  # avoids a synchronisation
                else blurred(some, kernels, shape)
                for some, kernels in zip(part.inner(layers), part.kernels, strict=True)
            ]
            views.append(torch.stack(images).sum(dim=0))
        return torch.cat(views, dim=1)[:, order.argsort()].unflatten(0, x.shape[:2])

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """The matched adjoint: back-project views to volumes.

        Raises:
            ValueError: a wrong rank, size, device or dtype.
        """
        check(y, "views [b c m v u]", self.range_shape, self.device)
        check_floating(y, "views")
        (name, ops), (blocks, order) = self._ops(y), self._layout()
        views, volume, first = to_accumulation_dtype(y).flatten(0, 1)[:, order], None, 0
        for part in self._parts(blocks, views):
            block = views[:, first : first + part.count]
            layers = torch.cat([part.spread(block, kernels) for kernels in part.kernels], dim=-1)
            weight = part.weight.unflatten(0, (part.count, -1))[..., None]
            layers = (layers[:, :, None] * weight).flatten(1, 2)
            rays = part.lines, part.nodes, self._window, self.longest, self.method
            along = part.lines, self._window, part.detector, self.method
            kept = kept_transmission(name, views, self.mu, *along)
            one = ops.backproject(layers.contiguous(), self.mu, *rays, *kept)
            volume, first = one if volume is None else volume + one, first + part.count
        assert volume is not None  # a rig has a camera
        return volume.unflatten(0, y.shape[:2])

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """The operator of a subset of cameras; subsets of pixels are computed from full views."""
        if not isinstance(selection, ViewSelection):
            return super().subset(selection)
        return self._of_views(selection.views)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        """The same operator for activity in a box and a subset of the cameras, with the full
        attenuation map.
        """
        part = self if views is None else self._of_views(views)
        return LinearOperator.cropped(part, box)

    def _of_views(self, views: Sequence[int]) -> "BlurredPinholes":
        cameras = self.cameras[torch.tensor(list(views), device=self.cameras.source.device)]
        options = self.method, self.backend, self.rays_per_pixel
        return BlurredPinholes(self.grid, cameras, self.mu, self.optics, *options)

    @property
    def _window(self) -> list[float]:
        return list(self.cameras.ray_extent)

    def _ops(self, tensor: Tensor) -> tuple[str, ModuleType]:
        """The back end for a tensor; compiled back ends have no gradient in the cameras."""
        return attenuated_kernels(tensor, self.backend, self.pose_gradient)

    def _blocks(self) -> Iterator["Block"]:
        """Blocks of cameras with the same number of layers, as large as memory permits."""
        every, rays = magnifications(self.cameras, self.grid), self.rays_per_pixel**2
        for count in sorted({len(layers) for layers in every}):
            views = [view for view, layers in enumerate(every) if len(layers) == count]
            cameras, layers = self.cameras[views], torch.stack([every[view] for view in views])
            kernels = [kernels_of(cameras, part, self.optics) for part in layers.split(LAYERS, 1)]
            margin = [max((k.shape[axis] - 1) // 2 for k in kernels) for axis in (-2, -1)]
            wider = grown(cameras, margin)
            together = max(AT_ONCE // (count * rays * math.prod(wider.shape)), 1)
            for first in range(0, len(views), together):
                some = slice(first, first + together)
                lit = spread(wider[list(range(len(views)))[some]], self.rays_per_pixel)
                fixed = None if self.pose_gradient else self._rays(lit)
                yield Block(views[some], lit, layers[some], [k[some] for k in kernels], fixed)

    def _layout(self) -> tuple[list["Block"], Int[Tensor, " m"]]:
        """The blocks and the order of their views; built in every call if the cameras require a
        gradient, as they may change.
        """
        self.check_unchanged()
        if not self.pose_gradient:
            return self.blocks, self.views
        blocks = [block.to(self.device) for block in self._blocks()]
        return blocks, _order(blocks).to(self.device)

    def _parts(self, blocks: list["Block"], like: Tensor) -> Iterator["Part"]:
        """The blocks with their rays, with the dtype and device of a tensor."""
        for block in blocks:
            nodes = -block.magnification.repeat_interleave(self.rays_per_pixel**2, dim=0)
            lines, weight = block.fixed or self._rays(block.rays)
            yield Part(
                len(block.views),
                list(block.rays.shape),
                lines.to(like.device),
                nodes.to(like.device),
                weight.to(like),
                [kernels.to(like) for kernels in block.kernels],
            )

    def _rays(self, rays: Cameras) -> tuple[Float[Tensor, "r 4 3 c"], Float[Tensor, "r v u"]]:
        """Lines, and the sensitivity of each ray's part of its pixel, counts per line integral in
        mm^2.
        """
        across = ACROSS if self.method == DISTANCE_DRIVEN else 1
        return lines_of(rays, self.grid), self.optics.mean(rays, across) / self.rays_per_pixel**2


class Block(NamedTuple):
    """Some cameras with the same number of layers: their indices; the cameras of all rays, with a
    margin of pixels; l / z of the layers; kernels for `LAYERS` layers at a time; and lines and
    sensitivities of the rays, unless the cameras require a gradient.
    """

    views: list[int]
    rays: Cameras
    magnification: Float[Tensor, "m k"]
    kernels: list[Float[Tensor, "m l i j"]]
    fixed: tuple[Float[Tensor, "r 4 3 c"], Float[Tensor, "r v u"]] | None

    def to(self, device: torch.device) -> "Block":
        """The same block, with layers, kernels and rays on a device."""
        fixed = self.fixed and (self.fixed[0].to(device), self.fixed[1].to(device))
        kernels = [each.to(device) for each in self.kernels]
        layers = self.magnification.to(device)
        return self._replace(magnification=layers, kernels=kernels, fixed=fixed)


def _order(blocks: list[Block]) -> Int[Tensor, " m"]:
    """The indices of the views as the blocks have them."""
    return torch.tensor([view for block in blocks for view in block.views])


class Part(NamedTuple):
    """A block's number of cameras, its pixels including the margin, the lines, layers of 1 / w and
    sensitivities of all rays, and kernels for `LAYERS` layers at a time.
    """

    count: int
    detector: list[int]
    lines: Float[Tensor, "r 4 3 c"]
    nodes: Float[Tensor, "r k"]
    weight: Float[Tensor, "r v u"]
    kernels: list[Float[Tensor, "m l i j"]]

    def inner(self, layers: Float[Tensor, "n m v u k"]) -> Iterator[Float[Tensor, "n m y x l"]]:
        """For `LAYERS` layers at a time, the pixels in the support of their kernels."""
        for some, kernels in zip(layers.split(LAYERS, dim=-1), self.kernels, strict=True):
            down, across = self._beside(kernels)
            rows, columns = self.detector
            yield some[:, :, down : rows - down, across : columns - across]

    def spread(
        self, views: Float[Tensor, "n m y x"], kernels: Float[Tensor, "m l i j"]
    ) -> Float[Tensor, "n m v u l"]:
        """Views in the layers of some kernels, the transpose of the blur, as a direct convolution:
        torch's transposed convolution is much slower.
        """
        rows, columns = (n - 1 for n in kernels.shape[-2:])
        turned = kernels.flip(-2, -1).flatten(0, 1)[:, None]
        every = F.pad(views, (columns, columns, rows, rows))
        every = every.repeat_interleave(kernels.shape[1], dim=1)
        planes = F.conv2d(every, turned, groups=every.shape[1])
        down, across = self._beside(kernels)
        planes = F.pad(planes, (across, across, down, down))
        return planes.unflatten(1, kernels.shape[:2]).movedim(2, -1)

    def _beside(self, kernels: Tensor) -> tuple[int, int]:
        """Rows and columns of the margin outside the support of the kernels, on each side."""
        reach = [max(k.shape[axis] for k in self.kernels) for axis in (-2, -1)]
        down, across = ((most - n) // 2 for most, n in zip(reach, kernels.shape[-2:], strict=True))
        return down, across


def magnifications(cameras: Cameras, grid: Grid) -> list[Float[Tensor, " k"]]:
    """Magnification l / z of the layers of each view, equally spaced, from near to far.

    The depth range is that of the box's corners if `LAYERS` layers suffice; otherwise that of the
    part of the box seen by detectors of twice the width and height.
    """
    whole, length = cameras.depth_range(grid).detach(), cameras.distance.detach()
    wide = grown(cameras, [n // 2 + 1 for n in cameras.shape])
    far, near = (-whole / length[:, None]).unbind(dim=1)
    many = (near <= 0) | (1 / near - 1 / far > (LAYERS - 1) * STEP)
    if many.any():
        seen = (-seen_depth_range(wide, grid).detach() / length[:, None]).unbind(dim=1)
        far, near = torch.where(many, seen[0], far), torch.where(many, seen[1], near)
    least = 1 / far
    most = torch.where(near > 0, 1 / near, torch.inf).minimum(least + (MOST - 1) * STEP)
    counts = ((most - least) / STEP - 1e-6).ceil().long() + 1
    return [
        torch.linspace(first, last, -(-count // LAYERS) * LAYERS, dtype=far.dtype).to(far.device)
        for first, last, count in zip(most.tolist(), least.tolist(), counts.tolist(), strict=True)
    ]


def grown(cameras: Cameras, margin: Sequence[int]) -> Cameras:
    """The same detectors, padded by (rows, columns) pixels on every side."""
    rows, columns = margin
    shape = (cameras.shape[0] + 2 * rows, cameras.shape[1] + 2 * columns)
    first = cameras.source.new_tensor([[-columns, -rows]])
    return replace(cameras.shifted(first), shape=shape)


def kernels_of(
    cameras: Cameras, magnification: Float[Tensor, "m k"], optics: Optics
) -> Float[Tensor, "m k i j"]:
    """Blur kernels in pixels (row, column) with unit sum: the hole's image, convolved with the
    detector's intrinsic Gaussian. A hole's image smaller than a pixel becomes one pixel.
    """
    pitch = torch.stack([cameras.u.detach().norm(dim=-1), cameras.v.detach().norm(dim=-1)], dim=1)
    widths = magnification.new_tensor(optics.hole.blurring_mm) * (1 + magnification)[..., None]
    sides = widths / pitch[:, None]  # in pixels (u, v)
    reach = [int(math.ceil(sides[..., axis].max().item() / 2 - 0.5)) for axis in range(2)]
    # a view at a time: close to a pinhole, images are large and have many subpixels
    image = torch.stack([_hole_images(one, reach, optics.hole.round) for one in sides])
    if not optics.intrinsic_mm:
        return image
    sigma = optics.intrinsic_mm / FWHM / pitch
    across, down = _gaussian(sigma[:, 0]), _gaussian(sigma[:, 1])
    kernels = (down[:, :, None] * across[:, None, :])[:, None]
    rows, columns = kernels.shape[-2:]
    padded = F.pad(image, (columns - 1, columns - 1, rows - 1, rows - 1))
    return F.conv2d(padded.transpose(0, 1), kernels, groups=len(kernels)).transpose(0, 1)


def _hole_images(
    sides: Float[Tensor, "k 2"], reach: Sequence[int], circular: bool
) -> Float[Tensor, "k i j"]:
    """Images of a hole with unit sum and the given width in pixels (u, v)."""
    places = [_places(max(r, 0)).to(sides) for r in reach]
    u, v = places[0][None, :], places[1][:, None]
    half = sides[:, None, None] / 2
    across, down = u / half[..., 0], v / half[..., 1]
    if circular:
        distance = (across**2 + down**2).sqrt()
    else:
        distance = torch.maximum(*torch.broadcast_tensors(across.abs(), down.abs()))
    edge = PARTS * half.amin(dim=-1)  # an edge one subpixel wide, so that widths are not quantised
    inside = ((1 - distance) * edge + 0.5).clamp(0, 1)
    image = F.avg_pool2d(inside, PARTS)
    return image / image.sum(dim=(-2, -1), keepdim=True)


def _places(reach: int) -> Float[Tensor, " n"]:
    """Centres of the subpixels from -reach to reach, in pixels."""
    count = (2 * reach + 1) * PARTS
    return (torch.arange(count, dtype=torch.float64) + 0.5) / PARTS - reach - 0.5


def _gaussian(sigma: Float[Tensor, " m"]) -> Float[Tensor, "m n"]:
    """Integrals over pixels of centred Gaussians, sigma in pixels, truncated at 4 sigma."""
    reach = max(int(math.ceil(4 * sigma.max().item() - 0.5)), 0)
    edges = torch.arange(-reach, reach + 2, dtype=sigma.dtype, device=sigma.device) - 0.5
    total = torch.special.ndtr(edges / sigma[:, None])
    shares = total.diff(dim=1)
    return shares / shares.sum(dim=1, keepdim=True)
