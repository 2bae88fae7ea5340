"""A trained method as a method with a name; imports Lightning at its first use."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector


class TrainedMethod(nn.Module):
    """A trained method, loaded from its checkpoint, in the unit of its training.

    Args:
        checkpoint: path of a checkpoint, of weights or of a run folder, or a name; see `load`.
        method: its label in the run's table.

    Warns:
            UserWarning: (call) another grid, projector or range of values than in training, or
                another rig than its only one.

        Raises:
            ValueError: (call) weights that do not fit the operator.
            FileNotFoundError, LookupError, Refused: (call) as `load`.
    """

    data_kind = "trained"

    def __init__(self, checkpoint: str, method: str | None = None):
        super().__init__()
        self.checkpoint, self.label = checkpoint, method

    @torch.no_grad()
    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        # imported here, as Lightning's import takes seconds
        from mvrecon.training.trained import load, warn_of_geometry, warn_of_values

        module = load(self.checkpoint, self.label).module.to(A.device)
        warn_of_geometry(A, module, self.checkpoint)
        out = module.method.eval()(views, A)
        warn_of_values(out.volume, module.hparams["data_range"], self.checkpoint)
        return out
