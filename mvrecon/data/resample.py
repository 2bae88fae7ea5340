"""Resampling of a volume to another grid without aliasing; and volumes read slab by slab, with axes
roughly to the patient's right, front and head whatever the file's order.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import SPACING_MM, Refused, io_library
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import centred_affine, lifted_maps
from mvrecon.kernels.warps import warp

#: Voxels of a slab, unless one plane has more: 8 MiB in float32.
SLAB_VOXELS = 2**21
Volume = Float[Tensor, "d h w"]
Slab = tuple[int, Volume]


@dataclass(frozen=True, eq=False)
class Slabs:
    """A volume [d h w], reread at every pass.

    Args:
        shape: voxels along (z, y, x).
        axis: axis of the tensor, 0 to 2, along which the slabs are cut, in any order.
        passes: begins a pass, which yields the first index along the axis and the values of every
            slab.
        stored: affine from a voxel's index (i, j, k) in the file to world mm; None: no file.
    """

    shape: tuple[int, int, int]
    axis: int
    passes: Callable[[], Iterator[Slab]]
    stored: np.ndarray | None = None

    @classmethod
    def of(cls, volume: Float[Tensor, "d h w"]) -> "Slabs":
        """A volume in memory, as one slab."""
        return cls(tuple(volume.shape), 0, lambda: iter([(0, volume)]))  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Slab]:
        return self.passes()

    def flipped(self, axes: list[int]) -> "Slabs":
        """Reverse some axes."""
        n, turned = self.shape[self.axis], self.axis in axes

        def passes() -> Iterator[Slab]:
            for first, slab in self:
                yield (n - first - slab.shape[self.axis] if turned else first), slab.flip(axes)

        return replace(self, passes=passes)

    def mapped(self, change: Callable[[Float[Tensor, "d h w"]], Float[Tensor, "d h w"]]) -> "Slabs":
        """Apply a function to every slab."""
        return replace(self, passes=lambda: ((first, change(slab)) for first, slab in self))

    def watched(self, check: Callable[[float, float], None]) -> "Slabs":
        """Call a function with the least and greatest value at the end of every pass."""

        def passes() -> Iterator[Slab]:
            low, high = math.inf, -math.inf
            for first, slab in self:
                low, high = min(low, slab.min().item()), max(high, slab.max().item())
                yield first, slab
            check(low, high)

        return replace(self, passes=passes)

    def whole(self) -> Float[Tensor, "d h w"]:
        """Read the whole volume into memory."""
        values = torch.empty(self.shape)
        for first, slab in self:
            values.narrow(self.axis, first, slab.shape[self.axis]).copy_(slab)
        return values


def planes(plane: int) -> int:
    """Number of planes in a slab, given the voxels of a plane."""
    return max(1, SLAB_VOXELS // plane)


def ends(line: Bool[Tensor, " n"]) -> tuple[int, int]:
    """Index of the first true value and one past the last; (0, 0) if none is true."""
    places = line.nonzero().flatten().tolist()
    return (places[0], places[-1] + 1) if places else (0, 0)


#: Greatest cosine between voxel axes at right angles.
MAX_AXIS_COSINE = 1e-4
#: Consecutive planes [i j k] along the file's last axis, with the index of the first.
Planes = tuple[int, np.ndarray]


def oriented(
    path: Path,
    shape: Sequence[int],
    affine: np.ndarray,
    passes: Callable[[], Iterator[Planes]],
) -> tuple[Slabs, Grid]:
    """Return a volume in slabs and its grid in mm, with axes permuted and reversed closest to RAS;
    values do not move.

    Args:
        path: path of the file, for messages.
        shape: voxels along the file's axes i, j, k.
        affine: map from a voxel's index (i, j, k) to world mm (RAS).
        passes: begins a pass over the file, which yields its planes along k.

    Raises:
        ImportError: nibabel is not installed.
        Refused: a singular affine, or voxels of zero size.
    """
    if not np.isfinite(affine).all() or np.linalg.det(affine) == 0:
        raise Refused(
            f"{path}: has the affine {affine.tolist()}; expected a finite one that can be inverted"
        )
    orientations = io_library("nibabel.orientations", path)
    axes = orientations.io_orientation(affine)
    turned = tuple(int(shape[int(k)]) for k in axes[:, 0].argsort())
    turn = orientations.inv_ornt_aff(axes, shape)
    grid = Grid(turned[::-1], torch.from_numpy(affine @ turn).double())  # type: ignore[arg-type]
    if not SPACING_MM[0] <= min(grid.spacing) <= max(grid.spacing) <= SPACING_MM[1]:
        raise Refused(
            f"{path}: has voxels of {grid.spacing} mm, expected {SPACING_MM[0]} to {SPACING_MM[1]}"
        )

    def slabs() -> Iterator[Slab]:
        for first, part in passes():
            # reversed axes are negative strides, which torch does not support
            part = part.astype(np.float32, copy=False)
            values = orientations.apply_orientation(part, axes).T.copy()
            start = shape[2] - first - part.shape[2] if axes[2, 1] < 0 else first
            yield start, torch.from_numpy(values)

    return Slabs(grid.shape, 2 - int(axes[2, 0]), slabs, affine), grid


def right_angled(grid: Grid) -> bool:
    """Whether a grid's axes are at right angles, as ITK's images and NIfTI's qform require."""
    axes = grid.affine[:3, :3] / grid.affine[:3, :3].norm(dim=0)
    return bool((axes.T @ axes - torch.eye(3, dtype=axes.dtype)).abs().max() <= MAX_AXIS_COSINE)


