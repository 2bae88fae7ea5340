"""What the cross-view model is held against: plain means, a single world U-Net, and methods without training."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.consistency import Consistency, content_scale
from mvrecon.models.model import CrossView
from mvrecon.models.output import Reconstruction
from mvrecon.models.unet3d import UNet3d
from mvrecon.projectors.base import Projector, check_views
from mvrecon.reconstruct.iterative import sirt


class MeanFusion(CrossView):
    """The mean of the M cameras' networks, as first proposed: no weighting, no refinement.

    Args:
        projector, head, opinion, start, consistency: as in `CrossView`.
    """

    def __init__(
        self,
        projector: Projector,
        head: Mapping[str, Any],
        opinion: Mapping[str, Any] | None = None,
        start: int = 12,
        consistency: int = 3,
    ):
        super().__init__(projector, head, opinion, fusion="mean", refine=0, start=start, consistency=consistency)


class BackprojectionUNet(nn.Module):
    """One 3-D U-Net in the world on the summed back-projection and a few SIRT iterations, then consistency steps.

    Args:
        projector: holds the grid and the rig.
        width: channels of the finest level.
        start: SIRT iterations of the classical start.
        consistency: learned gradient steps towards the data at the end.
    """

    def __init__(self, projector: Projector, width: int = 18, start: int = 12, consistency: int = 3):
        super().__init__()
        self.projector = projector
        self.iterations = start
        self.net = UNet3d(3, 1, width, zero=True)
        self.consistency = Consistency(projector, consistency)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        y, x0, scale = self.consistency.normalised(views, self.iterations)
        seen = torch.cat([x0, self.consistency.back(y), self.consistency.residual(x0, y)], dim=1)
        return Reconstruction(volume=self.consistency(x0 + self.net(seen), y) * scale)


class GeometryFree(nn.Module):
    """A U-Net that is told nothing of the cameras: M views as channels, each repeated along depth in its own frame.

    It is what `BackprojectionUNet` would be without known geometry; the rig serves only for the views' scale.

    Args:
        projector: holds the grid and the rig.
        width: channels of the finest level.
    """

    def __init__(self, projector: Projector, width: int = 18):
        super().__init__()
        self.projector = projector
        self.chord = max(projector.grid.shape) * min(projector.grid.spacing)
        self.net = UNet3d(len(projector.cameras), 1, width)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        check_views(views, self.projector.cameras)
        scale = content_scale(views) / self.chord
        depth, *across = self.projector.grid.shape
        flat = nn.functional.interpolate((views / scale)[:, 0] / self.chord, size=across, mode="bilinear")
        return Reconstruction(volume=self.net(flat[:, :, None].expand(-1, -1, depth, -1, -1)) * scale)


class Sirt(nn.Module):
    """SIRT with non-negativity; nothing to train.

    Args:
        projector: holds the grid and the rig.
        iterations: how many.
    """

    def __init__(self, projector: Projector, iterations: int = 50):
        super().__init__()
        self.projector = projector
        self.iterations = iterations

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        check_views(views, self.projector.cameras)
        return Reconstruction(volume=sirt(self.projector, views, self.iterations))


class Backprojection(nn.Module):
    """The summed back-projection, each ray's mean density spread along it; nothing to train.

    Args:
        projector: holds the grid and the rig.
    """

    def __init__(self, projector: Projector):
        super().__init__()
        self.consistency = Consistency(projector, 0)

    def forward(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        check_views(views, self.consistency.projector.cameras)
        return Reconstruction(volume=self.consistency.back(views))
