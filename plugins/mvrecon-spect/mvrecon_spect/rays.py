"""Several rays per pixel, for rays that would be further apart than half a voxel.

For rays with the spacing g in voxels of the size h, the sensitivity A^T 1 has ripples of the
relative amplitude sinc(h p)^2 sinc(h q)^2 at each vector (p, q) of the reciprocal lattice of the
rays. For a square array of n x n rays per pixel these are at n / g along the voxels' axes, where
one factor is 1. For a rotated lattice of the same number of rays, few of which share a row or a
column, both factors are small.
"""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.rays.lines import DIRECTION, lines_of
from mvrecon.operators.memo import FixedGeometry
from mvrecon.operators.operator import (
    Composed,
    Derived,
    LinearOperator,
    PixelIntegral,
    Projector,
    check,
)
from mvrecon.operators.selection import RaySelection
from mvrecon_spect.multiplexed import Multiplexed, SummedHoles

#: Generators for n = 1, 2, ...: the ray in column k is in row generator * k modulo n^2.
GENERATORS = (0, 1, 4, 6, 7, 10, 9, 28)
#: In voxels: maximum spacing of rays, and the fraction of a ray per axis below which no ray is
#: added.
APART, SPARE = 0.5, 0.15
#: Squared tangent of the angle between rows of pixels and voxels up to which footprints adjoin.
OBLIQUE = 0.01

RaysPerPixel = int | Literal["auto"]


def rays_each_way(rays: RaysPerPixel, cameras: Cameras, grid: Grid) -> int:
    """Number n of n x n rays per pixel. "auto": ray spacing of half a voxel at the grid's centre,
    as median over the cameras.

    Raises:
        ValueError: neither "auto" nor an integer from 1 to 8.
    """
    most = len(GENERATORS)
    if rays == "auto":
        pitch = torch.maximum(cameras.u.norm(dim=-1), cameras.v.norm(dim=-1)).detach()
        depth = cameras.project(grid.centre.to(cameras.source))[:, 2].detach()
        gap = (pitch * (depth / cameras.distance.detach()).abs()).median().item()
        voxel = min(grid.spacing)
        return min(max(math.ceil(gap / (APART * voxel) - SPARE), 1), most)
    if isinstance(rays, bool) or not isinstance(rays, int) or not 1 <= rays <= most:
        raise ValueError(
            f"Expected rays_per_pixel, rays each way in a pixel, as auto or a whole number from 1 "
            f"to {most}, got {rays!r}"
        )
    return rays


def along_voxels(cameras: Cameras, grid: Grid) -> bool:
    """Whether the images of all pixels on the voxels are rectangles along the grid's axes, or
    sheared ones; otherwise distance-driven footprints of adjacent pixels do not adjoin.
    """
    u, v, beam = lines_of(cameras, grid)[:, DIRECTION].detach().unbind(dim=-1)
    main = beam.abs().argmax(dim=1, keepdim=True)
    across = torch.cat([(main + 1) % 3, (main + 2) % 3], dim=1)
    (b_u, c_u), (b_v, c_v) = (
        (step - beam * (step / beam).gather(1, main)).gather(1, across).unbind(dim=1)
        for step in (u, v)
    )
    one, two = (b_u * c_v).abs(), (b_v * c_u).abs()
    return bool((torch.minimum(one, two) <= OBLIQUE * torch.maximum(one, two)).all())


def offsets(n: int) -> Float[Tensor, "r 2"]:
    """Offsets (u, v) of n x n rays from the pixel centre in pixels; their mean is zero."""
    count = n * n
    place = torch.arange(count)
    points = torch.stack([place, place * GENERATORS[n - 1] % count], dim=1)
    places = points.double() / count
    return places - places.mean(dim=0)


