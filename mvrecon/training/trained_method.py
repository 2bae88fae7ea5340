"""The method `trained`, which loads the weights of a trained method at its first use."""

from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.quantities import WeightsFile
from mvrecon.methods.classical.solver import check_no_gradient
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector

if TYPE_CHECKING:
    from mvrecon.training.trained import Trained


class TrainedMethod(nn.Module):
    """A trained method, loaded from its checkpoint, in the unit of its training.

    Args:
        checkpoint: path of a checkpoint, of weights or of a run folder, or a name; see `load`.
        method: label of the method in the run's table.
        fallback: return the start where it predicts left-out views better, as in
            `Trained.reconstruct`.

    Warns:
        UserWarning: (call) as `Trained.reconstruct`.

    Raises:
        ValueError: (call) weights that do not fit the operator.
        FileNotFoundError, LookupError, Refused: (call) as `load`.
    """

    data_kind = "trained"

    def __init__(self, checkpoint: WeightsFile, method: str | None = None, fallback: bool = True):
        super().__init__()
        self.checkpoint, self.label, self.fallback = checkpoint, method, fallback

    def loaded(self) -> "Trained":
        """The method with its weights; raises as a call does."""
        # imported here, as Lightning's import takes seconds
        from mvrecon.training.trained import load

        return load(self.checkpoint, self.label)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_no_gradient("trained", views)
        trained = self.loaded()
        trained.module.to(A.device)
        return trained.reconstruct(views, A, str(self.checkpoint), self.fallback)
