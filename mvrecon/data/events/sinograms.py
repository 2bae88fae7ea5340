"""Ideal sinograms of a volume's slices, over the full circle."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.rigs import parallel
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.radon import Radon


def sinogram_rig(grid: Grid, angles: int, bins: int | None = None) -> Cameras:
    """Parallel beams across a grid's slices, one row for each slice and pixels as wide as voxels.

    Convention: view a is the Radon transform at theta = 360 a / angles degrees, its column measures
    s along (cos theta, sin theta) from the grid's centre, its row k is slice k of the volume.

    Args:
        grid: axis-aligned, its voxels as wide along y as along x.
        angles: of the full circle.
        bins: columns; None: enough for the diagonal of a slice.

    Raises:
        ValueError: slices that are not across the world's z, or voxels that are not square.
    """
    x, y, z = grid.spacing
    scaled = torch.diag(torch.tensor([x, y, z], dtype=torch.float64))
    if not torch.allclose(grid.affine[:3, :3], scaled) or abs(x - y) > 1e-6 * x:
        raise ValueError(
            f"Sinograms of slices need an axis-aligned grid with square voxels in x and y, got "
            f"{grid.affine.tolist()}"
        )
    columns = bins or math.ceil(math.hypot(grid.shape[2], grid.shape[1]))
    detector = {"pixels": [grid.shape[0], columns], "pixel_mm": [z, x]}
    depth = 2 * x * math.hypot(grid.shape[2], grid.shape[1])
    rig = parallel(angles, detector, depth, arc_degrees=360.0, start_degrees=90.0)
    turned = (columns - 1) * rig.u + (grid.shape[0] - 1) * rig.v  # rows upwards, as slices run
    return Cameras(
        rig.source + turned, rig.origin + turned, -rig.u, -rig.v, rig.shape, parallel=True
    ).moved(torch.eye(3), grid.centre)


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
