"""The cross-view model: per-view estimates from a depth network in each camera's frustum, compared
by re-projection into the other cameras' frames, fused by a weighting network; rays count by their
camera's weights along them and by a 2-D U-Net on their view, which also corrects the view.

`docs/model.md` lists the steps of `CrossView.forward`.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.core.numbers import divided
from mvrecon.core.parts import HEADS, WEIGHTINGS, HeadPart, WeightingPart
from mvrecon.core.quantities import NonNegativeInt
from mvrecon.core.registry import check_choice
from mvrecon.geometry.grid import Box, bounds, placed
from mvrecon.methods.learned.geometry import Geometry, geometry_of, validated
from mvrecon.methods.learned.start import (
    ClassicalStart,
    Consistency,
    Start,
    Steps,
    normalised,
    reweighted,
)
from mvrecon.methods.learned.unet import PlainUNet, Precision
from mvrecon.methods.learned.view_frames import (
    ViewFrames,
    coarsened,
    deviation,
    fuse,
    images,
    leave_one_out,
    pooled,
)
from mvrecon.methods.learned.weightings import CHANNELS
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.operators.visual_hull.support import SUPPORT_KINDS, ViewNoise

#: Gain of residuals, which are small relative to the views, at a network's input; its inverse is
#: that of changes of views at a network's output.
RESIDUAL_GAIN = 8.0
#: Density of an empty voxel in the mean along a ray, relative to the content's scale.
EMPTY_DENSITY = 0.01
#: Learning-rate factor of the strength of the rays' weights, a scalar that should converge within
#: the first tenth of a training.
STRENGTH_RATE_FACTOR = 10.0
#: Learning-rate factor of the logits of single rays.
RAY_LOGIT_RATE_FACTOR = 4.0
#: Margin in voxels around the support's box for the volume network; its bounds are multiples of it,
#: so that coarse voxels keep their positions.
BOX_MARGIN, BOX_MULTIPLE = 4, 8


class CrossView(nn.Module):
    """Cross-view reconstruction, in the unit of (views / mm).

    Inputs are normalised by the intensity scale, f(a y) = a f(y). The weights hold no geometry: any
    rig, grid and operator will do.

    Args:
        widths: channels of each scale of the volume network, the finest first.
        depth_widths: the same for the depth network in the frusta; none for no depth network, thus
            neither a confidence nor features, with depths that are not learned.
        weight_widths: the same for the weighting network, if it has an option `widths`.
        ray_widths: the same for the 2-D U-Net that weights and corrects single rays, see `RayUNet`;
            none: rays count by their camera's weights alone.
        features: channels passed from the depth network to the volume network.
        scale: halvings of the grid at which per-view estimates are computed.
        depths: bins along each ray.
        binning: pixels of a frustum's cell along each axis.
        head: name, or name and options, of the head that turns logits of depth into densities.
        fusion: "weighted" by the weighting network, or the "mean" over the cameras.
        weighting: name, or name and options, of the weighting network.
        depth: density along each ray by "learned" logits, as the start ("prior") or "uniform";
            with the last two the depth network gives confidence and features alone.
        shared: one depth network for all cameras, or one for each.
        n_cameras: number of cameras if the depth network is not shared.
        weigh_rays: weight a ray's residual by its camera's weights along it and by `RayUNet`.
        start: iterations of SIRT with momentum, or name and options of a classical method.
        reweight: further iterations of SIRT, in which rays count by their weights, before the
            volume network; None: 12 for line integrals, none for counts.
        consistency: number of data-consistency steps at the end, or options of `Consistency`; for
            counts `{steps: 3, noise: poisson, rule: em}`.
        support: voxels that the views do not show to be empty: the visual "hull", its "box", "auto"
            or "none".
        noise: noise of the views, for the support, as in `support_from_views`.
        crop: confine the volume network to the box around the support.
        precision: precision of the convolutions.

    Raises:
        ValueError: an unknown choice, a network without scales, unshared networks without
            `n_cameras`, a crop without a support, or `reweight` for counts.
    """

    def __init__(
        self,
        widths: Sequence[int] = (16, 32, 64),
        depth_widths: Sequence[int] = (8, 16),
        weight_widths: Sequence[int] | None = None,
        ray_widths: Sequence[int] = (8, 16, 32),
        features: int = 4,
        scale: int = 2,
        depths: int = 8,
        binning: int = 6,
        head: str | HeadPart = "softmax_depth",
        fusion: Literal["weighted", "mean"] = "weighted",
        weighting: str | WeightingPart = "unet",
        depth: Literal["learned", "prior", "uniform"] = "learned",
        shared: bool = True,
        n_cameras: int | None = None,
        weigh_rays: bool = True,
        start: Start = 12,
        reweight: NonNegativeInt | None = None,
        consistency: Steps = 3,
        support: str = "none",
        noise: ViewNoise | None = None,
        crop: bool = False,
        precision: Precision = "auto",
    ):
        super().__init__()
        check_choice("fusion", fusion, ("weighted", "mean"))
        check_choice("support", support, SUPPORT_KINDS)
        if not 0 <= scale < len(widths):
            raise ValueError(f"Expected scale below the {len(widths)} of widths, got {scale}")
        if crop and support == "none":
            raise ValueError("Expected a support to crop to, got crop=True and support='none'")
        self.estimates = PerViewEstimates(
            depth_widths, features, scale, depths, binning, head, depth,
            None if shared else n_cameras or 0, precision,
        )  # fmt: skip
        self.weight_net = None
        if fusion == "weighted":
            inputs = len(CHANNELS) if depth_widths else len(CHANNELS) - 1  # the confidence
            self.weight_net = weighting_network(weighting, inputs, weight_widths, precision)
        self.scale = scale
        self.entry = nn.Conv3d(2 + self.estimates.features, widths[scale], 1, bias=False)
        nn.init.zeros_(self.entry.weight)  # before training: SIRT
        self.volume_net = PlainUNet(3, 3, 1, widths, zero=1, precision=precision)
        self.step = nn.Parameter(torch.ones(()))
        unequal = weigh_rays and fusion == "weighted"
        self.log_strength = nn.Parameter(torch.zeros(())) if unequal else None
        self.consistency = Consistency(consistency)
        self.ray_net = None
        if weigh_rays and ray_widths:
            self.ray_net = RayUNet(ray_widths, not self.consistency.poisson, precision)
        self.reweight = (0 if self.consistency.poisson else 12) if reweight is None else reweight
        if self.reweight < 0 or (self.reweight and self.consistency.poisson):
            raise ValueError(
                f"Expected reweight of 0 or more, and of 0 for counts, got {reweight} with "
                f"consistency {consistency}"
            )
        self.start = ClassicalStart(start)
        self.support, self.noise, self.crop = support, noise, crop

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.step)
        g = geometry_of(y, A, self.support, self.noise)
        frames = self.estimates.frames(g)

        y, start, scale = normalised(g, y, self.start, self.training)
        projected = A(start)
        r = y - projected
        change, confidence, features, missed = self.estimates(frames, g, y, r, start)
        others, variance, _ = leave_one_out(change, frames.visible)
        predicted = frames.project(frames.to_frames(others))  # re-projection

        coarse = coarsened(start, self.scale)
        unexplained = frames.spread(missed - predicted).detach()
        compared = [change, others, deviation(variance), frames.to_volume(unexplained)]
        compared = torch.cat(compared, 2)
        logits = self.weight_logits(compared, coarse, confidence, frames.visible)
        fused, weights = fuse(torch.cat([change, features], 2), logits, frames.visible)
        ray_weights = self.ray_weights(frames, coarse, weights, y)
        corrected = y
        if self.ray_net is not None:
            factors, corrected = self.ray_net(g, y, r)
            ray_weights = ray_weights * factors

        x = start
        if self.reweight:
            x = reweighted(g, start, corrected, ray_weights, self.reweight)
        r = corrected - (A(x) if self.reweight else projected)
        d = g.direction(r, ray_weights)
        _, spread = pooled(change, frames.visible)
        update = fused[:, :1] - (coarsened(x, self.scale) - coarse)
        fused = [RESIDUAL_GAIN * update, RESIDUAL_GAIN * deviation(spread)[:, 0], fused[:, 1:]]
        learned = self.learned_change(g, x, d, torch.cat(fused, 1))
        entry = x + g.within(learned + self.step * d)
        x = self.consistency(g, entry, corrected, ray_weights).clamp_min(0)
        return Reconstruction(
            x * scale,
            per_view=(coarse[:, None] + change) * scale[:, None],
            visible=frames.visible,
            weights=weights,
            ray_weights=ray_weights if isinstance(ray_weights, Tensor) else None,
            predictions=frames.views(predicted + frames.integrals(projected)) * scale,
            binned_views=frames.views(frames.integrals(y)) * scale,
            support=g.support,
            start=start * scale,
            entry=entry * scale if self.consistency.em else None,
        )

    def weight_logits(
        self,
        compared: Float[Tensor, "b m 4 e i x"],
        x: Float[Tensor, "b 1 e i x"],
        confidence: Float[Tensor, "b m k e i x"],
        visible: Bool[Tensor, "m 1 e i x"],
    ) -> Float[Tensor, "b m 1 e i x"]:
        """Return a logit for each camera and cell; zeros without a weighting network.

        Raises:
            ValueError: logits of another shape from the weighting network.
        """
        volumes = x[:, None].expand_as(compared[:, :, :1])
        if self.weight_net is None:
            return torch.zeros_like(volumes)
        inputs = torch.cat([RESIDUAL_GAIN * compared, volumes, confidence], dim=2)
        logits = self.weight_net(inputs, visible)
        if logits.shape != volumes.shape:
            shapes = f"{list(volumes.shape)} from {self.weight_net}, got {list(logits.shape)}"
            raise ValueError(f"Expected logits {shapes}")
        return logits + confidence.sum(dim=2, keepdim=True)

    def ray_weights(
        self,
        frames: ViewFrames,
        x: Float[Tensor, "b 1 e i x"],
        weights: Float[Tensor, "b m 1 e i x"],
        like: Float[Tensor, "b 1 m v u"],
    ) -> Float[Tensor, "b 1 m v u"] | float:
        """Mean along each ray of its camera's weight relative to uniform weights, with a learned
        strength.
        """
        if self.log_strength is None:
            return 1.0
        density = (x.clamp_min(0) + EMPTY_DENSITY)[:, None] * frames.visible
        relative = weights * frames.visible.sum(dim=0)
        ratio = frames.mean_along_rays(relative, density, like)
        return (1 + (STRENGTH_RATE_FACTOR * self.log_strength).exp() * (ratio - 1)).clamp_min(0)

    def learned_change(
        self,
        g: Geometry,
        x: Float[Tensor, "b 1 d h w"],
        d: Float[Tensor, "b 1 d h w"],
        fused: Float[Tensor, "b k e i x"],
    ) -> Float[Tensor, "b 1 d h w"]:
        """The volume network's change of x, with `crop` in the box around each sample's support."""
        hull = torch.ones_like(x) if g.support is None else g.support.to(x)
        inputs, coarse = torch.cat([x, RESIDUAL_GAIN * d, hull], 1), self.entry(fused)
        if g.support is None or not self.crop:
            return self.volume_net(inputs, {self.scale: coarse})
        changes = []
        for i, box in enumerate(boxes_of(g.support)):
            edge = 2**self.scale
            cells = [slice(s.start // edge, -(-s.stop // edge)) for s in box.slices]
            part = {self.scale: coarse[i : i + 1, :, *cells]}
            change = self.volume_net(inputs[i : i + 1, :, *box.slices], part)
            changes.append(placed(change, box, x.shape[2:]))
        return torch.cat(changes)


def weighting_network(
    weighting: str | WeightingPart, inputs: int, widths: Sequence[int] | None, precision: Precision
) -> nn.Module:
    """Build a weighting network by name.

    Args:
        weighting: name, or name and options.
        inputs: channels of a camera.
        widths, precision: passed as options to a network that has them, unless among its options;
            None: not passed.

    Raises:
        LookupError: an unknown name.
        TypeError: a mapping without a name, or an unknown option.
    """
    config = {"name": weighting} if isinstance(weighting, str) else weighting
    WEIGHTINGS.check(config)
    shared = {"precision": precision} | ({} if widths is None else {"widths": widths})
    shared = {key: value for key, value in shared.items() if WEIGHTINGS.takes(config["name"], key)}
    return WEIGHTINGS.from_config({**shared, **config}, inputs)


class PerViewEstimates(nn.Module):
    """Depth network and head: each camera's change of a volume, from its view alone.

    Without widths there is no depth network, thus no confidence and no features.

    Args:
        widths, features, scale, depths, binning, head, depth, precision: see `CrossView`.
        n_cameras: one network for each of so many cameras; None: one for all.

    Raises:
        ValueError: an unknown `depth`, or a missing number of cameras.
    """

    def __init__(
        self,
        widths: Sequence[int],
        features: int,
        scale: int,
        depths: int,
        binning: int,
        head: str | HeadPart,
        depth: str = "learned",
        n_cameras: int | None = None,
        precision: Precision = "auto",
    ):
        super().__init__()
        check_choice("depth", depth, ("learned", "prior", "uniform"))
        if n_cameras is not None and n_cameras < 1:
            raise ValueError("Expected n_cameras for networks that are not shared, got none")
        if depth == "learned" and not widths:
            raise ValueError(f"Expected depth_widths of a scale for learned depths, got {widths}")
        self.cut, self.n_cameras = (scale, binning, depths), n_cameras if widths else None
        self.binning, self.depth = binning, depth
        self.features = features if widths else 0
        self.head = HEADS.from_config({"name": head} if isinstance(head, str) else head)

        def image() -> nn.Module:
            return nn.Conv2d(3 * binning**2, widths[0], 1)

        def unet() -> nn.Module:
            inputs, outputs = widths[0] + 4, 2 + features
            return PlainUNet(3, inputs, outputs, widths, zero=2, precision=precision)

        self.has_network = bool(widths)
        if self.has_network:
            self.image, self.unet = for_cameras(n_cameras, image), for_cameras(n_cameras, unet)

    def frames(self, g: Geometry) -> ViewFrames:
        """The frames of an operator's cameras, with these bins and cells.

        Raises:
            ValueError: a number of cameras other than that of the networks.
        """
        if self.n_cameras not in (None, len(g.A.cameras)):
            raise ValueError(f"Expected {self.n_cameras} cameras, got {len(g.A.cameras)}")
        return ViewFrames.of(g, *self.cut)

    def forward(
        self,
        frames: ViewFrames,
        g: Geometry,
        y: Float[Tensor, "b 1 m v u"],
        r: Float[Tensor, "b 1 m v u"],
        x: Float[Tensor, "b 1 d h w"],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the change of the volume, logits of confidence and features of each camera [b m c
        e i x], and its residual as integrals [b 1 m r s]; without a depth network, confidence and
        features have no channels.

        Args:
            frames: depth frames of the cameras.
            g: the operator and SIRT's weights.
            y, r: views and residual views.
            x: the volume.
        """
        frusta, coarse = frames.frusta, coarsened(x, frames.scale)
        prior = frames.to_frames(coarse)
        missed = frames.integrals(r)
        logits, rest = torch.zeros_like(prior), prior[:, :, :0]
        if self.has_network:
            d = coarsened(RESIDUAL_GAIN * g.direction(r), frames.scale)
            along = frusta.to_frusta(torch.cat([coarse, d], 1)[:, None])
            outputs = self._logits(frames, g.row * y, g.row * r, along)
            rest = outputs[:, :, 1:]
            logits = outputs[:, :, :1] if self.depth == "learned" else logits
        shape = torch.ones_like(prior) if self.depth == "uniform" else prior
        density = self.head(logits, shape, frames.project(prior) + missed, frusta)
        if density.shape != prior.shape:
            shapes = f"{list(prior.shape)} from {self.head}, got {list(density.shape)}"
            raise ValueError(f"Expected a density {shapes}")
        # warps the change: two warps of the density would blur it
        carried = frames.to_volume(torch.cat([frames.emitted(density - prior), rest], 2))
        channels = [1, rest.shape[2] - self.features, self.features]
        change, confidence, features = carried.split(channels, 2)
        return change, confidence, features, missed

    def _logits(
        self,
        frames: ViewFrames,
        measured: Float[Tensor, "b 1 m v u"],
        residual: Float[Tensor, "b 1 m v u"],
        along: Float[Tensor, "b m 2 D r s"],
    ) -> Float[Tensor, "b m k D r s"]:
        """Run the depth network: logits of depth, logits of confidence, features."""
        frusta, (b, m) = frames.frusta, along.shape[:2]
        smooth = F.avg_pool2d(measured[:, 0], 3, stride=1, padding=1, count_include_pad=False)
        sharp = measured - smooth[:, None]
        seen = torch.cat([RESIDUAL_GAIN * residual, measured, RESIDUAL_GAIN * sharp], dim=1)
        cells = images(seen, frames.binning)
        missing = self.binning**2 * 3 - cells.shape[2]  # on a detector smaller than a cell
        cells = F.pad(cells, (0, 0, 0, 0, 0, missing)).flatten(0, 1)
        image = self.image(cells)[:, :, None].expand(-1, -1, frusta.shape[0], -1, -1)
        occupied = frusta.occupied.to(along)
        where = torch.cat([occupied, occupied * frusta.depths(occupied)], 1)
        inputs = torch.cat([along, where.expand(b, -1, -1, -1, -1, -1)], 2).flatten(0, 1)
        return self.unet(torch.cat([image, inputs], 1)).unflatten(0, (b, m))


