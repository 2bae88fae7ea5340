"""A volume on another grid, without aliasing."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.sample import normalised, sample

#: Points at a time, which bounds the memory.
POINTS = 2**22


def resample(volume: Float[Tensor, "d h w"], source: Grid, target: Grid) -> Float[Tensor, "e i j"]:
    """Mean of a volume over each voxel of another grid; zero outside of the volume.

    Where the target is coarser, voxels of the source are first averaged in whole blocks of at most
    the target's size, then the target's voxels over points at most one and a half such blocks
    apart; between centres the volume is trilinear. Order of accuracy: second in the voxel size.
    """
    volume, source = pooled(
        volume, source, [max(1, int(step + 1e-6)) for step in _steps(source, target)]
    )
    split = max(1, round(max(_steps(source, target))))
    fine = target.refined(split)
    between = (
        torch.linalg.inv(source.affine) @ fine.affine
    )  # voxel indices of the target to those of the source
    slab = max(1, POINTS // (fine.shape[1] * fine.shape[2] * split)) * split
    parts = []
    for first in range(0, fine.shape[0], slab):
        index = between.clone()
        index[:3, 3] += first * index[:3, 2]
        shape = (min(slab, fine.shape[0] - first), *fine.shape[1:])
        points = normalised(voxel_centres(Grid(shape, index), volume.dtype), source.shape)
        values = sample(volume[None, None], points[None])
        parts.append(F.avg_pool3d(values, split)[0, 0])
    return torch.cat(parts)


def _steps(source: Grid, target: Grid) -> list[float]:
    """The greatest step along each axis (x, y, z) of the source, in its voxels, from one target
    voxel to the next.
    """
    between = torch.linalg.inv(source.affine) @ target.affine
    return between[:3, :3].abs().amax(dim=1).tolist()


def pooled(
    volume: Float[Tensor, "d h w"], grid: Grid, factors: Sequence[int]
) -> tuple[Float[Tensor, "e i j"], Grid]:
    """Means over whole blocks of voxels, `factors` along (x, y, z), and their grid; zeros fill up
    the last blocks.
    """
    if max(factors) == 1:
        return volume, grid
    kernel = tuple(factors[::-1])
    rest = [-n % k for n, k in zip(volume.shape, kernel, strict=True)]
    padded = F.pad(volume, (0, rest[2], 0, rest[1], 0, rest[0]))
    means = F.avg_pool3d(padded[None, None], kernel)[0, 0]
    steps = torch.tensor(factors, dtype=torch.float64)
    affine = grid.affine.clone()
    affine[:3, :3] *= steps
    affine[:3, 3] = grid.to_world((steps - 1) / 2)
    return means, Grid(tuple(means.shape), affine)  # type: ignore[arg-type]
