"""A classical method as a model, for the table of a run."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.output import Reconstruction
from mvrecon.parts import RECONSTRUCTORS
from mvrecon.projectors.checks import check_views
from mvrecon.projectors.operator import Projector


class Classical(nn.Module):
    """A registered reconstructor, from the views to the volume; nothing to train.

    Args:
        projector: holds the grid and the rig.
        reconstructor: its name and options; SIRT by default.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that the reconstructor does not have.
    """

    def __init__(self, projector: Projector, reconstructor: Mapping[str, Any] | None = None):
        super().__init__()
        self.projector = projector
        self.reconstructor = dict(reconstructor or {"name": "sirt"})
        RECONSTRUCTORS.check(self.reconstructor)

    @torch.no_grad()
    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        check_views(views, self.projector.cameras)
        return Reconstruction(RECONSTRUCTORS.from_config(self.reconstructor, self.projector, views))
