"""Rays and boxes by themselves: chords, and by how much a rounding error of a place may change a
ray's integral.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from tests.operators.cases import Case

#: Of a voxel: nearer to a face than this a ray is taken to touch it.
NEAR = 1e-6


class Course(NamedTuple):
    """Where the rays of a case run through a box: fractions of the way, places there, mm of a whole
    way.
    """

    enter: Float[Tensor, "m v u"]
    leave: Float[Tensor, "m v u"]
    first: Float[Tensor, "m v u 3"]
    last: Float[Tensor, "m v u 3"]
    way: Float[Tensor, "m v u"]

    @property
    def length(self) -> Float[Tensor, "m v u"]:
        """In mm."""
        return (self.leave - self.enter) * self.way


def _indexed(case: Case) -> tuple[Float[Tensor, "m v u 3"], Float[Tensor, "m v u 3"]]:
    """Where the rays start and how far they go, in voxels (x, y, z) from the first one's centre."""
    start, end = case.rays.rays()
    back = torch.linalg.inv(case.grid.affine[:3, :3]).T
    return (start - case.grid.affine[:3, 3]) @ back, (end - start) @ back


def course(case: Case, grown: float = 0.0, inner: bool = False) -> Course:
    """Slab by slab (Kay & Kajiya, Ray tracing complex scenes, 1986), in voxel indices.

    Args:
        case: grid and rays.
        grown: voxels by which the box is larger on every side.
        inner: the box of the voxels' centres in place of the voxels' own.
    """
    (one, way), (start, end) = _indexed(case), case.rays.rays()
    margin = grown + (0.0 if inner else 0.5)
    high = torch.tensor(case.grid.shape[::-1], dtype=torch.float64) - 1 + margin
    moves = way != 0
    safe = torch.where(moves, way, 1.0)
    near, far = (-margin - one) / safe, (high - one) / safe
    within = (one >= -margin) & (one <= high)
    none, least, most = torch.tensor(torch.inf).double(), *case.rays.ray_extent
    enter = (
        torch.where(moves, torch.minimum(near, far), torch.where(within, -none, none))
        .amax(dim=-1)
        .clamp_min(least)
    )
    leave = (
        torch.where(moves, torch.maximum(near, far), torch.where(within, none, -none))
        .amin(dim=-1)
        .clamp_max(most)
    )
    hits = leave > enter
    enter, leave = (torch.where(hits, t, 0.0) for t in (enter, leave))
    first, last = (one + t[..., None] * way for t in (enter, leave))
    return Course(enter, leave, first, last, (end - start).norm(dim=-1))


def faded(case: Case) -> Float[Tensor, "m v u"]:
    """What Joseph's method sees of ones, in mm, and so of any volume at most per unit of its
    greatest value.

    A ray's length in each slab of its main axis, times the ones in the slab's middle. Across that
    axis they fade from one at the outermost centres to zero a voxel further out, half a voxel
    beyond the box. No chord bounds it but that of a box grown by a voxel across: before and behind
    the middle the ray may be half a voxel further out still, as its slope is at most one. All of it
    is said in voxels, so a sheared grid is like any other.
    """
    (one, way), (least, most) = _indexed(case), case.rays.ray_extent
    sizes = torch.tensor(case.grid.shape[::-1], dtype=torch.float64)
    main = way.abs().argmax(dim=-1, keepdim=True)
    begin, pace, count = one.gather(-1, main), way.gather(-1, main), sizes[main]
    total = torch.zeros_like(way[..., 0])
    for k in range(max(case.grid.shape)):
        ends = torch.stack([(k + half - begin) / pace for half in (-0.5, 0.5)]).clamp(least, most)
        share = (ends[1] - ends[0]).abs() * (k < count)
        place = one + (k - begin) / pace * way
        ones = torch.minimum(place + 1, sizes - place).clamp(0, 1).scatter(-1, main, 1.0)
        total += share[..., 0] * ones.prod(dim=-1)
    start, end = case.rays.rays()
    return total * (end - start).norm(dim=-1)


def sharpness(
    case: Case, dtype: torch.dtype = torch.float64
) -> tuple[Float[Tensor, "m v u"], Bool[Tensor, "m v u"]]:
    """By which part of (greatest value x length) rounding may change a ray's integral, and which
    rays are steady.

    A place in the volume, in voxels, is known to delta. Where a ray crosses a face at slope s it
    may cross delta / s sooner or later; one that runs along a face belongs to either side of it,
    and one whose main axis is as good as another may take either in Joseph's method. These are not
    steady: their integral jumps.
    """
    through = course(case, grown=1.0)
    step = min(case.grid.spacing)
    ends = torch.stack([points.abs().amax(dim=-1) for points in case.rays.rays()])
    size = (ends.amax(dim=0) + case.grid.corners().abs().max()) / step
    reach = 1 + torch.maximum(through.enter.abs(), through.leave.abs())
    # a sheared voxel's own size is less than its sides': the inverse of its affine grows what it is
    # given
    axes = case.grid.affine[:3, :3] / case.grid.affine[:3, :3].norm(dim=0)
    skew = torch.linalg.cond(axes).item()
    delta = (
        8 * skew * torch.finfo(torch.float64).eps * size * reach
        + 4 * max(case.grid.shape) * torch.finfo(dtype).eps
    )
    way = (through.last - through.first).abs()
    slope = way / way.amax(dim=-1, keepdim=True).clamp_min(1e-300)
    low, high = (
        torch.minimum(through.first, through.last),
        torch.maximum(through.first, through.last),
    )
    margin = NEAR + delta[..., None]
    crosses = (high + 0.5 + margin).floor() != (low + 0.5 - margin).floor()
    gain = torch.where(crosses, 1 / slope, 0.0).amax(dim=-1)
    two = slope.topk(2).values
    steady = (delta * gain < 1e-3) & (
        (two[..., 0] - two[..., 1] > 1e-9 + delta) | (through.length == 0)
    )
    return delta * (8 + 4 * gain), steady


def allowed(
    case: Case, x: Tensor, dtype: torch.dtype = torch.float64, per_pixel: int = 1
) -> tuple[Float[Tensor, "m v u"], Bool[Tensor, "m v u"]]:
    """What two ways to integrate may differ by at the pixels, and at which of them, see
    `sharpness`.
    """
    fine = replace(case, rays=case.rays.refined(per_pixel)) if per_pixel > 1 else case
    part, steady = sharpness(fine, dtype)
    apart = part * x.abs().max().double() * course(fine, grown=1.0).length
    unsteady = (~steady).double()
    most, worst = (max_pool2d(each[:, None], per_pixel)[:, 0] for each in (apart, unsteady))
    return most, worst == 0
