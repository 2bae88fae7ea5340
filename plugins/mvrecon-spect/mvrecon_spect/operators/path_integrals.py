"""Integrals of the attenuation from every voxel to every pinhole.

In the frustum of a pinhole, along rays `APART` voxels apart at the centre of the map, mu is
added up from the pinhole outwards, at the middle of steps of `DEEP` voxels; voxels interpolate
linearly in these sums. mu is constant in voxels but for linear interpolation over half a voxel at
their faces. Order of accuracy in the voxel size: two for smooth attenuation, one at its edges.
Differentiable in mu and the cameras.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, subdivided
from mvrecon.kernels.operator import COMPILED, to_accumulation_dtype
from mvrecon.kernels.threads import parallel_for

#: Pixels beside the detector whose rays are part of a frustum, as a fraction of its width; voxels
#: further aside, whose footprints reach the detector only close to a pinhole, have the integral of
#: the outermost ray.
MARGIN = 0.25
#: Distance of rays and step of depth in voxels; least and most rays each way.
APART, DEEP, FEWEST, MOST = 0.67, 0.33, 8, 400
#: Parts of a voxel of mu along each axis, between which it is interpolated.
PARTS = 2


def path_integrals(
    mu: Float[Tensor, "e i j"], matter: Grid, cameras: Cameras, grid: Grid
) -> Float[Tensor, "m d h w"]:
    """Integral of mu along the line from each voxel's centre to each pinhole, float32 or float64.

    Args:
        mu: linear attenuation in 1/mm on the grid `matter`, zero outside it.
        cameras: pinholes.
        grid: the voxels.
    """
    mu = to_accumulation_dtype(mu)
    fine = matter.refined(PARTS)
    frusta = [_frustum(fine, camera) for camera in cameras]
    moving = mu.requires_grad or any(frustum.along.requires_grad for frustum in frusta)
    small = math.prod(n + 2 for n in mu.shape) < 2**31  # as the loops count
    if mu.is_cpu and COMPILED and small and not (moving and torch.is_grad_enabled()):
        return _compiled(mu, frusta, grid)
    parts = subdivided(mu, PARTS)
    return torch.stack([_summed(parts, fine, frustum, grid) for frustum in frusta])


class _Frustum(NamedTuple):
    """Rays of a pinhole from its detector's pixels through the matter.

    Args:
        start, inverse: the pinhole in mm, and the inverse of its frame.
        index: the pinhole's index (x, y, z) in the matter.
        world, along: mm, and steps of the index, per mm of depth: columns for a pixel along u,
            along v, and for pixel (0, 0).
        length: distance from hole to detector, in mm.
        rays: numbers along u and v.
        ends: first ray and distance of rays along u and v in pixels, and the first depth.
        step, slabs: step of depth in mm, and number of steps.
    """

    start: Tensor
    inverse: Tensor
    index: Tensor
    world: Tensor
    along: Tensor
    length: Tensor
    rays: tuple[int, int]
    ends: Tensor
    step: Tensor
    slabs: int

    def of_voxels(self, grid: Grid) -> Float[Tensor, "3 4"]:
        """The map from a voxel's index (i, j, k, 1) to w (u, v, 1)."""
        affine = grid.affine.to(self.start)
        shift = affine[:3, 3] - self.start
        return self.inverse @ torch.cat([affine[:3, :3], shift[:, None]], dim=1)


def _frustum(matter: Grid, camera: Cameras) -> _Frustum:
    source, length = camera.source[0], camera.distance[0]
    far, near = (-camera.depth_range(matter)[0]).unbind()
    near, voxel = near.clamp_min(0), PARTS * min(matter.spacing)
    slabs = max(math.ceil((far - near).item() / (DEEP * voxel) - 1e-6), 1)
    corners = camera.project(matter.corners().to(source))[0]
    numbers, ends = [], []
    for axis, (pixels, pitch) in enumerate(
        zip(camera.shape[::-1], (camera.u, camera.v), strict=True)
    ):
        low, high = corners.new_tensor([-0.5 - MARGIN * pixels, pixels - 0.5 + MARGIN * pixels])
        if (corners[:, 2] < 0).all():  # rays beside the matter serve no voxel
            first, last = corners[:, axis].aminmax()
            low, high = first.clamp(low, high - 1), last.clamp(low + 1, high)
        apart = APART * voxel * length / ((near + far) / 2 * pitch[0].norm())
        numbers.append(min(max(math.ceil(((high - low) / apart).item() - 1e-6) + 1, FEWEST), MOST))
        ends += [low, (high - low) / (numbers[-1] - 1)]
    beam = camera.origin[0] - source
    world = -torch.stack([camera.u[0], camera.v[0], beam], dim=1) / length
    to_index = torch.linalg.inv(matter.affine.to(source))
    return _Frustum(
        source,
        torch.linalg.inv(camera.frame[0]),
        to_index[:3, :3] @ source + to_index[:3, 3],
        world,
        to_index[:3, :3] @ world,
        length,
        (numbers[0], numbers[1]),
        torch.stack([*ends, near]),
        (far - near) / slabs,
        slabs,
    )


