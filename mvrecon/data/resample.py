"""A volume on another grid, without aliasing."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.slabs import Slabs, ends
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import centred_affine, lifted_maps
from mvrecon.kernels.warps import warp

#: Points at a time, which bounds the memory.
POINTS = 2**22
#: Source voxels by which axes that count as parallel may depart from each other over the whole
#: target.
PARALLEL = 1e-4
#: Share of a voxel by which voxels of two grids that count as the same may miss each other.
ALIGNED = 1e-6
Volume = Float[Tensor, "d h w"]


def resample(volume: Volume | Slabs, source: Grid, target: Grid) -> Float[Tensor, "e i j"]:
    """Mean of a volume over each voxel of another grid; zero outside of the volume.

    Where the axes of both grids are parallel the mean is exact, for voxels of the source that are
    constant: sums are kept, and finer grids have these means, too. Where axes are turned, voxels of
    the source are first averaged in whole blocks of at most the target's size, then the target's
    voxels over points at most one and a half such blocks apart; between centres of blocks the
    volume is trilinear, of second order in the voxel size. Memory: the target, a few slabs, and the
    blocks near the target.
    """
    slabs = volume if isinstance(volume, Slabs) else Slabs.of(volume)
    between = (torch.linalg.inv(source.affine) @ target.affine)[:3, :3]
    across = between.abs().fill_diagonal_(0).amax()
    if between.diagonal().min() > 0 and across * max(target.shape) < PARALLEL:
        return box_means(slabs, source, target)
    blocks, grid = pooled(
        slabs, source, [max(1, int(step + 1e-6)) for step in _steps(source, target)], target
    )
    return _sampled(blocks, grid, target)


def _sampled(volume: Volume, source: Grid, target: Grid) -> Float[Tensor, "e i j"]:
    split = max(1, round(max(_steps(source, target))))
    fine = target.refined(split)
    slab = max(1, POINTS // (fine.shape[1] * fine.shape[2] * split)) * split
    parts = []
    for first in range(0, fine.shape[0], slab):
        affine = fine.affine.clone()
        affine[:3, 3] += first * affine[:3, 2]
        part = Grid((min(slab, fine.shape[0] - first), *fine.shape[1:]), affine)
        between = torch.linalg.inv(centred_affine(source)) @ centred_affine(part)
        values = warp(volume[None, None, None], lifted_maps(between)[None, None], part.shape)
        parts.append((F.avg_pool3d(values[0, 0], split) if split > 1 else values[0, 0])[0, 0])
    return torch.cat(parts)


def _steps(source: Grid, target: Grid) -> list[float]:
    """The greatest step along each axis (x, y, z) of the source, in its voxels, from one target
    voxel to the next.
    """
    between = torch.linalg.inv(source.affine) @ target.affine
    return between[:3, :3].abs().amax(dim=1).tolist()


def pooled(
    volume: Volume | Slabs, grid: Grid, factors: Sequence[int], near: Grid | None = None
) -> tuple[Float[Tensor, "e i j"], Grid]:
    """Means over whole blocks of voxels, `factors` along (x, y, z), and their grid; zeros fill up
    the last blocks.

    With `near`, only of the blocks that samples inside the box of another grid may read.
    """
    corners = grid.to_index((grid if near is None else near).corners())
    steps = torch.tensor(factors, dtype=torch.float64)
    most = torch.tensor(grid.shape[::-1], dtype=torch.float64)
    low = (
        ((corners.amin(dim=0) + 0.5) / steps - 1)
        .clamp(min=torch.zeros(3))
        .minimum((most / steps).ceil() - 1)
    )
    low = low.floor()
    high = ((corners.amax(dim=0) + 0.5) / steps + 1).minimum(most / steps).maximum(low + 1).ceil()
    affine = grid.affine.clone()
    affine[:3, :3] *= steps
    affine[:3, 3] = grid.to_world((steps - 1) / 2 + low * steps)
    blocks = Grid(tuple((high - low).long().tolist()[::-1]), affine)  # type: ignore[arg-type]
    return box_means(
        volume if isinstance(volume, Slabs) else Slabs.of(volume), grid, blocks
    ), blocks


def box_means(slabs: Slabs, source: Grid, target: Grid) -> Float[Tensor, "e i j"]:
    """Exact mean over each voxel of a grid with parallel axes; the source's voxels are constant,
    zero is outside.

    A voxel's share is a product of overlaps along the three axes, and slabs add up.
    """
    overlaps = [_overlaps(source, target, axis) for axis in range(3)]
    total, k = torch.zeros(target.shape), slabs.axis
    for first, slab in slabs:
        along = overlaps[k].narrow(1, first, slab.shape[k])
        low, high = ends(along.any(dim=1))
        if low < high:
            values = slab
            for axis in sorted(range(3), key=lambda axis: axis == k):
                overlap = along[low:high] if axis == k else overlaps[axis]
                start, stop = ends(overlap.any(dim=0))
                values, shares = values.narrow(axis, start, stop - start), overlap[:, start:stop]
                same = len(shares) == stop - start
                if not same or (shares - torch.eye(len(shares))).abs().amax() > ALIGNED:
                    part = values.movedim(axis, 0)
                    values = torch.tensordot(shares, part, dims=1).movedim(0, axis)
            total.narrow(k, low, high - low).add_(values)
    return total


def _overlaps(source: Grid, target: Grid, axis: int) -> Float[Tensor, "n m"]:
    """Part of each target voxel that lies in each source voxel, along one axis of the tensors."""
    between, k = torch.linalg.inv(source.affine) @ target.affine, 2 - axis
    step = between[k, k].item()
    places = (
        torch.arange(target.shape[axis], dtype=torch.float64)[:, None] * step + between[k, 3].item()
    )
    offset = places - torch.arange(source.shape[axis], dtype=torch.float64)
    overlap = (offset + step / 2).clamp(-0.5, 0.5) - (offset - step / 2).clamp(-0.5, 0.5)
    return (overlap / step).float()
