"""The reference: the same operators in plain torch, on any device and in any float type, with
derivatives of any order by torch.

It shares no arithmetic with the compiled kernels. All rays advance together, slab by slab.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.geometry.grid import pixel_centres
from mvrecon.kernels.rays.lines import DIRECTION, MOMENT, START, TIE, WORLD


@dataclass(frozen=True)
class Rays:
    """All rays of all views, flat: main axis first, then the two that follow it cyclically."""

    value: Float[Tensor, "2 r"]
    slope: Float[Tensor, "2 r"]
    length: Float[Tensor, " r"]
    begin: Float[Tensor, " r"]
    end: Float[Tensor, " r"]
    sizes: Int[Tensor, "3 r"]
    strides: Int[Tensor, "3 r"]


def rays_of(
    maps: Tensor,
    main: Int[Tensor, " r"],
    window: Sequence[float],
    shape: Sequence[int],
    like: Tensor,
    reach: float = 0.0,
) -> Rays:
    """The course of rays, see `maps_at_pixels`, to `reach` voxels beyond the box; in float64, then
    cast.
    """
    direction, moment = maps[DIRECTION], maps[MOMENT]
    order = torch.stack([main, (main + 1) % 3, (main + 2) % 3])
    D = direction.gather(0, order)
    M = moment.gather(0, order)
    start = maps[START].gather(0, order[:1])[0]
    sizes = torch.tensor(shape[::-1], device=maps.device)
    half = sizes[main] / 2 + reach
    # infinity carries no derivative
    ends = [start + w * D[0] if abs(w) < torch.inf else w * D[0].detach().sign() for w in window]
    steps = torch.tensor([1, shape[2] + 2, (shape[2] + 2) * (shape[1] + 2)], device=maps.device)
    value = torch.stack([-M[2], M[1]]) / D[0]
    return Rays(
        value=value.to(like.dtype),
        slope=(D[1:] / D[0]).to(like.dtype),
        length=(maps[WORLD].norm(dim=0) / D[0].abs()).to(like.dtype),
        begin=torch.maximum(torch.minimum(*ends), -half).to(like.dtype),
        end=torch.minimum(torch.maximum(*ends), half).to(like.dtype),
        sizes=sizes[order],
        strides=steps[order],
    )


def maps_at_pixels(lines: Tensor, detector: Sequence[int]) -> tuple[Tensor, Int[Tensor, " r"]]:
    """The linear maps [4 3 r] of `lines.py` at every pixel of every view, and the main axes."""
    centre = lines.new_tensor([(detector[1] - 1) / 2, (detector[0] - 1) / 2])
    uv = pixel_centres(detector).to(lines) - centre
    p = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1).reshape(-1, 3)[:, -lines.shape[-1] :]
    maps = torch.einsum("mkxc,rc->kxmr", lines, p).flatten(2)
    direction = maps[DIRECTION]
    preference = 1 + TIE * torch.arange(2, -1, -1, device=lines.device, dtype=lines.dtype)
    main = (direction.detach().abs() * preference[:, None]).argmax(dim=0)
    return maps, main


def _joseph(rays: Rays, k: Tensor, s: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Flat indices and weights of slab k: bilinear, the volume zero-padded by one voxel."""
    share = (torch.minimum(rays.end, s + 0.5) - torch.maximum(rays.begin, s - 0.5)).clamp_min(0)
    sizes = rays.sizes[1:]
    place = rays.value + s * rays.slope + (sizes - 1) / 2
    place = torch.minimum(place.clamp_min(-1), sizes.to(s.dtype))
    cell = torch.minimum(place.detach().floor().long(), sizes - 1)
    part = place - cell
    base = (k + 1) * rays.strides[0] + ((cell + 1) * rays.strides[1:]).sum(dim=0)
    for b, weight_b in enumerate((1 - part[0], part[0])):
        for c, weight_c in enumerate((1 - part[1], part[1])):
            yield base + b * rays.strides[1] + c * rays.strides[2], share * weight_b * weight_c


