"""The bins of frusta: which of them may hold anything, and how much of its ray each one has."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class Bins:
    """What can be said of frusta ray by ray.

    Convention: the sample's axis b of `occupied` is there only where it depends on the sample.
    """

    occupied: Tensor  # [m 1 D v u] or [b m 1 D v u] bins that may hold anything
    step: Tensor  # [m 1 D v u] mm of ray in a bin

    def spread(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b m c D v u"]:
        """Uniform lift: each pixel's integral spread evenly along its ray's occupied bins."""
        share = self.occupied / self.chord.clamp_min(torch.finfo(views.dtype).tiny)
        return views.transpose(1, 2)[:, :, :, None] * share

    @property
    def chord(self) -> Float[Tensor, "*m 1 1 v u"]:
        """Length in mm of each ray's occupied bins."""
        return (self.occupied * self.step).sum(dim=-3, keepdim=True)

    def integrate(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b c m v u"]:
        """Each camera's own view of its own frustum: the sum along every ray, exactly."""
        return (frusta * self.step).sum(dim=3).transpose(1, 2)


@dataclass(frozen=True, eq=False)
class SomeBins(Bins):
    """Frusta of which only a part may hold anything, another one for each sample."""

    occupied: Bool[Tensor, "b m 1 D v u"]
    step: Float[Tensor, "m 1 D v u"]
