"""Voxel values of an analytic phantom: the mean over points that fill each voxel evenly."""

from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.data.scenes.solids import Phantom, Solids, contains
from mvrecon.geometry.grid import Grid

#: Sub-voxel points at a time, which bounds the memory.
POINTS = 2**18


def voxelise(phantom: Phantom, grid: Grid, factor: int = 4) -> Float[Tensor, "d h w"]:
    """Mean of the phantom's value over factor^3 points of each voxel, in float32.

    Equal to averaging `phantom.values` at the voxel centres of `grid.refined(factor)`. Only the
    voxels that the surface of a solid may cross are subdivided, so the time grows with the surface,
    not with the volume.

    Raises:
        ValueError: a factor below one.
    """
    if factor < 1:
        raise ValueError(f"Supersampling needs a factor of at least 1, got {factor}")
    volume = torch.zeros(grid.shape, dtype=torch.float64)
    for part in phantom.parts:
        for n in range(len(part.values)):
            _add(volume, grid, part, n, factor)
    return volume.to(torch.float32)


def _add(volume: Float[Tensor, "d h w"], grid: Grid, part: Solids, n: int, factor: int) -> None:
    """Add the n-th solid to the volume, in the block of voxels around it."""
    k = part.round_axes
    to_unit = (
        part.to_unit[n] @ grid.affine[:3, :3]
    )  # directions in voxels to the unit solid's frame
    centre = grid.to_index(part.centres[n])
    block = _block(grid, centre, torch.linalg.inv(to_unit), k)
    z, y, x = torch.meshgrid(
        *[torch.arange(s.start, s.stop, dtype=torch.float64) for s in block], indexing="ij"
    )
    p = torch.einsum("ij,j...->i...", to_unit, torch.stack([x, y, z]) - centre[:, None, None, None])
    reach = (
        to_unit.abs().sum(dim=1) / 2
    )  # how far a voxel's corners lie from its centre, along each axis
    radius = p[:k].norm(dim=0)
    flat = p[k:].abs() - reach[k:, None, None, None]
    touched = (radius <= 1 + reach[:k].norm()) & (flat <= 1).all(dim=0)
    full = (radius <= 1 - reach[:k].norm()) & (flat + 2 * reach[k:, None, None, None] <= 1).all(
        dim=0
    )
    cuts = part.unit_cuts[n]
    for cut in cuts:
        beyond = torch.einsum("i,i...->...", cut[:3], p) - cut[3]  # of a voxel's centre
        half = (cut[:3] @ to_unit).abs().sum() / 2
        touched &= beyond <= half
        full &= beyond <= -half
    share = full.to(torch.float64)
    edge = touched & ~full
    share[edge] = _shares(p[:, edge], to_unit, Shape(k, cuts), factor)
    volume[block] += part.values[n] * share


def _block(
    grid: Grid, centre: Float[Tensor, "3"], frame: Float[Tensor, "3 3"], k: int
) -> tuple[slice, slice, slice]:
    """The (z, y, x) block of voxels that the box around a solid meets; `frame` maps the unit solid
    to voxels.
    """
    half = frame[:, :k].norm(dim=1) + frame[:, k:].abs().sum(dim=1) + 0.5
    low, high = (centre - half).ceil().long().tolist(), (centre + half).floor().long().tolist()
    x, y, z = (
        slice(max(0, a), max(0, min(n, b + 1)))
        for a, b, n in zip(low, high, grid.shape[::-1], strict=True)
    )
    return z, y, x


class Shape(NamedTuple):
    """A unit solid: how many of its axes are round, and the half-spaces that cut it."""

    round_axes: int
    cuts: Float[Tensor, "k 4"]

    def contains(self, p: Float[Tensor, "3 ..."]) -> Bool[Tensor, "..."]:
        """Which points are in it."""
        inside = contains(p, self.round_axes)
        for cut in self.cuts:
            inside &= torch.einsum("i,i...->...", cut[:3], p) <= cut[3]
        return inside


def _shares(
    p: Float[Tensor, "3 e"], to_unit: Float[Tensor, "3 3"], shape: Shape, factor: int
) -> Float[Tensor, " e"]:
    """Share of each voxel's factor^3 points that lie in the solid."""
    steps = ((torch.arange(factor, dtype=torch.float64) + 0.5) / factor - 0.5).tolist()
    points = to_unit @ torch.tensor(list(product(steps, repeat=3)), dtype=torch.float64).T
    shares = [
        shape.contains(chunk[:, :, None] + points[:, None]).to(torch.float64).mean(dim=-1)
        for chunk in p.split(max(1, POINTS // factor**3), dim=1)
    ]
    return torch.cat(shares)