class RayUNet(PlainUNet):
    """A 2-D U-Net on each view, at the detector's resolution and with the same parameters for all
    cameras: the weight of each ray relative to the others of its view, 2 sigmoid(logit), and a
    change of its value. The change can remove an additive error of a whole view, such as smooth
    scatter; a weight can only discard the view.

    The mean logit of the rays that meet the region is subtracted for each view, so that a factor
    says nothing about its camera, whose weights are those of `CrossView.ray_weights`. All factors
    are one and all changes zero before training.

    Args:
        widths: channels of each scale, the finest first.
        corrects: whether values are changed; not for counts, which are to be conserved.
        precision: precision of the convolutions.
    """

    def __init__(self, widths: Sequence[int], corrects: bool, precision: Precision = "auto"):
        outputs = 1 + corrects
        super().__init__(2, 2, outputs, widths, zero=outputs, precision=precision)
        self.last.bias = None  # the logits' mean is subtracted, and air reads zero

    def forward(
        self, g: Geometry, y: Float[Tensor, "b 1 m v u"], r: Float[Tensor, "b 1 m v u"]
    ) -> tuple[Float[Tensor, "b 1 m v u"], Float[Tensor, "b 1 m v u"]]:
        """Return the factors and the corrected views of views and residual views."""
        seen = torch.cat([g.row * y, RESIDUAL_GAIN * g.row * r], dim=1).transpose(1, 2)
        answer = super().forward(seen.flatten(0, 1)).unflatten(0, seen.shape[:2]).transpose(1, 2)
        logits, change = answer.tensor_split([1], dim=1)  # no change of counts
        reached = (g.row > 0).expand_as(logits)
        sums = (logits * reached).sum(dim=(3, 4), keepdim=True)
        mean = sums / reached.sum(dim=(3, 4), keepdim=True).clamp_min(1)
        factors = 2 * (RAY_LOGIT_RATE_FACTOR * (logits - mean)).sigmoid()
        return factors, y + divided(change / RESIDUAL_GAIN, g.row).sum(dim=1, keepdim=True)


