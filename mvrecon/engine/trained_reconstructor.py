"""A trained network as a reconstructor; the engine is imported at its first use."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.engine.on_case import plain
from mvrecon.engine.on_rig import model_on
from mvrecon.engine.unfamiliar import warn_of_geometry, warn_of_values
from mvrecon.geometry.grid import Grid
from mvrecon.models.output import Reconstruction
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.problem import takes


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
    warn_of_values(out.volume, data_range, checkpoint)
    if watch is not None:
        watch(out)
    return out.volume.clone()


def model_for(A: Projector, checkpoint: str, method: str | None = None) -> tuple[nn.Module, float]:
    """A trained network on an operator, ready to reconstruct, and the value range of its training.

    Arguments, warnings and errors as `trained`.
    """
    from mvrecon.engine.trained import load  # Lightning's import takes seconds

    module = load(checkpoint, method).module
    warn_of_geometry(A, module, checkpoint)
    return model_on(A, module, checkpoint), module.hparams["data_range"]


def grid_of_training(checkpoint: str, method: str | None = None) -> Grid:
    """The grid that a trained network was trained on, in mm.

    Arguments and errors as `trained`.
    """
    from mvrecon.engine.trained import load  # Lightning's import takes seconds

    return plain(load(checkpoint, method).module.projector).grid
