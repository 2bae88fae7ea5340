"""A volume that is read slab by slab, so that memory holds one slab and not the volume, and of any
axes as one whose x, y, z run roughly to the patient's right, front and head.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import SPACING, Refused, io_library
from mvrecon.geometry.grid import Grid

#: Voxels of a slab, unless one plane has more: 8 MiB in float32.
VOXELS = 2**21
Slab = tuple[int, Float[Tensor, "d h w"]]


@dataclass(frozen=True, eq=False)
class Slabs:
    """A volume [d h w], read anew at every pass.

    Args:
        shape: voxels along (z, y, x).
        axis: of the tensor, 0 to 2, along which the slabs follow each other, in any order.
        passes: begins a pass, which gives the first index along the axis and the values of every
            slab once.
    """

    shape: tuple[int, int, int]
    axis: int
    passes: Callable[[], Iterator[Slab]]

    @classmethod
    def of(cls, volume: Float[Tensor, "d h w"]) -> "Slabs":
        """A volume in memory, as one slab."""
        return cls(tuple(volume.shape), 0, lambda: iter([(0, volume)]))  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Slab]:
        return self.passes()

    def flipped(self, axes: list[int]) -> "Slabs":
        """The volume with some of its axes reversed."""
        n, turned = self.shape[self.axis], self.axis in axes

        def passes() -> Iterator[Slab]:
            for first, slab in self:
                yield (n - first - slab.shape[self.axis] if turned else first), slab.flip(axes)

        return replace(self, passes=passes)

    def mapped(self, change: Callable[[Float[Tensor, "d h w"]], Float[Tensor, "d h w"]]) -> "Slabs":
        """The volume with a function applied to every slab."""
        return replace(self, passes=lambda: ((first, change(slab)) for first, slab in self))

    def watched(self, check: Callable[[float, float], None]) -> "Slabs":
        """The volume whose least and greatest value a function gets at the end of every pass."""

        def passes() -> Iterator[Slab]:
            low, high = math.inf, -math.inf
            for first, slab in self:
                low, high = min(low, slab.min().item()), max(high, slab.max().item())
                yield first, slab
            check(low, high)

        return replace(self, passes=passes)

    def whole(self) -> Float[Tensor, "d h w"]:
        """The whole volume in memory."""
        values = torch.empty(self.shape)
        for first, slab in self:
            values.narrow(self.axis, first, slab.shape[self.axis]).copy_(slab)
        return values


def planes(plane: int) -> int:
    """Number of planes in a slab, for a number of voxels in one plane."""
    return max(1, VOXELS // plane)


def ends(line: Bool[Tensor, " n"]) -> tuple[int, int]:
    """Index of the first true value and index behind the last one; (0, 0) if none is true."""
    places = line.nonzero().flatten().tolist()
    return (places[0], places[-1] + 1) if places else (0, 0)


#: The cosine up to which voxel axes count as at right angles.
SKEW = 1e-4
#: Consecutive planes [i j k] along the file's last axis, with the index of the first.
Planes = tuple[int, np.ndarray]


def oriented(
    path: Path,
    shape: Sequence[int],
    affine: np.ndarray,
    passes: Callable[[], Iterator[Planes]],
) -> tuple[Slabs, Grid]:
    """Volume in slabs and its grid in mm, axes swapped and reversed until they run closest to RAS;
    values stay at their places.

    Args:
        path: of the file, for messages.
        shape: voxels along the file's axes i, j, k.
        affine: from a voxel's index (i, j, k) to world mm (RAS).
        passes: begins a pass over the file, which gives its planes along k.

    Raises:
        ImportError: nibabel is not installed.
        Refused: an affine that cannot be inverted, or voxels of no size.
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
    if not SPACING[0] <= min(grid.spacing) <= max(grid.spacing) <= SPACING[1]:
        raise Refused(
            f"{path}: has voxels of {grid.spacing} mm, expected {SPACING[0]} to {SPACING[1]}"
        )

    def slabs() -> Iterator[Slab]:
        for first, part in passes():
            # reversed axes are strides backwards, which torch does not take
            part = part.astype(np.float32, copy=False)
            values = orientations.apply_orientation(part, axes).T.copy()
            start = shape[2] - first - part.shape[2] if axes[2, 1] < 0 else first
            yield start, torch.from_numpy(values)

    return Slabs(grid.shape, 2 - int(axes[2, 0]), slabs), grid


def right_angled(grid: Grid) -> bool:
    """Whether a grid's axes are at right angles, as ITK's images and NIfTI's qform need them."""
    axes = grid.affine[:3, :3] / grid.affine[:3, :3].norm(dim=0)
    return bool((axes.T @ axes - torch.eye(3, dtype=axes.dtype)).abs().max() <= SKEW)


def reversed_axes(orientation: str) -> list[int]:
    """Which axes of a volume [z y x] must be reversed so that x, y, z run to R, A, S.

    Raises:
        ValueError: letters that are not L or R, P or A, I or S, in this order.
    """
    if len(orientation) != 3 or any(
        a not in pair for a, pair in zip(orientation, ("LR", "PA", "IS"), strict=True)
    ):
        raise ValueError(
            f"An orientation is L or R, then P or A, then I or S, such as 'LPI'; got "
            f"{orientation!r}"
        )
    return [2 - i for i, letter in enumerate(orientation) if letter in "LPI"]
