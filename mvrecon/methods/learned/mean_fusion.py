"""Learned back-projection filtering: the mean of per-view estimates."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.methods.learned.consistency import Consistency, Steps
from mvrecon.methods.learned.cross_view import PerViewEstimates
from mvrecon.methods.learned.geometry import geometry_of, validated
from mvrecon.methods.learned.start import ClassicalStart, Start, normalised
from mvrecon.methods.learned.unet import Precision
from mvrecon.methods.learned.view_frames import fuse
from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.operators.operator import Projector


class MeanFusion(nn.Module):
    """The mean over the cameras of their depth networks' estimates, at the grid's own resolution,
    then data-consistency steps and non-negativity, in the unit of (views / mm).

    Args:
        widths: channels of each scale of the depth network, the finest first.
        depths: bins along each ray.
        binning: pixels of a frustum's cell along each axis.
        head: name, or name and options, of the head.
        n_cameras: a network for each of so many cameras; None: one for all.
        start: iterations of SIRT with momentum, or name and options of a classical method.
        consistency: number of data-consistency steps at the end, or options of `Consistency`.
        precision: of the convolutions.
    """

    def __init__(
        self,
        widths: Sequence[int] = (8, 16),
        depths: int = 32,
        binning: int = 1,
        head: str | Mapping[str, Any] = "softmax_depth",
        n_cameras: int | None = None,
        start: Start = 12,
        consistency: Steps = 3,
        precision: Precision = "auto",
    ):
        super().__init__()
        self.estimates = PerViewEstimates(
            widths, 0, 0, depths, binning, head, n_cameras=n_cameras, precision=precision
        )
        self.consistency = Consistency(consistency)
        self.start = ClassicalStart(start, counts=self.consistency.poisson)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.consistency.lengths)
        g = geometry_of(y, A)
        frames = self.estimates.frames(g)
        y, x, scale = normalised(g, y, self.start, self.training)
        r = y - A(x)
        change, confidence, _, _ = self.estimates(frames, g, y, r, x, g.direction(r))
        fused, weights = fuse(change, torch.zeros_like(confidence), frames.visible)
        entry = x + fused
        volume = self.consistency(g, entry, y).clamp_min(0)
        return Reconstruction(
            volume * scale,
            per_view=(x[:, None] + change) * scale[:, None],
            visible=frames.visible,
            weights=weights,
            start=x * scale,
            entry=entry * scale if self.consistency.em else None,
        )
