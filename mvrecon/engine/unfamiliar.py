"""Warnings where a trained network meets a geometry or values that its training did not have."""

import warnings
from typing import Any

import torch
from torch import Tensor

from mvrecon.data import digests
from mvrecon.projectors.operator import Projector

#: Of the training's value range: the greatest value of a volume is expected between these.
USUAL = (0.05, 2.0)


def warn_of_geometry(A: Projector, module: Any, source: str) -> None:
    """Warn where an operator's rig, grid or projector is not that of the training; of no rig where
    the network was trained on many.

    Args:
        A: the operator.
        module: the trained module.
        source: where it came from, for the message.
    """
    known, lines = module.projector, []
    many = module.hparams["geometry"].get("rigs", 0) > 0
    grid, trained_grid = A.grid, known.grid
    if not many and digests.of_rig(A.cameras) != digests.of_rig(known.cameras):
        counts = f"{len(known.cameras)} cameras of {known.cameras.shape} pixels"
        lines.append(f"rig ({counts}); got {len(A.cameras)} of {A.cameras.shape}")
    if grid.shape != trained_grid.shape or not torch.allclose(grid.affine, trained_grid.affine):
        got = f"{grid.shape} voxels of {grid.spacing} mm"
        lines.append(f"grid ({trained_grid.shape} of {trained_grid.spacing} mm); got {got}")
    if type(A) is not type(known):
        lines.append(f"projector ({type(known).__name__}); got {type(A).__name__}")
    for line in lines:
        warnings.warn(f"{source} was trained with another {line}", stacklevel=4)


def warn_of_values(volume: Tensor, data_range: float, source: str) -> None:
    """Warn where the greatest value of a reconstruction is far from the range of the training."""
    top = volume.amax().item() / data_range
    if not USUAL[0] <= top <= USUAL[1]:
        warnings.warn(
            f"{source} was trained on values up to {data_range:g}; the reconstruction reaches "
            f"{top * data_range:.3g}: do the views have another unit?",
            stacklevel=4,
        )
