"""The baseline without cameras' frames: one 3-D U-Net on a classical reconstruction."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.registry import check_choice
from mvrecon.methods.learned.consistency import Consistency, Steps
from mvrecon.methods.learned.cross_view import GAIN
from mvrecon.methods.learned.geometry import geometry_of, validated
from mvrecon.methods.learned.network import network_by_name
from mvrecon.methods.learned.start import ClassicalStart, Start, normalised
from mvrecon.methods.learned.unet import PlainUNet, Precision
from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.operators.visual_hull.support import KINDS


class WorldUNet(nn.Module):
    """A 3-D U-Net changes a classical reconstruction; then data-consistency steps and
    non-negativity, in the unit of (views / mm).

    Args:
        widths: channels of each scale of the U-Net, the finest first.
        network: name and options of another network in its place.
        start: iterations of SIRT with momentum, or name and options of a classical method.
        consistency: number of data-consistency steps at the end, or options of `Consistency`.
        support: where the density may differ from zero, by the views: the visual "hull", its "box",
            "auto" or "none".
        noise: of the views, for the support, as of `support_from_views`.
        precision: of the convolutions.

    Raises:
        ValueError: an unknown support.
    """

    def __init__(
        self,
        widths: Sequence[int] = (18, 36, 72),
        network: Mapping[str, Any] | None = None,
        start: Start = 12,
        consistency: Steps = 3,
        support: str = "none",
        noise: Mapping[str, Any] | None = None,
        precision: Precision = "auto",
    ):
        super().__init__()
        check_choice("support", support, KINDS)
        if network is None:
            self.network: nn.Module = PlainUNet(3, 3, 1, widths, zero=1, precision=precision)
        else:
            self.network = network_by_name(network, 3, 1, zero=1)
        self.step = nn.Parameter(torch.ones(()))
        self.consistency = Consistency(consistency)
        self.start = ClassicalStart(start, counts=self.consistency.poisson)
        self.support, self.noise = support, noise

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        y = validated(views, A, self.step)
        g = geometry_of(y, A, self.support, self.noise)
        y, start, scale = normalised(g, y, self.start, self.training)
        d = g.direction(y - A(start))
        hull = torch.ones_like(start) if g.support is None else g.support.to(start)
        change = self.network(torch.cat([start, GAIN * d, hull], dim=1)) + self.step * d
        entry = start + g.within(change)
        x = self.consistency(g, entry, y).clamp_min(0)
        return Reconstruction(
            x * scale,
            support=g.support,
            start=start * scale,
            entry=entry * scale if self.consistency.em else None,
        )