class OneEach(nn.Module):
    """One network per camera, applied to images or volumes ordered by camera within each sample."""

    def __init__(self, count: int, make: Callable[[], nn.Module]):
        super().__init__()
        self.networks = nn.ModuleList(make() for _ in range(count))

    def forward(self, x: Float[Tensor, "n i *d"]) -> Float[Tensor, "n o *d"]:
        parts = x.unflatten(0, (-1, len(self.networks))).unbind(1)
        pairs = zip(self.networks, parts, strict=True)
        return torch.stack([network(part) for network, part in pairs], dim=1).flatten(0, 1)


def for_cameras(count: int | None, make: Callable[[], nn.Module]) -> nn.Module:
    """One network for all cameras, or one for each of so many."""
    return make() if count is None else OneEach(count, make)


def boxes_of(support: Bool[Tensor, "b 1 d h w"]) -> list[Box]:
    """The box around each sample's support, with a margin and bounds divisible for the networks;
    the whole grid for an empty support.
    """
    shape = support.shape[2:]
    boxes = [Box.of(numbers) for numbers in bounds(support[:, 0]).tolist()]
    boxes = [box.grown(BOX_MARGIN, shape).aligned(BOX_MULTIPLE, shape) for box in boxes]
    return [box if box.size else Box.whole(shape) for box in boxes]
