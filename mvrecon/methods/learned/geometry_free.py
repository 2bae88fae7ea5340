"""A network without camera geometry: the control of every model that uses it."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.methods.learned.geometry import validated
from mvrecon.methods.learned.network import network_by_name
from mvrecon.methods.learned.start import content_scale, nonzero, typical_chord
from mvrecon.methods.learned.unet import PlainUNet, Precision
from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.operators.operator import Projector


class GeometryFree(nn.Module):
    """A 3-D U-Net on the views as channels, each repeated along the depth of the grid, in the unit
    of (views / mm). The operator serves for the grid and the scale of the views only.

    Args:
        n_cameras: number of views.
        widths: channels of each scale of the U-Net, the finest first.
        network: name and options of another network in its place.
        precision: of the convolutions.
    """

    def __init__(
        self,
        n_cameras: int,
        widths: Sequence[int] = (18, 36, 72),
        network: Mapping[str, Any] | None = None,
        precision: Precision = "auto",
    ):
        super().__init__()
        self.n_cameras = n_cameras
        if network is None:
            self.network: nn.Module = PlainUNet(3, n_cameras, 1, widths, precision=precision)
        else:
            self.network = network_by_name(network, n_cameras, 1)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        if len(A.cameras) != self.n_cameras:
            raise ValueError(f"Expected {self.n_cameras} cameras, got {len(A.cameras)}")
        views = validated(views, A, next(self.network.parameters())).contiguous()
        chord = typical_chord(A.grid)
        scale = content_scale(views) / chord
        depth, *across = A.grid.shape
        flat = F.interpolate((views / scale)[:, 0] / chord, size=across, mode="bilinear")
        volume = self.network(flat[:, :, None].expand(-1, -1, depth, -1, -1))
        return Reconstruction(volume * scale * nonzero(views))
