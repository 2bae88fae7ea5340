"""Each camera's opinion of the volume: lift, listen to the others, place the measured integrals along their rays."""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.cross_view import leave_one_out
from mvrecon.models.lift import Frusta
from mvrecon.models.unet3d import UNet3d
from mvrecon.parts import HEADS
from mvrecon.projectors.base import Projector

Prior = Literal["learned", "uniform"]


class Opinions(nn.Module):
    """M camera volumes from M views.

    The network works in frusta of binned pixels, since depth varies slowly across a detector; the head works at the
    detector's own resolution, so that a fine view is met exactly.

    Args:
        projector: holds the grid and the rig.
        head: the head's name and options.
        width: channels of the depth U-Net's finest level.
        features: channels that each camera hands on to the refinement besides its density.
        binning: detector pixels joined, along each axis, for the depth U-Net.
        shared: one U-Net for all cameras, or one for each.
        prior: "learned": U-Net on top of the classical start; "uniform": no network, all depths equally likely.
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
        grid, cameras = projector.grid, projector.cameras
        depth = max(grid.shape)
        self.fine = Frusta(grid, cameras, depth)
        self.coarse = Frusta(grid, cameras.binned(binning), depth // 2)
        self.head = HEADS.from_config(head)
        self.learned = prior == "learned"
        self.features = features if self.learned else 0
        if self.learned:
            self.pixels = nn.Conv2d(2, width, binning, stride=binning)
            nets = [UNet3d(width + 6, 1 + features, width) for _ in range(1 if shared else len(cameras))]
            for net in nets:
                nn.init.zeros_(net.last.weight[:1])  # start from the prior
            self.nets = nn.ModuleList(nets)

    def forward(
        self, views: Float[Tensor, "b 1 m v u"], start: Float[Tensor, "b 1 d h w"], residual: Float[Tensor, "b 1 m v u"]
    ) -> tuple[Float[Tensor, "b m 1 d h w"], Float[Tensor, "b m f d h w"]]:
        """Opinions and features in the world.

        Args:
            views: measured.
            start: a classical reconstruction.
            residual: measured less the re-projected start.
        """
        prior = self.fine.to_frusta(start[:, None])
        if not self.learned:
            density = self.head(torch.zeros_like(prior), torch.ones_like(prior), views, self.fine)
            opinions = self.fine.to_world(density)
            return opinions, opinions[:, :, :0]
        answer = self._listen(views, start, residual)  # [b m 1+f D v u], coarse
        logits = nn.functional.interpolate(answer[:, :, :1].flatten(0, 1), size=self.fine.shape, mode="trilinear")
        density = self.head(logits.unflatten(0, answer.shape[:2]), prior, views, self.fine)
        # The change is carried to the world, not the density: what the start holds already is not blurred by two warps.
        change = self.fine.to_world(density - prior * self.fine.occupied)
        return start[:, None] + change, self.coarse.to_world(answer[:, :, 1:])

    def _listen(self, views: Tensor, start: Tensor, residual: Tensor) -> Float[Tensor, "b m f D v u"]:
        b, _, m = views.shape[:3]
        pixels = self.pixels(torch.stack([views, residual], dim=3).flatten(0, 2))  # [b*m c v u]
        pixels = pixels[:, :, None].expand(-1, -1, self.coarse.shape[0], -1, -1).unflatten(0, (b, m))
        binned = nn.functional.avg_pool2d(views.flatten(0, 1), self.pixels.kernel_size).unflatten(0, (b, 1))
        lifted = self.coarse.spread(binned)
        world = self.coarse.to_world(lifted)
        mean, variance, _ = leave_one_out(world, self.coarse.visible)
        ours = start[:, None].expand(-1, m, -1, -1, -1, -1)
        others = self.coarse.to_frusta(torch.cat([mean, variance.sqrt(), ours], dim=2))
        where = self.coarse.occupied.expand(b, -1, -1, -1, -1, -1).to(views.dtype)
        ramp = torch.linspace(-1, 1, where.shape[3], device=views.device, dtype=views.dtype)
        depth = where * ramp[:, None, None]
        inputs = torch.cat([pixels, lifted, others, where, depth], dim=2)
        if len(self.nets) == 1:
            return self.nets[0](inputs.flatten(0, 1)).unflatten(0, (b, m))
        return torch.stack([net(inputs[:, k]) for k, net in enumerate(self.nets)], dim=1)
