"""Collimator and intrinsic blur of pinholes, matched, by layers of magnification.

A point at the depth z before a pinhole, whose detector is l behind it, has the image of the hole on
the detector, of the width d_re (1 + l / z), blurred by the detector's own resolution R_i: at the
object R^2 = (d_re (z + l) / l)^2 + (R_i z / l)^2 (Anger; Metzler & Accorsi, Phys. Med. Biol. 50
(2005) 5005). The width is linear in l / z, so integrals are shared out linearly to a few layers at
equal steps of l / z, and each layer is blurred as a whole: with 8 layers over a heart's depths the
variance of a profile is right to 0.1 %.

What lies behind a pinhole's plane is not seen. Layers reach from the nearest to the farthest point
of the grid that a camera sees; where a grid comes very near to a pinhole there are more of them,
and what is nearer than the first has its blur.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import seen_depth_range
from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.operators.operator import LinearOperator, Projector, check, check_floating
from mvrecon.operators.selection import ViewSelection
from mvrecon_spect.attenuated import attenuated_kernels, check_mu
from mvrecon_spect.extent import Extent, blurred, blurred_whole, extents_of
from mvrecon_spect.hole import Hole
from mvrecon_spect.matter import Beyond
from mvrecon_spect.rays import spread

#: Layers of magnification of a view; cameras whose layers are in memory at a time.
LAYERS, TOGETHER = 8, 8
#: Where 8 layers would be further apart than `STEP` in l / z, there are more, up to `MOST`: then a
#: profile's variance between two of them is right to 1 %.
STEP, MOST = 0.2, 24
#: Parts each way of a pixel on which a hole's image is drawn; FWHM in standard deviations.
PARTS, FWHM = 16, 2 * math.sqrt(2 * math.log(2))


class Optics(NamedTuple):
    """The hole, the detector's own resolution as a FWHM in mm, 0: none, and attenuation beyond the
    grid.
    """

    hole: Hole
    intrinsic_mm: float = 0.0
    beyond: Beyond | None = None

    def weight(self, cameras: Cameras) -> Float[Tensor, "m v u"]:
        """Counts of each pixel per line integral in the grid, in mm^2."""
        weight = self.hole.weight(cameras)
        return weight if self.beyond is None else weight * self.beyond.transmission(cameras)


class BlurredPinholes(Projector):
    """Counts [b c m v u] behind blurring pinholes of volumes [b c d h w] in counts / mm^3, Blur(w *
    attenuated integral), and the matched adjoint.

    What lies beside the detector's field blurs into it. Layers and pixels that nothing is seen in
    are not blurred, which changes no more than a convolution's rounding; a GPU, for which the host
    would wait, blurs all. Differentiable in the volume and mu; in the cameras by the reference.

    Args:
        grid: where the activity lies. What of it is behind a pinhole's plane is not seen.
        cameras: pinholes, their detectors at a right angle to their axes.
        mu: linear attenuation on the grid in 1/mm; None: none.
        optics: hole and intrinsic resolution.
        method, backend: as in `RayTransform`; "joseph" or "siddon".
        rays_per_pixel: n x n rays whose weighted sum is a pixel's, before it is blurred.
        magnification: l / z of the layers of each view at equal steps, from near to far; None: by
            the grid.

    Raises:
        ValueError: an attenuation as `AttenuatedTransform`, or another method.
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
        magnification: Float[Tensor, "m k"] | None = None,
    ):
        super().__init__()
        if method not in ("joseph", "siddon"):
            raise ValueError(f"Blur needs method 'joseph' or 'siddon', got {method!r}")
        self.grid, self.cameras, self.optics = grid, cameras, optics
        self.method, self.backend, self.rays_per_pixel = method, backend, rays_per_pixel
        mu = torch.zeros(grid.shape) if mu is None else mu
        check_mu(mu, grid)
        self.register_buffer("mu", mu, persistent=False)
        self.domain_shape, self.range_shape = grid.shape, (len(cameras), *cameras.shape)
        known = magnification is not None
        self.magnification = magnification if known else magnifications(cameras, grid)
        self.kernels = kernels_of(cameras, self.magnification, optics)
        margin = [(n - 1) // 2 for n in self.kernels.shape[-2:]]
        self.wider = grown(cameras, margin)
        self.rays = spread(self.wider, rays_per_pixel)
        self.weight = None if self.pose_gradient else self._weight()

    @property
    def device(self) -> torch.device:
        return self.mu.device

    @property
    def pose_gradient(self) -> bool:
        """Whether the cameras require a gradient."""
        rig = self.cameras
        return any(tensor.requires_grad for tensor in (rig.source, rig.origin, rig.u, rig.v))

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """mu, where it is not zero everywhere."""
        return self.mu if bool((self.mu != 0).any()) else None

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Views of volumes.

        Raises:
            ValueError: a wrong rank, size, device or dtype.
        """
        check(x, "a volume [b c d h w]", self.domain_shape, self.device)
        check_floating(x, "a volume")
        volume, views = to_accumulation_dtype(x).flatten(0, 1), []
        ops, (window, detector) = self._ops(x), self._extent
        for part in self._parts(volume):
            rays = part.lines, part.layers, window, detector, self.method
            layers = ops.project(volume, self.mu, *rays) * part.weight[..., None]
            if self.rays_per_pixel > 1:
                layers = layers.unflatten(1, (len(part.kernels), -1)).sum(dim=2)
            if layers.is_cuda:  # which is not asked where something is seen
                views.append(blurred_whole(layers, part.kernels))
                continue
            extents = (Extent(*extent) for extent in extents_of(layers.detach()).tolist())
            pairs = zip(layers.unbind(dim=1), part.kernels, extents, strict=True)
            views.append(torch.stack([blurred(*p, self.cameras.shape) for p in pairs], dim=1))
        return torch.cat(views, dim=1).unflatten(0, x.shape[:2])

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """The matched adjoint: volumes of views.

        Raises:
            ValueError: a wrong rank, size, device or dtype.
        """
        check(y, "views [b c m v u]", self.range_shape, self.device)
        check_floating(y, "views")
        views, volume, first = to_accumulation_dtype(y).flatten(0, 1), None, 0
        ops, (window, _) = self._ops(y), self._extent
        for part in self._parts(views):
            count = len(part.kernels)
            block = views[:, first : first + count]
            rows, columns = (n - 1 for n in part.kernels.shape[-2:])
            turned = part.kernels.flip(-2, -1).flatten(0, 1)[:, None]
            # the transpose, as a plain convolution: torch's own is much slower
            every = F.pad(block, (columns, columns, rows, rows)).repeat_interleave(
                turned.shape[0] // count, dim=1
            )
            planes = F.conv2d(every, turned, groups=every.shape[1])
            layers = planes.unflatten(1, (count, -1)).movedim(2, -1)
            layers = layers.repeat_interleave(len(part.lines) // count, dim=1)
            layers = layers * part.weight[..., None]
            rays = part.lines, part.layers, window, self.method
            one = ops.backproject(layers.contiguous(), self.mu, *rays)
            volume, first = one if volume is None else volume + one, first + count
        assert volume is not None  # a rig has a camera
        return volume.unflatten(0, y.shape[:2])

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """The views of some cameras alone; pixels by all of their views."""
        if not isinstance(selection, ViewSelection):
            return super().subset(selection)
        return self._of_views(selection.views)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        """The same for activity in a box and for some cameras; all of the attenuation stays."""
        part = self if views is None else self._of_views(views)
        return LinearOperator.cropped(part, box)

    def _of_views(self, views: Sequence[int]) -> "BlurredPinholes":
        cameras = self.cameras[torch.tensor(list(views), device=self.cameras.source.device)]
        layers = self.magnification[list(views)]
        options = self.method, self.backend, self.rays_per_pixel, layers
        return BlurredPinholes(self.grid, cameras, self.mu, self.optics, *options)

    @property
    def _extent(self) -> tuple[list[float], list[int]]:
        return list(self.wider.ray_extent), list(self.wider.shape)

    def _ops(self, tensor: Tensor):
        """The kernels that serve a tensor; compiled ones know no gradient in the cameras."""
        return attenuated_kernels(tensor, self.backend, self.pose_gradient)[1]

    def _parts(self, like: Tensor) -> Iterator["Part"]:
        """A few cameras at a time."""
        every = self.rays_per_pixel**2
        lines = lines_of(self.rays, self.grid).to(like.device)
        weight = self._weight() if self.weight is None else self.weight
        weight = weight.to(like)
        layers = -self.magnification.to(like.device).repeat_interleave(every, dim=0)
        kernels = self.kernels.to(like)
        together = max(TOGETHER // every, 1)
        for first in range(0, len(kernels), together):
            some = slice(first * every, (first + together) * every)
            yield Part(lines[some], layers[some], weight[some], kernels[first : first + together])

    def _weight(self) -> Float[Tensor, "r v u"]:
        """Counts of each ray's share of its pixel per line integral in the grid, in mm^2."""
        return self.optics.weight(self.rays) / self.rays_per_pixel**2


class Part(NamedTuple):
    """A few cameras: kernels of blur of each, and of all its rays in a pixel in turn the lines,
    layers of 1 / w and sensitivities.
    """

    lines: Float[Tensor, "r 4 3 c"]
    layers: Float[Tensor, "r k"]
    weight: Float[Tensor, "r v u"]
    kernels: Float[Tensor, "m k i j"]


def magnifications(cameras: Cameras, grid: Grid) -> Float[Tensor, "m k"]:
    """Magnification l / z of the layers of each view, at equal steps, from near to far.

    The depths are those of the box's corners, as long as `LAYERS` are enough for them; else those
    of the part of the box that detectors twice as wide and high see.
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
    count = max(LAYERS, math.ceil((most - least).max().item() / STEP - 1e-6) + 1)
    steps = torch.linspace(0, 1, count, dtype=far.dtype, device=far.device)
    return most[:, None] + (least - most)[:, None] * steps


def grown(cameras: Cameras, margin: Sequence[int]) -> Cameras:
    """The same detectors with (rows, columns) more pixels on every side."""
    rows, columns = margin
    shape = (cameras.shape[0] + 2 * rows, cameras.shape[1] + 2 * columns)
    first = cameras.source.new_tensor([[-columns, -rows]])
    return replace(cameras.shifted(first), shape=shape)


def kernels_of(
    cameras: Cameras, magnification: Float[Tensor, "m k"], optics: Optics
) -> Float[Tensor, "m k i j"]:
    """Kernels of blur in pixels (row, column), each of the sum 1: the hole's image, convolved with
    the detector's own Gaussian. A hole's image that is smaller than a pixel is one pixel.
    """
    pitch = torch.stack([cameras.u.detach().norm(dim=-1), cameras.v.detach().norm(dim=-1)], dim=1)
    widths = magnification.new_tensor(optics.hole.blurring_mm) * (1 + magnification)[..., None]
    sides = widths / pitch[:, None]  # in pixels (u, v)
    reach = [int(math.ceil(sides[..., axis].max().item() / 2 - 0.5)) for axis in range(2)]
    # a view at a time: near a pinhole images are large, and they are drawn in many parts
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
    """Images of a hole, of the sum 1, that are so many pixels (u, v) wide."""
    places = [_places(max(r, 0)).to(sides) for r in reach]
    u, v = places[0][None, :], places[1][:, None]
    half = sides[:, None, None] / 2
    across, down = u / half[..., 0], v / half[..., 1]
    if circular:
        distance = (across**2 + down**2).sqrt()
    else:
        distance = torch.maximum(*torch.broadcast_tensors(across.abs(), down.abs()))
    edge = PARTS * half.amin(dim=-1)  # an edge a part of a pixel wide, so that widths count in full
    inside = ((1 - distance) * edge + 0.5).clamp(0, 1)
    image = F.avg_pool2d(inside, PARTS)
    return image / image.sum(dim=(-2, -1), keepdim=True)


def _places(reach: int) -> Float[Tensor, " n"]:
    """The middles of the parts of pixels from -reach to reach, in pixels."""
    count = (2 * reach + 1) * PARTS
    return (torch.arange(count, dtype=torch.float64) + 0.5) / PARTS - reach - 0.5


def _gaussian(sigma: Float[Tensor, " m"]) -> Float[Tensor, "m n"]:
    """The shares of pixels in Gaussians about the middle one, sigma in pixels, cut at 4 sigma."""
    reach = max(int(math.ceil(4 * sigma.max().item() - 0.5)), 0)
    edges = torch.arange(-reach, reach + 2, dtype=sigma.dtype, device=sigma.device) - 0.5
    total = torch.special.ndtr(edges / sigma[:, None])
    shares = total.diff(dim=1)
    return shares / shares.sum(dim=1, keepdim=True)
