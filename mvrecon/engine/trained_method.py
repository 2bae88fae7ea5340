"""A trained method by its checkpoint; Lightning is imported at its first use."""

import warnings

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.data import digests
from mvrecon.geometry.grid import Grid
from mvrecon.models.output import Reconstruction
from mvrecon.projectors.operator import Projector

#: Of the training's value range: a volume whose greatest value is not between these is told.
USUAL = (0.05, 2.0)


class TrainedMethod(nn.Module):
    """A trained method by its checkpoint, in the unit of its training.

    Args:
        checkpoint: path of a checkpoint, of weights or of a run folder, or a name; see `load`.
        method: its label in the run's table.

    Warns:
        UserWarning: another grid, projector or range of values than in training, or another rig
            where it was trained on one (at the call).

    Raises:
        ValueError: weights that do not fit the operator (at the call).
        FileNotFoundError, LookupError, Refused: as `load` (at the call).
    """

    views = "trained"

    def __init__(self, checkpoint: str, method: str | None = None):
        super().__init__()
        self.checkpoint, self.label = checkpoint, method

    @torch.no_grad()
    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        from mvrecon.engine.trained import load  # Lightning's import takes seconds

        module = load(self.checkpoint, self.label).module.to(A.device)
        many = module.hparams["geometry"].get("rigs", 0) > 0
        for difference in _differences(A, module.projector, many):
            warnings.warn(f"{self.checkpoint} was trained with another {difference}", stacklevel=2)
        out = module.method.eval()(views, A)
        _warn_of_values(out.volume, module.hparams["data_range"], self.checkpoint)
        return out


def grid_of_training(checkpoint: str, method: str | None = None) -> Grid:
    """The grid that a trained network was trained on, in mm.

    Arguments and errors as `TrainedMethod`.
    """
    from mvrecon.engine.trained import load  # Lightning's import takes seconds

    return load(checkpoint, method).module.projector.grid


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