def _siddon(rays: Rays, k: Tensor, s: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Flat indices and lengths of the at most three cells that a ray crosses in slab k."""
    near, far = torch.maximum(rays.begin, s - 0.5), torch.minimum(rays.end, s + 0.5)
    length = (far - near).clamp_min(0)
    sizes = rays.sizes[1:]
    offset = rays.value + sizes / 2
    one, two = offset + near * rays.slope, offset + far * rays.slope
    low, high = one.detach().floor(), two.detach().floor()
    crosses = low != high
    safe = torch.where(crosses, rays.slope, torch.ones_like(rays.slope))
    to = torch.where(crosses, ((torch.maximum(low, high) - one) / safe).clamp_min(0), length)
    to = torch.minimum(to, length)
    b_first = to[0] < to[1]
    middle = torch.stack(
        [torch.where(b_first, high[0], low[0]), torch.where(b_first, low[1], high[1])]
    )
    lengths = (
        torch.minimum(*to),
        torch.maximum(*to) - torch.minimum(*to),
        length - torch.maximum(*to),
    )
    for cell, weight in zip((low, middle, high), lengths, strict=True):
        inside = torch.minimum(cell.clamp_min(-1), sizes.to(s.dtype)).long()
        yield (k + 1) * rays.strides[0] + ((inside + 1) * rays.strides[1:]).sum(dim=0), weight


def _grown(rays: Rays) -> tuple[Tensor, Tensor]:
    """Where each ray enters and leaves the box enlarged by half a voxel."""
    half = rays.sizes / 2 + 0.5
    # a ray towards a face that it does not reach is inside or outside that slab of the box
    slope = torch.where(
        rays.slope == 0,
        torch.full_like(rays.slope, 1e-300 if rays.slope.dtype == torch.float64 else 1e-30),
        rays.slope,
    )
    one, two = (-half[1:] - rays.value) / slope, (half[1:] - rays.value) / slope
    enter = torch.maximum(rays.begin, torch.minimum(one, two).amax(dim=0))
    return enter, torch.maximum(enter, torch.minimum(rays.end, torch.maximum(one, two).amin(dim=0)))


def _trilinear(rays: Rays, samples: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Flat indices and weights of a fixed number of samples per ray, at the centres of equal
    intervals.
    """
    begin, end = _grown(rays)
    axes = rays.sizes
    for j in range(samples):
        s = begin + (end - begin) * ((j + 0.5) / samples)
        place = torch.cat([s[None], rays.value + s * rays.slope]) + (axes - 1) / 2
        place = torch.minimum(place.clamp_min(-1), axes.to(s.dtype))
        cell = torch.minimum(place.detach().floor().long(), axes - 1)
        part = place - cell
        for corner in itertools.product((0, 1), repeat=3):
            index = ((cell + 1 + cell.new_tensor(corner)[:, None]) * rays.strides).sum(dim=0)
            weight = math.prod(part[a] if corner[a] else 1 - part[a] for a in range(3))
            yield index, (end - begin) / samples * weight


def weights(
    lines: Tensor,
    window: Sequence[float],
    detector: Sequence[int],
    shape: Sequence[int],
    like: Tensor,
    method: str,
):
    """All flat indices and weights, in mm, of all rays: the rows of the system matrix, slab by
    slab.
    """
    name, _, samples = method.partition(":")
    exact = lines if name == "siddon" else like  # a crossing amplifies the rounding of a position
    reach = 0.5 if name == "trilinear" else 0.0
    rays = rays_of(*maps_at_pixels(lines, detector), window, shape, exact, reach)
    if name == "trilinear":
        for index, weight in _trilinear(rays, int(samples)):
            yield index, weight * rays.length
        return
    cells = {"joseph": _joseph, "siddon": _siddon}[name]
    for slab in range(max(shape)):
        k = torch.minimum(torch.tensor(slab, device=lines.device), rays.sizes[0] - 1)
        s = k.to(exact.dtype) - (rays.sizes[0] - 1) / 2
        counts = (rays.sizes[0] > slab) * rays.length
        for index, weight in cells(rays, k, s.to(exact.dtype)):
            yield index, (weight * counts).to(like.dtype)


def project(
    volume: Float[Tensor, "n d h w"],
    lines: Float[Tensor, "m 4 3 3"],
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
) -> Float[Tensor, "n m v u"]:
    """Line integrals of volumes, in mm times their unit.

    Args:
        volume: values on the grid.
        lines: the views' rays, from `lines_of`.
        window: valid range of each ray, as fractions of the way from source to pixel.
        detector: pixels (rows, columns).
        method: "joseph" (second order in the voxel size for smooth volumes), "siddon" (exact for
            constant voxels), or "trilinear:n" with n samples per ray (second order in both the
            voxel size and the distance of samples).
    """
    flat = F.pad(volume, (1, 1) * 3).flatten(1)
    total = volume.new_zeros(len(volume), len(lines) * detector[0] * detector[1])
    for index, weight in weights(lines, window, detector, volume.shape[1:], volume, method):
        total = total + weight * flat[:, index]
    return total.reshape(len(volume), len(lines), *detector)


def backproject(
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 3"],
    window: Sequence[float],
    shape: Sequence[int],
    method: str,
) -> Float[Tensor, "n d h w"]:
    """The exact transpose of `project`."""
    d, h, w = shape
    flat, values = views.new_zeros(len(views), (d + 2) * (h + 2) * (w + 2)), views.flatten(1)
    for index, weight in weights(lines, window, views.shape[2:], shape, views, method):
        flat = flat.index_add(1, index, weight * values)
    return flat.reshape(len(views), d + 2, h + 2, w + 2)[:, 1:-1, 1:-1, 1:-1]