def storable(
    path: str | Path, volume: Volume, grid: Grid, stored: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the values [k j i] of a volume to write, float32, and their affine from (i, j, k) to
    world mm (RAS).

    Args:
        path: path of the file, for messages.
        volume: the values.
        grid: grid of the volume.
        stored: an affine that has the grid's axes in another order, permuted and reversed: that of
            the result; None: the grid's.

    Raises:
        ValueError: a volume of another shape than the grid's, values beyond float32, or voxels of a
            size that the readers refuse.
    """
    if tuple(volume.shape) != grid.shape:
        raise ValueError(
            f"{path}: expected one volume [d h w] of the grid's {grid.shape} voxels, got "
            f"{tuple(volume.shape)}"
        )
    if not SPACING_MM[0] <= min(grid.spacing) <= max(grid.spacing) <= SPACING_MM[1]:
        raise ValueError(
            f"{path}: expected voxels of {SPACING_MM[0]} to {SPACING_MM[1]} mm, got {grid.spacing}"
        )
    known = volume.detach().cpu()
    values = known.float()
    if values is not known and (bad := int((values.isinf() & known.isfinite()).sum())):
        raise ValueError(
            f"{path}: expected values up to {torch.finfo(torch.float32).max:g}, the greatest of "
            f"float32, got {bad} beyond; divide the volume by a unit of its own"
        )
    affine = grid.affine.numpy()
    if stored is None:
        return values.contiguous().numpy(), affine
    turn = (np.linalg.inv(affine) @ stored)[2::-1, 2::-1].round()  # from (k, j, i) to (z, y, x)
    turned = values.permute(np.abs(turn).argmax(axis=0).tolist())
    reversed_axes = np.flatnonzero(turn.sum(axis=0) < 0).tolist()
    return turned.flip(reversed_axes).contiguous().numpy(), stored


def reversed_axes(orientation: str) -> list[int]:
    """Return the axes of a volume [z y x] to reverse so that x, y, z run to R, A, S.

    Raises:
        ValueError: not one of L or R, P or A, I or S each, in this order.
    """
    if len(orientation) != 3 or any(
        a not in pair for a, pair in zip(orientation, ("LR", "PA", "IS"), strict=True)
    ):
        raise ValueError(
            f"An orientation is L or R, then P or A, then I or S, such as 'LPI'; got "
            f"{orientation!r}"
        )
    return [2 - i for i, letter in enumerate(orientation) if letter in "LPI"]


#: Points at a time, which bounds the memory.
BLOCK_POINTS = 2**22
#: Source voxels by which parallel axes may diverge over the whole target.
MAX_DIVERGENCE = 1e-4
#: Share of a voxel by which equal grids may differ.
MAX_MISALIGNMENT = 1e-6


def resample(volume: Volume | Slabs, source: Grid, target: Grid) -> Float[Tensor, "e i j"]:
    """Return the mean of a volume over each voxel of another grid; zero outside of the volume.

    For parallel axes the mean of the source's piecewise constant values is exact: sums are
    preserved, also via finer grids. For rotated axes source voxels are first averaged in whole
    blocks of at most the target's voxel size, then target voxels over points at most one and a half
    such blocks apart, trilinearly between centres of blocks: second order in the voxel size.
    Memory: the target, a few slabs, and the blocks near the target.
    """
    slabs = volume if isinstance(volume, Slabs) else Slabs.of(volume)
    if parallel(source, target):
        return box_means(slabs, source, target)
    blocks, grid = pooled(
        slabs, source, [max(1, int(step + 1e-6)) for step in _steps(source, target)], target
    )
    return _sampled(blocks, grid, target)


def parallel(source: Grid, target: Grid) -> bool:
    """Whether the axes of two grids are parallel and in the same direction."""
    between = (torch.linalg.inv(source.affine) @ target.affine)[:3, :3]
    across = between.abs().fill_diagonal_(0).amax()
    return bool(between.diagonal().min() > 0 and across * max(target.shape) < MAX_DIVERGENCE)


def cut(volume: Volume, source: Grid, target: Grid) -> Volume:
    """A volume times the share of each voxel in another grid's box; exact for parallel axes."""
    between = torch.linalg.inv(target.affine) @ source.affine
    at = [torch.arange(n, dtype=torch.float64) for n in volume.shape]
    volume = volume.clone()
    for row, size in zip(between, target.shape[::-1], strict=False):
        x, y, z = (step * places for step, places in zip(row, at[::-1], strict=False))
        z = z + row[3] - (size - 1) / 2  # from the middle of the box
        inside = z.float()[:, None, None] + y.float()[:, None] + x.float()
        width = row[:3].abs().sum().item()
        volume *= inside.abs_().neg_().add_(size / 2).div_(width).add_(0.5).clamp_(0, 1)
    return volume


def _sampled(volume: Volume, source: Grid, target: Grid) -> Float[Tensor, "e i j"]:
    split = max(1, math.ceil(max(_steps(source, target)) - 0.5 - 1e-6))  # 1.5 blocks: one point
    fine = target.refined(split)
    slab = max(1, BLOCK_POINTS // (fine.shape[1] * fine.shape[2] * split)) * split
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
    """The greatest step along each axis (x, y, z) of the source, in its voxels, between target
    voxels.
    """
    between = torch.linalg.inv(source.affine) @ target.affine
    return between[:3, :3].abs().amax(dim=1).tolist()


def pooled(
    volume: Volume | Slabs, grid: Grid, factors: Sequence[int], near: Grid | None = None
) -> tuple[Float[Tensor, "e i j"], Grid]:
    """Return means over whole blocks of voxels, `factors` along (x, y, z), and their grid,
    zero-padded.

    With `near`, only of the blocks needed for samples inside another grid's box.
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
    """Return the exact mean over each voxel of a grid with parallel axes, for piecewise constant
    source values and zero outside.

    Weights are products of overlaps along the three axes; slabs are summed.
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
                start, stop = ends((overlap > MAX_MISALIGNMENT).any(dim=0))
                values, shares = values.narrow(axis, start, stop - start), overlap[:, start:stop]
                same = len(shares) == stop - start
                if not same or (shares - torch.eye(len(shares))).abs().amax() > MAX_MISALIGNMENT:
                    part = values.movedim(axis, 0)
                    values = torch.tensordot(shares, part, dims=1).movedim(0, axis)
            total.narrow(k, low, high - low).add_(values)
    return total


def _overlaps(source: Grid, target: Grid, axis: int) -> Float[Tensor, "n m"]:
    """Share of each target voxel in each source voxel, along one axis of the tensors."""
    between, k = torch.linalg.inv(source.affine) @ target.affine, 2 - axis
    step = between[k, k].item()
    places = (
        torch.arange(target.shape[axis], dtype=torch.float64)[:, None] * step + between[k, 3].item()
    )
    offset = places - torch.arange(source.shape[axis], dtype=torch.float64)
    overlap = (offset + step / 2).clamp(-0.5, 0.5) - (offset - step / 2).clamp(-0.5, 0.5)
    return (overlap / step).float()
