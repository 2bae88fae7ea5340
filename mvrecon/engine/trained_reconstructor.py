"""A trained network as a reconstructor; the engine is imported at its first use."""

import warnings
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.data import digests
from mvrecon.engine.on_case import plain
from mvrecon.engine.on_rig import model_on
from mvrecon.geometry.grid import Grid
from mvrecon.models.output import Reconstruction
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.problem import takes

#: Of the training's value range: a volume whose greatest value is not between these is told.
USUAL = (0.05, 2.0)


@takes("trained")
def trained(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    checkpoint: str,
    method: str | None = None,
    watch: Callable[[Reconstruction], None] | None = None,
) -> Float[Tensor, "b 1 d h w"]:
    """Reconstruct by a trained network, in the unit of its training.

    Args:
        A: the operator that made the views, on the grid that is reconstructed.
        views: in the operator's unit.
        checkpoint: path of a checkpoint, of weights or of a run folder, or a name; see `load`.
        method: its label in the run's table.
        watch: called with all that the network tells, before the volume is returned.

    Warns:
        UserWarning: another grid, projector or range of values than in training, or another rig
            where it was trained on one.

    Raises:
        ValueError: a network that was trained for another number of cameras or voxels.
        FileNotFoundError, LookupError, Refused: as `load`.
    """
    model, data_range = model_for(A, checkpoint, method)
    with torch.inference_mode():
        out = model(views)
    _warn_of_values(out.volume, data_range, checkpoint)
    if watch is not None:
        watch(out)
    return out.volume.clone()


def model_for(A: Projector, checkpoint: str, method: str | None = None) -> tuple[nn.Module, float]:
    """A trained network on an operator, ready to reconstruct, and the value range of its training.

    Arguments, warnings and errors as `trained`.
    """
    from mvrecon.engine.trained import load  # Lightning's import takes seconds

    module = load(checkpoint, method).module
    many = module.hparams["geometry"].get("rigs", 0) > 0
    for difference in _differences(A, plain(module.projector), many):
        warnings.warn(f"{checkpoint} was trained with another {difference}", stacklevel=3)
    return model_on(A, module, checkpoint), module.hparams["data_range"]


def grid_of_training(checkpoint: str, method: str | None = None) -> Grid:
    """The grid that a trained network was trained on, in mm.

    Arguments and errors as `trained`.
    """
    from mvrecon.engine.trained import load  # Lightning's import takes seconds

    return plain(load(checkpoint, method).module.projector).grid


def _differences(A: Projector, other: Projector, many: bool) -> list[str]:
    """What differs from the operator of the training, in words; no rig where it was trained on
    many.
    """
    grid, trained_grid, lines = A.grid, other.grid, []
    if not many and digests.of_rig(A.cameras) != digests.of_rig(other.cameras):
        counts = f"{len(other.cameras)} cameras of {other.cameras.shape} pixels"
        lines.append(f"rig ({counts}); got {len(A.cameras)} of {A.cameras.shape}")
    if grid.shape != trained_grid.shape or not torch.allclose(grid.affine, trained_grid.affine):
        got = f"{grid.shape} voxels of {grid.spacing} mm"
        lines.append(f"grid ({trained_grid.shape} of {trained_grid.spacing} mm); got {got}")
    if type(A) is not type(other):
        lines.append(f"projector ({type(other).__name__}); got {type(A).__name__}")
    return lines


def _warn_of_values(volume: Tensor, data_range: float, checkpoint: str) -> None:
    top = volume.amax().item() / data_range
    if not USUAL[0] <= top <= USUAL[1]:
        warnings.warn(
            f"{checkpoint} was trained on values up to {data_range:g}; the reconstruction reaches "
            f"{top * data_range:.3g}: do the views have another unit?",
            stacklevel=3,
        )
