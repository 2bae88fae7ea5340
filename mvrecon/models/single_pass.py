"""The cross-view model: every camera forms an opinion of the volume, the cameras compare, a network
weighs them.

1 lift, 2 statistics of the other cameras, 3 depth U-Net and head, 4 inverse projection to the
world, 5 re-projection into all cameras, 6 weighting, then refinement and 7 data consistency.
`docs/model.md` walks through the shapes.
"""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.consistency import Consistency, Steps
from mvrecon.models.cropping import Cropping
from mvrecon.models.door import admitted
from mvrecon.models.geometry import Geometry
from mvrecon.models.network import network_by_name
from mvrecon.models.opinion import DepthNetwork, Opinions
from mvrecon.models.options import Options
from mvrecon.models.output import Reconstruction
from mvrecon.models.pooling import deviation, disagreement, pooled
from mvrecon.models.start import ClassicalStart, Start, normalised
from mvrecon.models.weighting import Weighting, comparison, fuse
from mvrecon.projectors.operator import Projector


class SinglePass(nn.Module):
    """Cross-view reconstruction.

    Args:
        projector: holds the grid and the rig.
        head: the head's name and options.
        opinion: fields of `DepthNetwork` (width, features, binning, shared, prior, network).
        fusion: "weighted" by a U-Net, or the plain "mean" over the cameras that see a voxel.
        refine: channels of the U-Net that corrects the fused volume, 0 for none: a weighted mean
            cannot create what no camera holds.
        start: iterations of SIRT with momentum, the classical start, or a reconstructor as `{name:
            ..., **options}`.
        consistency: learned gradient steps towards the data at the end, or `{steps: ..., noise:
            poisson}` for counts.
        options: of `Options`: what is left out (support, masked, ...), nothing by default, and the
            network that corrects the fused volume.

    Raises:
        TypeError: an option that there is not.
        ValueError: an unknown fusion; a network where `refine` is 0; views that `admitted`
            refuses (at the call).
    """

    def __init__(
        self,
        projector: Projector,
        head: Mapping[str, Any],
        opinion: Mapping[str, Any] | None = None,
        fusion: Literal["weighted", "mean"] = "weighted",
        refine: int = 16,
        start: Start = 12,
        consistency: Steps = 3,
        **options: Any,
    ):
        super().__init__()
        if fusion not in ("weighted", "mean"):
            raise ValueError(f"fusion must be 'weighted' or 'mean', got {fusion!r}")
        self.options = Options.of(type(self), options)
        steps = Consistency(consistency)
        self.start = ClassicalStart(start, counts=steps.poisson)
        self.opinions = Opinions(projector, head, DepthNetwork(**(opinion or {})))
        self.cropping = Cropping(projector, self.options, self.opinions.binning)
        self.weighting = Weighting(5) if fusion == "weighted" else None
        self.refine = self._refinement(refine)
        self.consistency = steps

    def _refinement(self, width: int) -> nn.Module | None:
        network = self.options.network
        if width:
            return network_by_name(network, 5 + self.opinions.features, 1, width, zero=1)
        if network is not None:
            raise ValueError(
                f"A network corrects the fused volume, which refine=0 leaves out, got {network}"
            )
        return None

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        views = admitted(views, self.cropping.cameras, self.consistency.lengths)
        return self.cropping(views, self.reconstruct)

    def reconstruct(self, views: Float[Tensor, "b 1 m v u"], geometry: Geometry) -> Reconstruction:
        """The volume and the opinions on a geometry: the whole grid's, or a crop's."""
        y, x0, scale = normalised(geometry, views, self.start, self.training)
        expected = geometry.A(x0)
        opinions, features = self.opinions(geometry, y, x0, y - expected)
        cross_views = geometry.A(opinions[:, :, 0])  # each opinion as every camera would see it
        logits = torch.zeros_like(opinions)
        if self.weighting is not None:
            evidence = comparison(geometry, opinions, x0, y - cross_views)
            logits = self.weighting(evidence, geometry.network_mask)
        volume, weights = fuse(opinions, logits, geometry.visible)
        if self.refine is not None:
            features = (weights * features).sum(dim=1)
            volume = volume + self._correction(geometry, y, x0, volume, opinions, features)
        sigma = None if self.options.sigma is None else self.options.sigma / scale
        volume = self.consistency(geometry, volume, y, sigma)
        return Reconstruction(
            volume=volume * scale,
            opinions=opinions * scale[:, None],
            visible=geometry.fine.visible,
            weights=weights,
            cross_views=cross_views * scale,
            support=geometry.mask,
            start=x0 * scale,
            start_views=expected * scale,
        )

    def _correction(
        self,
        geometry: Geometry,
        y: Float[Tensor, "b 1 m v u"],
        x0: Float[Tensor, "b 1 d h w"],
        fused: Float[Tensor, "b 1 d h w"],
        opinions: Float[Tensor, "b m 1 d h w"],
        features: Float[Tensor, "b f d h w"],
    ) -> Float[Tensor, "b 1 d h w"]:
        """What the refinement adds where it looks, from the fused volume, its residual, the
        opinions' mean and deviation, the start, and the fused features.
        """
        assert self.refine is not None
        mean, variance = pooled(opinions, geometry.fine.visible)
        statistics = [mean[:, 0], deviation(variance)[:, 0]]
        residual = geometry.residual(fused, y)
        evidence = torch.cat([fused, residual, *statistics, x0, features], dim=1)
        mask = geometry.network_mask
        if self.options.refine_where == "disagreement":
            where = disagreement(variance[:, 0].sqrt(), self.options.tolerance)
            mask = where if mask is None else where & mask
        return geometry.within(self.refine(evidence, mask))
