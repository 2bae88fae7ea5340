"""Frusta over a crop of the grid: some bins of the whole frusta, with all that is known of them
taken over.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.box import Box
from mvrecon.geometry.grid import Grid
from mvrecon.models.lift import Frusta
from mvrecon.models.window import Window


class CroppedFrusta(Frusta):
    """The window of whole frusta that belongs to a box of their grid.

    Args:
        whole: the frusta over the grid.
        grid: that grid.
        cameras: of the rig, those that see the crop.
        box: the voxels of the crop.
        window: the bins.
        views: which of the rig's cameras these are.
    """

    def __init__(
        self,
        whole: Frusta,
        grid: Grid,
        cameras: Cameras,
        box: Box,
        window: Window,
        views: Int[Tensor, " k"],
    ):
        nn.Module.__init__(self)
        self.window, self.depth = window, whole.shape[0]
        edges = window.edges(whole.edges[views]).to(cameras.source)
        self._place(grid.cropped(box), window.cameras(cameras), edges, whole.spacing)
        visible, occupied, step = (
            part[views] for part in (whole.visible, whole.occupied, whole.step)
        )
        self._hold(visible[..., *box.slices], window.bins(occupied), window.bins(step))

    def part_of(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c m r s"]:
        """The pixels that the frusta have."""
        return self.window.views(views)

    def ramp(self, like: Tensor) -> Float[Tensor, "m 1 D 1 1"]:
        """The bins' depth, from -1 to 1 in the whole frustum."""
        index = (self.window.first[:, :1] + torch.arange(self.shape[0])).to(like)
        return (2 * index / max(1, self.depth - 1) - 1)[:, None, :, None, None]