def spread(cameras: Cameras, n: int) -> Cameras:
    """Repeat each camera n x n times, with pixel centres at the positions of the rays."""
    if n == 1:
        return cameras
    shifts = offsets(n).to(cameras.source)
    every = torch.arange(len(cameras), device=shifts.device).repeat_interleave(len(shifts))
    return cameras[every].shifted(shifts.repeat(len(cameras), 1))


class SeveralRays(Derived, FixedGeometry):
    """The sum of the n x n rays of each pixel, volumes [b c d h w] to views [b c m v u].

    Args:
        A: projector of `spread(cameras, n)`, with each ray's fraction of its pixel's counts.
        cameras: the rig.
        n: rays per pixel axis.
        finer: returns the projector on a grid refined by a factor, from that factor and A's mu.
    """

    follows_gradient = False  # A has cameras of its own

    def __init__(
        self,
        A: LinearOperator,
        cameras: Cameras,
        n: int,
        finer: Callable[[int, Tensor | None], Projector] | None = None,
    ):
        super().__init__()
        self.built_from(A.grid, cameras)
        self.A, self.n, self.finer = A, n, finer
        self.domain_shape = A.domain_shape
        self.sum = SummedHoles(A.range_shape, n * n)
        self.range_shape = self.sum.range_shape
        unrefined = A.capabilities - {"refine"}
        self.capabilities = unrefined if finer is None else unrefined | {"refine"}

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Project volumes to views; raises as `A` does.

        Raises:
            RuntimeError: the cameras or the grid were changed in place.
        """
        self.check_unchanged()
        return self.sum(self.A(x))

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """The exact transpose of `forward`; raises the same errors."""
        self.check_unchanged()
        check(y, "views [b c m v u]", self.range_shape, self.device)
        return self.A.adjoint(self.sum.adjoint(y))

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """Indices of all rays of some views or pixels."""
        self.check_unchanged()
        if isinstance(selection, RaySelection):
            rays = _SummedRays(selection.chosen, self.n**2)
            every = RaySelection(self.A.range_shape, rays.every)
            return Composed(rays, self.A.subset(every))
        return Multiplexed(self.A, self.n**2).subset(selection)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        self.check_unchanged()
        keep = list(range(len(self.cameras)) if views is None else views)
        rays = [view * self.n**2 + ray for view in keep for ray in range(self.n**2)]
        return SeveralRays(self.A.cropped(box, rays), self.cameras[keep], self.n)

    def with_support(self, support: Bool[Tensor, "d h w"] | None) -> LinearOperator:
        return SeveralRays(self.A.with_support(support), self.cameras, self.n)

    def refined(self, factor: int) -> Projector:
        if self.finer is None:
            return super().refined(factor)
        return self.finer(factor, self.mu_map())

    def pixel_integral(self) -> PixelIntegral | None:
        """Mean over evenly distributed rays of a pixel, times the sum of their weights."""
        own = self.A.pixel_integral()
        return own and PixelIntegral(self.sum(own.weight[None, None])[0, 0], self.n)

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        return self.A.mu_map()


class _SummedRays(LinearOperator):
    """The sums of the rays of chosen pixels, [b c rays] to [b c pixels].

    Args:
        chosen: indices of the pixels.
        count: number of rays per pixel.
    """

    def __init__(self, chosen: Bool[Tensor, "m v u"], count: int):
        number = chosen.flatten().cumsum(dim=0).reshape(chosen.shape) - 1
        self.every = chosen.repeat_interleave(count, dim=0)
        self.pixel = number.repeat_interleave(count, dim=0)[self.every]
        self.domain_shape, self.range_shape = (len(self.pixel),), (int(chosen.sum()),)

    def forward(self, x: Float[Tensor, "b c r"]) -> Float[Tensor, "b c p"]:
        zeros = x.new_zeros(*x.shape[:2], *self.range_shape)
        return zeros.index_add(2, self.pixel.to(x.device), x)

    def adjoint(self, y: Float[Tensor, "b c p"]) -> Float[Tensor, "b c r"]:
        return y.index_select(2, self.pixel.to(y.device))
