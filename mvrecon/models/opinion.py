"""Each camera's opinion of the volume: lift, listen to the others, place the measured integrals
along their rays.
"""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.bins import Bins
from mvrecon.models.consistency import typical_chord
from mvrecon.models.cross_view import leave_one_out
from mvrecon.models.masks import upsampled
from mvrecon.models.region import Region
from mvrecon.models.unet3d import UNet3d
from mvrecon.parts import HEADS
from mvrecon.projectors.operator import Projector

Prior = Literal["learned", "uniform"]

#: The depth network counts lengths in so many parts of the grid's own: numbers of the size that it
#: was tuned with.
PARTS = 128


class Opinions(nn.Module):
    """M camera volumes from M views.

    The network works in frusta of binned pixels, since depth varies slowly across a detector; the
    head works at the detector's own resolution, so that in its frustum a fine view is met, to
    rounding.

    Args:
        projector: holds the grid and the rig.
        head: the head's name and options.
        width: channels of the depth U-Net's finest level.
        features: channels that each camera hands on to the refinement besides its density.
        binning: detector pixels joined, along each axis, for the depth U-Net.
        shared: one U-Net for all cameras, or one for each.
        prior: "learned": U-Net on top of the classical start; "uniform": no network, all depths
            equally likely.
    """

    def __init__(
        self,
        projector: Projector,
        head: Mapping[str, Any],
        width: int = 8,
        features: int = 4,
        binning: int = 3,
        shared: bool = True,
        prior: Prior = "learned",
    ):
        super().__init__()
        if prior not in ("learned", "uniform"):
            raise ValueError(f"depth prior must be 'learned' or 'uniform', got {prior!r}")
        self.binning, self.unit = binning, typical_chord(projector.grid) / PARTS
        self.head = HEADS.from_config(head)
        self.learned = prior == "learned"
        self.features = features if self.learned else 0
        if self.learned:
            self.pixels = nn.Conv2d(2, width, binning, stride=binning)
            nets = [
                UNet3d(width + 6, 1 + features, width)
                for _ in range(1 if shared else len(projector.cameras))
            ]
            for net in nets:
                nn.init.zeros_(net.last.weight[:1])  # start from the prior
            self.nets = nn.ModuleList(nets)

    def forward(
        self,
        region: Region,
        views: Float[Tensor, "b 1 m v u"],
        start: Float[Tensor, "b 1 d h w"],
        residual: Float[Tensor, "b 1 m v u"],
    ) -> tuple[Float[Tensor, "b m 1 d h w"], Float[Tensor, "b m f d h w"]]:
        """Opinions and features in the world.

        Args:
            region: where in the world.
            views: measured.
            start: a classical reconstruction.
            residual: measured less the re-projected start.
        """
        frusta, (fine, coarse) = region.geometry.fine, region.bins()
        seen = frusta.part_of(views)
        prior = frusta.to_frusta(start[:, None])
        if not self.learned:
            density = self.head(torch.zeros_like(prior), torch.ones_like(prior), seen, fine)
            opinions = region.within(frusta.to_world(density))
            return opinions, opinions[:, :, :0]
        answer = self._listen(
            region, coarse, torch.stack([seen, frusta.part_of(residual)], dim=3), start
        )
        density = self.head(_refined(answer[:, :, :1], region, coarse, fine), prior, seen, fine)
        # The change is carried to the world, not the density: what the start holds already is not
        # blurred by two warps.
        change = frusta.to_world(density - prior * fine.occupied)
        features = region.geometry.coarse.to_world(answer[:, :, 1:])
        return start[:, None] + region.within(change), region.within(features)

    def _listen(
        self, region: Region, bins: Bins, pixels: Tensor, start: Tensor
    ) -> Float[Tensor, "b m f D v u"]:
        """The networks' answers in the coarse frusta, from the pixels [b 1 m 2 v u] of views and
        residuals.
        """
        coarse, (b, m) = region.geometry.coarse, (len(pixels), pixels.shape[2])
        binned = nn.functional.avg_pool2d(
            pixels[:, :, :, 0].flatten(0, 1), self.pixels.kernel_size
        ).unflatten(0, (b, 1))
        pixels = self.pixels(pixels.flatten(0, 2) / self.unit)  # [b*m c v u]
        pixels = pixels[:, :, None].expand(-1, -1, coarse.shape[0], -1, -1).unflatten(0, (b, m))
        lifted = bins.spread(binned)
        world = region.within(coarse.to_world(lifted))
        mean, variance, _ = leave_one_out(world, coarse.visible)
        ours = start[:, None].expand(-1, m, -1, -1, -1, -1)
        others = coarse.to_frusta(torch.cat([mean, variance.sqrt(), ours], dim=2))
        where = bins.occupied.expand(b, -1, -1, -1, -1, -1).to(pixels.dtype)
        inputs = torch.cat([pixels, lifted, others, where, where * coarse.ramp(where)], dim=2)
        mask = bins.occupied if region.seen_by_nets else None
        if len(self.nets) == 1:
            mask = None if mask is None else mask.flatten(0, 1)
            return self.nets[0](inputs.flatten(0, 1), mask).unflatten(0, (b, m))
        each = [None if mask is None else mask[:, k] for k in range(m)]
        nets = [self.nets[k] for k in region.geometry.views.tolist()]
        answers = [net(inputs[:, k], each[k]) for k, net in enumerate(nets)]
        return torch.stack(answers, dim=1)


def _refined(
    logits: Tensor, region: Region, coarse: Bins, fine: Bins
) -> Float[Tensor, "b m 1 D v u"]:
    """Logits of coarse bins at the fine ones; by a mask's definition, from its bins alone."""
    flat, size = logits.flatten(0, 1), region.geometry.fine.shape
    if region.seen_by_nets:
        held, onto = (bins.occupied.flatten(0, 1).to(flat.dtype) for bins in (coarse, fine))
        return upsampled(flat, held, onto, size).unflatten(0, logits.shape[:2])
    return nn.functional.interpolate(flat, size=size, mode="trilinear").unflatten(
        0, logits.shape[:2]
    )
