"""Each camera's opinion, its own estimate of the volume: the lift, the statistics of the other
cameras, and the measured integrals placed along their rays.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.geometry import Geometry
from mvrecon.models.network import network_by_name
from mvrecon.models.networks import upsampled
from mvrecon.models.pooling import leave_one_out
from mvrecon.models.start import typical_chord
from mvrecon.parts import HEADS
from mvrecon.projectors.operator import Projector
from mvrecon.projectors.pixel_integral import sees_integrals

Prior = Literal["learned", "uniform"]

#: The depth network counts lengths in so many parts of the grid's own: numbers of the size that it
#: was tuned with.
PARTS = 128


@dataclass(frozen=True)
class DepthNetwork:
    """Where along a ray its measurement lies: the network of the cameras' opinions, and its frusta.

    Args:
        width: channels of the pixels' features, and of the depth U-Net's finest level where no
            network is named.
        features: channels that each camera hands on to the refinement besides its density.
        binning: detector pixels joined, along each axis, for the depth network.
        shared: one network for all cameras, or one for each.
        prior: "learned": network on top of the classical start; "uniform": no network, all depths
            equally likely.
        network: by name, `{"name": ..., **options}`; none for `UNet3d`.

    Raises:
        ValueError: an unknown prior; a network where "uniform" has none.
    """

    width: int = 8
    features: int = 4
    binning: int = 3
    shared: bool = True
    prior: Prior = "learned"
    network: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.prior not in ("learned", "uniform"):
            raise ValueError(f"depth prior must be 'learned' or 'uniform', got {self.prior!r}")
        if self.prior == "uniform" and self.network is not None:
            raise ValueError(f"prior='uniform' has no network, got {dict(self.network)}")


class Opinions(nn.Module):
    """M camera volumes from M views.

    The network works in frusta of binned pixels, since depth varies slowly across a detector; the
    head works at the detector's own resolution, so that in its frustum a fine view is met, to
    rounding.

    Args:
        projector: holds the grid and the rig.
        head: the head's name and options.
        depth: the network that places measurements along their rays.
    """

    def __init__(
        self,
        projector: Projector,
        head: Mapping[str, Any],
        depth: DepthNetwork,
    ):
        super().__init__()
        self.of_lines = sees_integrals(projector)
        self.binning, self.unit = depth.binning, typical_chord(projector.grid) / PARTS
        self.head = HEADS.from_config(head)
        self.learned = depth.prior == "learned"
        self.features = depth.features if self.learned else 0
        if self.learned:
            width = depth.width
            self.pixels = nn.Conv2d(2, width, depth.binning, stride=depth.binning)
            self.nets = nn.ModuleList(
                # the first answer, logits, is zero at the start: the prior alone
                network_by_name(depth.network, width + 6, 1 + depth.features, width, zero=1)
                for _ in range(1 if depth.shared else len(projector.cameras))
            )

    def forward(
        self,
        geometry: Geometry,
        views: Float[Tensor, "b 1 m v u"],
        start: Float[Tensor, "b 1 d h w"],
        residual: Float[Tensor, "b 1 m v u"],
    ) -> tuple[Float[Tensor, "b m 1 d h w"], Float[Tensor, "b m f d h w"]]:
        """Opinions and features in the world.

        Args:
            geometry: with frusta.
            views: measured.
            start: a classical reconstruction.
            residual: measured less the re-projected start.
        """
        fine = geometry.fine
        pixels, residual = (self._integrals(geometry, values) for values in (views, residual))
        prior = fine.to_frusta(start[:, None])
        if not self.learned:
            density = self.head(torch.zeros_like(prior), torch.ones_like(prior), pixels, fine)
            opinions = geometry.within(fine.to_world(density))
            return opinions, opinions[:, :, :0]
        answers = self._answers(geometry, torch.stack([pixels, residual], dim=3), start)
        density = self.head(_at_fine_bins(answers[:, :, :1], geometry), prior, pixels, fine)
        # The change is carried to the world, not the density: what the start holds already is not
        # blurred by two warps.
        change = fine.to_world(density - prior * fine.occupied)
        features = geometry.coarse.to_world(answers[:, :, 1:])
        return start[:, None] + geometry.within(change), geometry.within(features)

    def _integrals(
        self, geometry: Geometry, views: Float[Tensor, "b 1 m v u"]
    ) -> Float[Tensor, "b 1 m r s"]:
        """Views as line integrals in the frusta's pixels: of those in another unit, such as counts,
        the mean density of each ray, R y, times its chord.
        """
        fine = geometry.fine
        if self.of_lines:
            return fine.pixels(views)
        chord = fine.chord[..., 0, :, :].transpose(-4, -3)  # [*b 1 m v u]
        return fine.pixels(views) * fine.pixels(geometry.bounded_row) * chord

    def _answers(
        self, geometry: Geometry, pixels: Tensor, start: Tensor
    ) -> Float[Tensor, "b m f D v u"]:
        """The networks' answers in the coarse frusta, from the pixels [b 1 m 2 v u] of views and
        residuals.
        """
        coarse, (b, m) = geometry.coarse, (len(pixels), pixels.shape[2])
        binned = nn.functional.avg_pool2d(
            pixels[:, :, :, 0].flatten(0, 1), self.pixels.kernel_size
        ).unflatten(0, (b, 1))
        pixels = self.pixels(pixels.flatten(0, 2) / self.unit)  # [b*m c v u]
        pixels = pixels[:, :, None].expand(-1, -1, coarse.shape[0], -1, -1).unflatten(0, (b, m))
        lifted = coarse.spread(binned)
        world = geometry.within(coarse.to_world(lifted))
        mean, variance, _ = leave_one_out(world, coarse.visible)
        ours = start[:, None].expand(-1, m, -1, -1, -1, -1)
        others = coarse.to_frusta(torch.cat([mean, variance.sqrt(), ours], dim=2))
        where = coarse.occupied.expand(b, -1, -1, -1, -1, -1).to(pixels.dtype)
        inputs = torch.cat([pixels, lifted, others, where, where * coarse.depths(where)], dim=2)
        mask = coarse.occupied if geometry.masked else None
        if len(self.nets) == 1:
            mask = None if mask is None else mask.flatten(0, 1)
            return self.nets[0](inputs.flatten(0, 1), mask).unflatten(0, (b, m))
        masks = [None if mask is None else mask[:, k] for k in range(m)]
        nets = [self.nets[k] for k in geometry.cameras.tolist()]
        answers = [net(inputs[:, k], masks[k]) for k, net in enumerate(nets)]
        return torch.stack(answers, dim=1)


def _at_fine_bins(
    logits: Float[Tensor, "b m 1 e i x"], geometry: Geometry
) -> Float[Tensor, "b m 1 D v u"]:
    """Logits of coarse bins at the fine ones; by a mask's definition, from its bins alone."""
    flat, (fine, coarse) = logits.flatten(0, 1), (geometry.fine, geometry.coarse)
    if not geometry.masked:
        dense = nn.functional.interpolate(flat, size=fine.shape, mode="trilinear")
        return dense.unflatten(0, logits.shape[:2])
    mask, onto = (frusta.occupied.flatten(0, 1).to(flat.dtype) for frusta in (coarse, fine))
    return upsampled(flat, mask, onto, fine.shape).unflatten(0, logits.shape[:2])
