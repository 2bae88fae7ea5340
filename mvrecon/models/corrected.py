"""Any model on corrected views."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.calibration.alignment import Alignment, CorrectedViews, aligned
from mvrecon.models.fingerprints import fingerprints
from mvrecon.models.output import Reconstruction
from mvrecon.parts import CORRECTIONS, MODELS
from mvrecon.projectors.checks import check_views
from mvrecon.projectors.operator import Projector


class Corrected(nn.Module):
    """Reconstruction by another model from corrected views, in the unit of (views / mm).

    The correction is not differentiated. In training the alignment of each view is computed once,
    at the first time that it comes; for this the host reads the views of every step, the one wait
    for a GPU. In evaluation there is none.

    Args:
        projector: its grid and its rig.
        model: name and options of the model; SIRT by default.
        correct: name and options of the correction; by default, alignment of the views.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that a part does not have.
    """

    def __init__(
        self,
        projector: Projector,
        model: Mapping[str, Any] | None = None,
        correct: Mapping[str, Any] | None = None,
    ):
        super().__init__()
        self.projector = projector
        self.model = MODELS.from_config(model or {"name": "sirt"}, projector=projector)
        self.correct = dict(correct or {"name": "align"})
        CORRECTIONS.check(self.correct)
        self._known: dict[bytes, Alignment] = {}

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        check_views(views, self.projector.cameras)
        # a fit of parts of a pixel is no work for half precision
        with torch.no_grad(), torch.autocast(views.device.type, enabled=False):
            corrected = self._recalled(views) if self.training else self._corrected(views)
        return replace(self.model(corrected.views), alignment=corrected.alignment)

    def _corrected(self, views: Float[Tensor, "b 1 m v u"]) -> CorrectedViews:
        return CORRECTIONS.from_config(self.correct, self.projector, views)

    def _recalled(self, views: Float[Tensor, "b 1 m v u"]) -> CorrectedViews:
        """The corrected views, by their alignments where these are known."""
        names = fingerprints(views)
        new = [i for i, name in enumerate(names) if name not in self._known]
        if new:
            corrected = self._corrected(torch.stack([views[i] for i in new]))
            if corrected.alignment is None:
                return self._corrected(views)
            for i, one in zip(new, corrected.alignment.split(), strict=True):
                self._known[names[i]] = one
        by = Alignment.joined([self._known[name] for name in names]).to(views)
        return CorrectedViews(aligned(views, by), by)
