"""The cameras' opinions within a round: each places what its corrected view misses along its rays,
all are compared, and a network weighs them.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import max_pool3d

from mvrecon.models.cross_view.evidence import MAGNIFIED
from mvrecon.models.cross_view.sampling import FixedFrusta
from mvrecon.models.cross_view.settings import OpinionOptions
from mvrecon.models.cross_view.transmission import Transmission
from mvrecon.models.cross_view.unet import PlainUNet, Precision
from mvrecon.models.cross_view.views import Binned, means, pixels
from mvrecon.models.networks import halved
from mvrecon.models.pooling import deviation, leave_one_out, pooled
from mvrecon.models.weighting import fuse
from mvrecon.parts import HEADS
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.division import divided

#: Density by which an empty voxel counts along a ray, relative to the content's scale.
LEAST = 0.01
#: By which the logarithm of the strength of the rays' weights is learned faster than other weights:
#: one number that should be where it belongs within the first tenth of a training.
FASTER = 10.0


class Fused(NamedTuple):
    """Opinions and what they come to, at their resolution.

    Args:
        opinions: of each camera, relative to the content's scale.
        visible: which voxels each camera's frustum holds.
        weights: of each camera; they sum to one over those that see a voxel.
        expected: what the others' opinions together predict of each camera's view, in cells of
            pixels.
        evidence: for the network in the world: the fused change, the deviation over the cameras,
            and the fused features.
        ray_weights: how much the residual of each ray counts; none where all count as one.
    """

    opinions: Float[Tensor, "b m 1 d h w"]
    visible: Bool[Tensor, "m 1 d h w"]
    weights: Float[Tensor, "b m 1 d h w"]
    expected: Float[Tensor, "b 1 m r s"]
    evidence: Float[Tensor, "b e d h w"]
    ray_weights: Float[Tensor, "b 1 m v u"] | None = None


class Opinions(nn.Module):
    """M camera volumes as changes of the volume x, compared and fused, in the unit of x.

    In its frustum each camera's change of the density meets its own residual view (in cells of
    pixels, to rounding; heads whose `keeps_views` is true): the error of coarse cells along a ray
    is in x and in the opinion alike, and drops out. The change goes to the world by inverse
    projection, the mean of all others' changes comes back along the rays (leave-one-out), and what
    of the camera's residual they do not explain is evidence for the weights. Of each camera all
    this is in cells: with cells of 8 voxels an eighth of a volume.

    Args:
        projector: its grid and its rig.
        options: of the opinions.
        edge: voxels of a cell along each axis.
        binning: detector pixels joined along each axis.
        depths: bins along a ray.
        precision: of the convolutions.
    """

    def __init__(
        self,
        projector: Projector,
        options: OpinionOptions,
        edge: int,
        binning: int,
        depths: int,
        precision: Precision = "float32",
    ):
        super().__init__()
        self.edge, self.binning, self.learned = edge, binning, options.learned
        self.of_residual = options.places == "residual"
        # towards 0 where no camera errs, since noise of the weights is an error there; never below,
        # where cameras would be believed the more the less weight they have
        self.log_strength = nn.Parameter(torch.zeros(())) if options.weigh_rays else None
        cameras = Binned.of(projector, binning).cameras
        self.inside = FixedFrusta(projector.grid.coarsened(edge), cameras, depths)
        mu = projector.attenuation()
        mu = None if mu is None else self._cells(mu.detach()[None, None])
        self.transmission = Transmission(self.inside.frusta, mu)
        self.head = HEADS.from_config(options.head)
        self.weighting: PlainUNet | None = None
        if options.weighted:
            inputs = 5 + options.learned
            self.weighting = PlainUNet(3, inputs, 1, options.widths, zero=1, precision=precision)
            self.at_once = max(1, edge**3 // options.widths[0])
            self.weighting.last.bias = None  # one number for all cameras weighs none

    def forward(
        self,
        volume: Float[Tensor, "b 1 d h w"],
        residual: Float[Tensor, "b 1 m v u"],
        projected: Float[Tensor, "b 1 m v u"],
        placed: Float[Tensor, "b m c D r s"] | None,
        mask: Bool[Tensor, "b 1 d h w"] | None,
        sums: Float[Tensor, "#b 1 m v u"] | None = None,
    ) -> Fused:
        """The opinions about a volume.

        Args:
            volume: x, relative to the content's scale.
            residual: corrected views less those of x, relative to the content's scale.
            projected: the views of x, likewise.
            placed: of the cameras' network: logits of depth and of confidence, and features; none
                without a network.
            mask: voxels whose density may differ from zero; none for all.
            sums: views of ones within the mask, for views that are no line integrals, such as
                counts; none for those that are.
        """
        frusta, x = self.inside.frusta, self._cells(volume)
        unit = None if sums is None else self._unit(x, sums, mask)
        prior = frusta.to_frusta(x[:, None]).expand(-1, len(frusta.step), -1, -1, -1, -1)
        prior = self.transmission.attenuate(prior * frusta.occupied)
        integral = frusta.integrate(prior)
        missed = means(residual if self.of_residual else residual + projected, self.binning)
        missed = missed if unit is None else divided(missed, unit)
        missed = missed if self.of_residual else missed - integral
        density, rest = self._density(prior, integral + missed, placed)
        # The change is carried to the world, not the density: two warps would blur what x has.
        emitted = self.transmission.restore(density - prior)
        carried = frusta.to_world(torch.cat([emitted, *rest], dim=2))
        if mask is not None:
            carried = carried * self._cells(mask.to(x.dtype), largest=True)[:, None]
        change, confidence, features = self._parts(carried)
        mean, variance, _ = leave_one_out(change, frusta.visible)
        expected = frusta.integrate(
            self.transmission.attenuate(frusta.to_frusta(mean) * frusta.occupied)
        )
        changes = torch.cat([change, mean, deviation(variance)], dim=2)
        logits = self._logits(changes, missed - expected, x, confidence)
        fused, weights = fuse(torch.cat([change, features], dim=2), logits, frusta.visible)
        _, spread = pooled(change, frusta.visible)
        average, features = fused.split([1, fused.shape[1] - 1], dim=1)
        small = MAGNIFIED * torch.cat([average, deviation(spread)[:, 0]], dim=1)
        evidence = torch.cat([small, features], dim=1)
        rays = None
        if self.log_strength is not None:
            relative = pixels(self._ray_weights(x, weights), self.binning, residual)
            # a ray below 0 would take x away from the view of a camera that is not believed
            rays = (1 + (FASTER * self.log_strength).exp() * (relative - 1)).clamp_min(0)
        expected = expected if unit is None else expected * unit
        expected = expected + means(projected, self.binning)
        return Fused(x[:, None] + change, frusta.visible, weights, expected, evidence, rays)

    def _ray_weights(
        self, x: Float[Tensor, "b 1 e i x"], weights: Float[Tensor, "b m 1 e i x"]
    ) -> Float[Tensor, "b 1 m r s"]:
        """The mean along each ray of its camera's weight, relative to that of equal weights; a
        voxel counts by its density.
        """
        frusta = self.inside.frusta
        density = (x.detach().clamp_min(0) + LEAST)[:, None] * frusta.visible
        relative = weights * frusta.visible.sum(dim=0)
        both = frusta.to_frusta(torch.cat([density * relative, density], dim=2))
        weighted, equal = both.sum(dim=3).unbind(2)
        return divided(weighted, equal, 1.0)[:, None]

    def _unit(
        self,
        x: Float[Tensor, "b 1 e i x"],
        sums: Float[Tensor, "#b 1 m v u"],
        mask: Bool[Tensor, "b 1 d h w"] | None,
    ) -> Float[Tensor, "#b 1 m r s"]:
        """Views per integral of what reaches the detector, from views of ones and the rays' chords
        of the mask.
        """
        frusta = self.inside.frusta
        ones = torch.ones_like(x[:1]) if mask is None else self._cells(mask.to(x.dtype))
        chords = frusta.integrate(
            self.transmission.attenuate(frusta.to_frusta(ones[:, None]) * frusta.occupied)
        )
        return torch.where(chords > 0, means(sums, self.binning) / chords.clamp_min(1e-6), 0)

    def _cells(
        self, volume: Float[Tensor, "b 1 d h w"], largest: bool = False
    ) -> Float[Tensor, "b 1 e i x"]:
        """The mean, or the largest, value of each cell."""
        for _ in range(self.edge.bit_length() - 1):
            volume = max_pool3d(volume, 2, ceil_mode=True) if largest else halved(volume)
        return volume

    def _density(
        self,
        prior: Float[Tensor, "b m 1 D r s"],
        measured: Float[Tensor, "b 1 m r s"],
        placed: Float[Tensor, "b m c D r s"] | None,
    ) -> tuple[Float[Tensor, "b m 1 D r s"], list[Tensor]]:
        """The density of each frustum, and what else goes to the world."""
        frusta = self.inside.frusta
        if placed is None:
            even = self.transmission.attenuate(torch.ones_like(prior))
            return self.head(torch.zeros_like(prior), even, measured, frusta), []
        logits, rest = placed.split([1, placed.shape[2] - 1], dim=2)
        return self.head(logits, prior, measured, frusta), [rest]

    def _parts(self, carried: Float[Tensor, "b m c d h w"]) -> tuple[Tensor, ...]:
        """Change, confidence (none without a network that gives it) and features."""
        n_confidence = int(self.learned and self.weighting is not None)
        rest = carried.shape[2] - 1 - n_confidence
        return carried.split([1, n_confidence, rest], dim=2)

    def _logits(
        self,
        changes: Float[Tensor, "b m 3 d h w"],
        unexplained: Float[Tensor, "b 1 m r s"],
        x: Float[Tensor, "b 1 d h w"],
        confidence: Float[Tensor, "b m #k d h w"],
    ) -> Float[Tensor, "b m 1 d h w"]:
        """One logit for each voxel and camera, zeros without a network; of so many cameras at once
        that their features are no more than one volume.
        """
        if self.weighting is None:
            return torch.zeros_like(changes[:, :, :1])
        frusta = self.inside.frusta
        with torch.no_grad():  # a hint for the weights
            rest = frusta.to_world(self.transmission.spread(frusta, unexplained))
        volumes = x[:, None].expand(-1, changes.shape[1], -1, -1, -1, -1)
        small = MAGNIFIED * torch.cat([changes, rest], dim=2)
        evidence = torch.cat([small, volumes, confidence], dim=2)
        logits = [
            self.weighting(part.flatten(0, 1)).unflatten(0, part.shape[:2])
            for part in evidence.split(self.at_once, dim=1)
        ]
        return torch.cat(logits, dim=1) + confidence.sum(dim=2, keepdim=True)
