"""Alignment of the views around any method."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.parts import CORRECTIONS
from mvrecon.methods.calibration.alignment import Alignment, CorrectedViews, aligned
from mvrecon.methods.learned.start import fingerprints
from mvrecon.methods.method import build_method
from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.operators.checks import check_views
from mvrecon.operators.operator import Projector


class Aligned(nn.Module):
    """Reconstruction by another method from aligned views, in the unit of (views / mm).

    The alignment is not differentiated. In training it is computed once for each case, at its first
    occurrence; the views of every step are read on the host for this.

    Args:
        method: name and options of the method.
        correct: name and options of the correction.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that a part does not have.
    """

    def __init__(self, method: Mapping[str, Any], correct: Mapping[str, Any] | None = None):
        super().__init__()
        self.method = build_method(method)
        self.correct = dict(correct or {"name": "align"})
        CORRECTIONS.check(self.correct)
        self._known: dict[bytes, Alignment] = {}

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_views(views, A.cameras)
        # an alignment to parts of a pixel needs float32
        with torch.no_grad(), torch.autocast(views.device.type, enabled=False):
            corrected = self._recalled(views, A) if self.training else self._corrected(views, A)
        return replace(self.method(corrected.views, A), alignment=corrected.alignment)

    def _corrected(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        return CORRECTIONS.from_config(self.correct, A, views)

    def _recalled(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        """The corrected views, by their alignments where these are known."""
        names = fingerprints(views)
        new = [i for i, name in enumerate(names) if name not in self._known]
        if new:
            corrected = self._corrected(torch.stack([views[i] for i in new]), A)
            if corrected.alignment is None:
                return self._corrected(views, A)
            for i, one in zip(new, corrected.alignment.split(), strict=True):
                self._known[names[i]] = one
        by = Alignment.joined([self._known[name] for name in names]).to(views)
        return CorrectedViews(aligned(views, by), by)
