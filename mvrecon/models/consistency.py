"""What every network shares with the classical methods: a start from SIRT, a scale, and data-consistency steps."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.projectors.base import Projector, check_views
from mvrecon.reconstruct.iterative import correction, sirt, sirt_weights


class Consistency(nn.Module):
    """A few learned-length gradient steps towards the data, x + lambda_k C A^T R (y - A x).

    C and R are the inverse column and row sums of A (SIRT, Gregor & Benson 2008), so a step of length one is stable for
    every rig. The steps' lengths are learned, as in ItNet (Genzel et al. 2022).

    Args:
        projector: A.
        steps: how many; none leaves the volume as it is.
    """

    row: Tensor
    column: Tensor

    def __init__(self, projector: Projector, steps: int):
        super().__init__()
        self.projector = projector
        row, column = sirt_weights(projector)
        self.register_buffer("row", row, persistent=False)
        self.register_buffer("column", column, persistent=False)
        self.lengths = nn.Parameter(torch.ones(steps))

    def start(self, views: Float[Tensor, "b 1 m v u"], iterations: int) -> Float[Tensor, "b 1 d h w"]:
        """The classical start: SIRT with momentum from zero, non-negative, not differentiated."""
        with torch.no_grad():
            return sirt(self.projector, views, iterations, weights=(self.row, self.column), momentum=True)

    def normalised(
        self, views: Float[Tensor, "b 1 m v u"], iterations: int
    ) -> tuple[Float[Tensor, "b 1 m v u"], Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 1 1 1"]]:
        """Checked views and their classical start, both divided by the content's scale, and that scale.

        Raises:
            ValueError: views whose shape, device or values do not fit.
        """
        check_views(views, self.projector.cameras)
        start = self.start(views, iterations)
        scale = content_scale(start)
        return views / scale, start / scale, scale

    def residual(
        self, volume: Float[Tensor, "b c d h w"], views: Float[Tensor, "b c m v u"]
    ) -> Float[Tensor, "b c d h w"]:
        """How each voxel should change for the views to be met: C A^T R (y - A x), in the unit of x."""
        return self.back(views - self.projector(volume))

    def back(self, residual: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Residual views as a correction of the volume, C A^T R r."""
        return correction(self.projector, residual, (self.row, self.column))

    def forward(
        self, volume: Float[Tensor, "b 1 d h w"], views: Float[Tensor, "b 1 m v u"]
    ) -> Float[Tensor, "b 1 d h w"]:
        for length in self.lengths:
            volume = volume + length * self.residual(volume, views)
        return volume


def content_scale(volume: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b 1 1 1 1"]:
    """The value of what is there, sum x^2 / sum x: v for any object of one value v, however small.

    Dividing by it makes a network's answer scale with its input: f(a y) = a f(y). One for an empty volume.
    """
    total = volume.sum(dim=(1, 2, 3, 4), keepdim=True)
    scale = volume.square().sum(dim=(1, 2, 3, 4), keepdim=True) / total.clamp_min(torch.finfo(volume.dtype).tiny)
    return torch.where(scale > 0, scale, torch.ones_like(scale))
