"""Views as a trained model's cameras correct them; the engine is imported at its first use."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.calibration.alignment import CorrectedViews
from mvrecon.engine.trained_reconstructor import model_for
from mvrecon.projectors.operator import Projector


def corrected_by(
    A: Projector, views: Float[Tensor, "b 1 m v u"], checkpoint: str, method: str | None = None
) -> CorrectedViews:
    """Views as the last cameras' networks of a trained model correct them, in their unit.

    Args:
        A: the operator that made the views, on the grid of the training.
        views: in the operator's unit.
        checkpoint: path of a checkpoint or of a run folder.
        method: its label in the run's table; see `load`.

    Warns:
        UserWarning: another rig, grid or projector than in training.

    Raises:
        ValueError: a model that does not correct views, or one for another number of cameras or
            voxels.
        FileNotFoundError, LookupError, Refused: as `load`.
    """
    model, _ = model_for(A, checkpoint, method)
    with torch.inference_mode():
        out = model(views)
    if not out.corrected_views:
        raise ValueError(
            f"{checkpoint}: expected a model whose cameras correct their views, such as "
            f"'cross_view', got a {type(model).__name__} without"
        )
    return CorrectedViews(out.corrected_views[-1].clone(), out.alignment)
