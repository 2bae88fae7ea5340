"""Ideal sinograms of a volume's slices, over the full circle."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.sinogram import sinogram_rig
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.radon import Radon


class Sinograms:
    """The Radon transform of all slices over the full circle, in (unit of the volume) * mm.

    Views that face each other are one, mirrored: with an even number of angles half of them are
    computed, to the last bit.

    Args:
        grid: of the slices that are asked for.
        fine: the volume's grid is this many times finer.
        angles: of the full circle.
        bins: columns; None: enough for the diagonal of a slice.
    """

    def __init__(self, grid: Grid, fine: int, angles: int, bins: int | None = None):
        rig = sinogram_rig(grid, angles, bins)
        self.mirrored = angles % 2 == 0
        half = rig[list(range(angles // 2))] if self.mirrored else rig
        self.operator = Radon(grid.refined(fine), half)
        self.shape = angles, *rig.shape

    def __call__(self, volume: Float[Tensor, "1 d h w"]) -> Float[Tensor, "a z s"]:
        with torch.no_grad():
            views = self.operator(volume[None])[0, 0]
        return torch.cat([views, views.flip(-1)]) if self.mirrored else views
