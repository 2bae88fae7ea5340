"""The cross-view model: every camera forms an opinion of the volume, the cameras compare, a network weighs them.

1 lift, 2 pool what the other cameras say, 3 depth U-Net and head, 4 inverse projection to the world, 5 re-projection
into all cameras, 6 weighting, then refinement and 7 data consistency. `docs/model.md` walks through the shapes.
"""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.consistency import Consistency
from mvrecon.models.cross_view import pooled
from mvrecon.models.opinion import Opinions
from mvrecon.models.output import Reconstruction
from mvrecon.models.unet3d import UNet3d
from mvrecon.models.weighting import Weighting, fuse
from mvrecon.projectors.base import Projector


class CrossView(nn.Module):
    """Cross-view reconstruction.

    Args:
        projector: holds the grid and the rig.
        head: the head's name and options.
        opinion: options of `Opinions` (width, features, binning, shared, prior, geometry).
        fusion: "weighted" by a U-Net, or the plain "mean" over the cameras that see a voxel.
        refine: channels of the U-Net that corrects the fused volume, 0 for none: a weighted mean cannot create what
            no camera holds.
        start: SIRT iterations of the classical start.
        consistency: learned gradient steps towards the data at the end.

    Raises:
        ValueError: an unknown fusion; views whose shape, device or values do not fit (at the call).
    """

    def __init__(
        self,
        projector: Projector,
        head: Mapping[str, Any],
        opinion: Mapping[str, Any] | None = None,
        fusion: Literal["weighted", "mean"] = "weighted",
        refine: int = 16,
        start: int = 12,
        consistency: int = 3,
    ):
        super().__init__()
        if fusion not in ("weighted", "mean"):
            raise ValueError(f"fusion must be 'weighted' or 'mean', got {fusion!r}")
        self.projector = projector
        self.iterations = start
        self.opinions = Opinions(projector, head, **(opinion or {}))
        self.weighting = Weighting(5) if fusion == "weighted" else None
        self.refine = UNet3d(5 + self.opinions.features, 1, refine, zero=True) if refine else None
        self.consistency = Consistency(projector, consistency)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        y, x0, scale = self.consistency.normalised(views, self.iterations)
        opinions, features = self.opinions(y, x0, y - self.projector(x0))
        visible = self.opinions.fine.visible
        cross_views = self.cross(opinions)
        logits = torch.zeros_like(opinions)
        if self.weighting is not None:
            logits = self.weighting(self._compare(opinions, x0, y, cross_views))
        volume, weights = fuse(opinions, logits, visible)
        if self.refine is not None:
            volume = volume + self.refine(self._evidence(volume, opinions, features, weights, x0, y))
        volume = self.consistency(volume, y)
        return Reconstruction(
            volume=volume * scale,
            opinions=opinions * scale[:, None],
            visible=visible,
            weights=weights,
            cross_views=cross_views * scale,
        )

    def cross(self, opinions: Float[Tensor, "b m 1 d h w"]) -> Float[Tensor, "b m n v u"]:
        """Every camera's opinion as every camera would have seen it."""
        return self.projector(opinions.flatten(0, 1)).squeeze(1).unflatten(0, opinions.shape[:2])

    def _compare(self, opinions: Tensor, x0: Tensor, y: Tensor, cross_views: Tensor) -> Float[Tensor, "b m 5 d h w"]:
        """What the weighting sees: own opinion, pooled mean and spread, own disagreement with the views, the start."""
        mean, variance = pooled(opinions, self.opinions.fine.visible)
        with torch.no_grad():  # a hint for the weights; its gradient costs more than it teaches
            wrong = self.consistency.back((y - cross_views).flatten(0, 1)[:, None]).reshape(opinions.shape)
        shared = torch.cat([mean, _root(variance), x0[:, None]], dim=2).expand(-1, opinions.shape[1], -1, -1, -1, -1)
        return torch.cat([opinions, wrong, shared], dim=2)

    def _evidence(
        self, fused: Tensor, opinions: Tensor, features: Tensor, weights: Tensor, x0: Tensor, y: Tensor
    ) -> Float[Tensor, "b c d h w"]:
        """What the refinement sees: the fused volume, its residual, the spread, the start, the cameras' features."""
        mean, variance = pooled(opinions, self.opinions.fine.visible)
        wrong = self.consistency.residual(fused, y)
        said = (weights * features).sum(dim=1)
        return torch.cat([fused, wrong, mean[:, 0], _root(variance)[:, 0], x0, said], dim=1)


def _root(variance: Tensor) -> Tensor:
    """A square root with a finite slope at zero."""
    return (variance + 1e-6).sqrt()
