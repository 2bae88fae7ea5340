"""A volume of any axes as one whose x, y, z run roughly to the patient's right, front and head."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from mvrecon.core.files.checks import SPACING, Refused
from mvrecon.data.slabs import Slab, Slabs
from mvrecon.geometry.grid import Grid

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
    try:
        from nibabel.orientations import apply_orientation, inv_ornt_aff, io_orientation
    except ImportError as error:
        raise ImportError(f"{path}: needs nibabel: pip install 'mvrecon[io]'") from error
    axes = io_orientation(affine)
    turned = tuple(int(shape[int(k)]) for k in axes[:, 0].argsort())
    grid = Grid(turned[::-1], torch.from_numpy(affine @ inv_ornt_aff(axes, shape)).double())  # type: ignore[arg-type]
    if not SPACING[0] <= min(grid.spacing) <= max(grid.spacing) <= SPACING[1]:
        raise Refused(
            f"{path}: has voxels of {grid.spacing} mm, expected {SPACING[0]} to {SPACING[1]}"
        )

    def slabs() -> Iterator[Slab]:
        for first, part in passes():
            # reversed axes are strides backwards, which torch does not take
            values = apply_orientation(part.astype(np.float32, copy=False), axes).T.copy()
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