def _compiled(
    mu: Float[Tensor, "e i j"], frusta: Sequence[_Frustum], grid: Grid
) -> Float[Tensor, "m d h w"]:
    """By compiled loops, one pinhole at a time on each thread."""
    from mvrecon_spect.kernels.paths import add_up, look_up

    padded = F.pad(mu.detach(), (1, 1) * 3).numpy()
    result = torch.empty(len(frusta), *grid.shape, dtype=mu.dtype)

    def work(first: int, last: int) -> None:
        for number in range(first, last):
            frustum = frusta[number]
            one = [part.detach().cpu().numpy() for part in frustum[:6] + frustum[7:8]]
            _, _, index, world, along, length, ends = one
            step, places = frustum.step.item(), frustum.of_voxels(grid).detach().numpy()
            columns, rows = frustum.rays
            sums = np.empty((frustum.slabs + 1, rows, columns), padded.dtype)
            add_up(padded, index, along, world, ends, step, sums)
            look_up(sums, places, length.item(), ends, step, result[number].numpy())

    parallel_for(work, len(frusta), result.numel())
    return result


def _summed(
    mu: Float[Tensor, "e i j"], matter: Grid, frustum: _Frustum, grid: Grid
) -> Float[Tensor, "d h w"]:
    """With derivatives of all orders."""
    ends, step, (columns, rows) = frustum.ends, frustum.step, frustum.rays
    count = {"dtype": ends.dtype, "device": ends.device}
    u = ends[0] + torch.arange(columns, **count) * ends[1]
    v = ends[2] + torch.arange(rows, **count) * ends[3]
    middle = ends[4] + (torch.arange(frustum.slabs, **count) + 0.5) * step
    pixels = torch.stack([*torch.meshgrid(u, v, indexing="xy")], dim=-1)
    pixels = F.pad(pixels, (0, 1), value=1.0)
    # by 2 / (n - 1) to -1 .. 1, as `grid_sample` counts
    half = (ends.new_tensor(matter.size) - 1) / 2
    places = (frustum.index / half - 1) + middle[:, None, None, None] * (
        pixels @ frustum.along.T / half
    )
    lengths = (pixels @ frustum.world.T).norm(dim=-1) * step
    sums = _sample(mu, places, "zeros") * lengths.to(mu)
    sums = F.pad(sums.cumsum(dim=0), (0, 0, 0, 0, 1, 0))
    axes = [torch.arange(n, **count) for n in grid.shape]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    q = torch.stack([x, y, z, torch.ones_like(x)], dim=-1) @ frustum.of_voxels(grid).T
    w = torch.where(q[..., 2] < 0, q[..., 2], -1.0)  # others are not seen
    far = ends[4] + frustum.slabs * step
    place = torch.stack(
        [
            _unit(q[..., 0] / w, ends[0], ends[0] + (columns - 1) * ends[1]),
            _unit(q[..., 1] / w, ends[2], ends[2] + (rows - 1) * ends[3]),
            _unit(-w * frustum.length, ends[4], far),
        ],
        dim=-1,
    )
    return _sample(sums, place, "border")


def _unit(value: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Map low .. high to -1 .. 1."""
    return (value - low) * (2 / (high - low)) - 1


def _sample(
    volume: Float[Tensor, "e i j"], places: Float[Tensor, "d h w 3"], padding: str
) -> Float[Tensor, "d h w"]:
    """Linear interpolation of a volume at places from -1 to 1."""
    return F.grid_sample(
        volume[None, None], places[None].to(volume), padding_mode=padding, align_corners=True
    )[0, 0]
