"""The cross-view model: every camera forms an opinion of the volume, the cameras compare, a network
weighs them.

1 lift, 2 pool what the other cameras say, 3 depth U-Net and head, 4 inverse projection to the
world, 5 re-projection into all cameras, 6 weighting, then refinement and 7 data consistency.
`docs/model.md` walks through the shapes.
"""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import max_pool3d

from mvrecon.models.consistency import Consistency, normalised
from mvrecon.models.cross_view import pooled
from mvrecon.models.door import admitted
from mvrecon.models.geometry import MULTIPLE
from mvrecon.models.opinion import Opinions
from mvrecon.models.output import Reconstruction
from mvrecon.models.region import Region
from mvrecon.models.regions import Regions
from mvrecon.models.skip import Skip
from mvrecon.models.unet3d import UNet3d
from mvrecon.models.weighting import Weighting, fuse
from mvrecon.projectors.operator import Projector

#: Edge in voxels of the bricks that the refinement looks at or not; crops keep them in place.
BRICK = MULTIPLE


class CrossView(nn.Module):
    """Cross-view reconstruction.

    Args:
        projector: holds the grid and the rig.
        head: the head's name and options.
        opinion: options of `Opinions` (width, features, binning, shared, prior, geometry).
        fusion: "weighted" by a U-Net, or the plain "mean" over the cameras that see a voxel.
        refine: channels of the U-Net that corrects the fused volume, 0 for none: a weighted mean
            cannot create what no camera holds.
        start: SIRT iterations of the classical start.
        consistency: learned gradient steps towards the data at the end.
        skip: options of `Skip` (support, masked, ...): what is left out; nothing by default.

    Raises:
        TypeError: an option that there is not.
        ValueError: an unknown fusion; views that `admitted` refuses (at the call).
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
        **skip: Any,
    ):
        super().__init__()
        if fusion not in ("weighted", "mean"):
            raise ValueError(f"fusion must be 'weighted' or 'mean', got {fusion!r}")
        self.skip = Skip.of(skip)
        self.iterations = start
        self.opinions = Opinions(projector, head, **(opinion or {}))
        self.regions = Regions(projector, self.skip, self.opinions.binning)
        self.weighting = Weighting(5) if fusion == "weighted" else None
        self.refine = UNet3d(5 + self.opinions.features, 1, refine, zero=True) if refine else None
        self.consistency = Consistency(consistency)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.regions.cameras, self.consistency.lengths)
        region = self.regions(views)
        y, x0, scale = normalised(region, views, self.iterations)
        expected = region.A(x0)
        opinions, features = self.opinions(region, y, x0, y - expected)
        cross_views = region.A(
            opinions[:, :, 0]
        )  # every camera's opinion as every camera would have seen it
        logits = torch.zeros_like(opinions)
        if self.weighting is not None:
            seen = self._compare(region, opinions, x0, y - cross_views)
            logits = self.weighting(seen, region.net_mask)
        volume, weights = fuse(opinions, logits, region.seen())
        if self.refine is not None:
            volume = volume + self._correction(region, volume, (opinions, features, weights), x0, y)
        volume = self.consistency(
            region, volume, y, None if self.skip.sigma is None else self.skip.sigma / scale
        )
        return Reconstruction(
            volume=region.pasted(volume * scale),
            opinions=region.pasted(region.of_all(opinions, x0[:, None]) * scale[:, None]),
            visible=self.regions.whole.fine.visible,
            weights=region.pasted(region.of_all(weights)),
            cross_views=_of_all(region, cross_views, expected) * scale,
            support=region.support,
        )

    def _compare(
        self, region: Region, opinions: Tensor, x0: Tensor, wrong: Tensor
    ) -> Float[Tensor, "b m 5 d h w"]:
        """What the weighting sees: own opinion, pooled mean and spread, own disagreement with the
        views, the start.
        """
        mean, variance = pooled(opinions, region.geometry.fine.visible)
        with torch.no_grad():  # a hint for the weights; its gradient costs more than it teaches
            wrong = region.back(wrong)[:, :, None]
        shared = torch.cat([mean, _root(variance), x0[:, None]], dim=2).expand(
            -1, opinions.shape[1], -1, -1, -1, -1
        )
        return torch.cat([opinions, wrong, shared], dim=2)

    def _correction(
        self,
        region: Region,
        fused: Tensor,
        said: tuple[Tensor, Tensor, Tensor],
        x0: Tensor,
        y: Tensor,
    ) -> Float[Tensor, "b 1 d h w"]:
        """What the refinement adds where it looks, from the fused volume, its residual, the
        cameras' mean, spread and features, and the start; `said` are opinions, features and
        weights."""
        assert self.refine is not None
        opinions, features, weights = said
        mean, variance = pooled(opinions, region.geometry.fine.visible)
        wrong, heard = region.residual(fused, y), (weights * features).sum(dim=1)
        evidence = torch.cat([fused, wrong, mean[:, 0], _root(variance)[:, 0], x0, heard], dim=1)
        if self.skip.refine_where == "all":
            return region.within(self.refine(evidence, region.net_mask))
        where = disagreement(variance[:, 0].sqrt(), self.skip.tolerance)
        where = where if region.net_mask is None else where & region.net_mask
        return region.within(self.refine(evidence, where))


def _of_all(
    region: Region, cross_views: Float[Tensor, "b k k v u"], expected: Float[Tensor, "b 1 k v u"]
) -> Float[Tensor, "b m m v u"]:
    """Cross-views of all cameras: of those that are left out, opinions are the start, and views are
    of nothing.
    """
    return region.of_all(region.of_all(cross_views, expected).transpose(1, 2)).transpose(1, 2)


def disagreement(spread: Float[Tensor, "b 1 d h w"], tolerance: float) -> Bool[Tensor, "b 1 d h w"]:
    """Bricks of 4 voxels in which the opinions' spread passes a tolerance somewhere, and the bricks
    around them.
    """
    with torch.no_grad():
        bricks = (max_pool3d(spread, BRICK, ceil_mode=True) > tolerance).to(spread.dtype)
        near = max_pool3d(bricks, 3, stride=1, padding=1) > 0
    for axis, size in enumerate(spread.shape[2:], start=2):
        near = near.repeat_interleave(BRICK, dim=axis).narrow(axis, 0, size)
    return near


def _root(variance: Tensor) -> Tensor:
    """A square root with a finite slope at zero."""
    return (variance + 1e-6).sqrt()
