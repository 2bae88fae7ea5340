"""Parallel beams around the slices of a grid: the rig of the Radon transform."""

import math

import torch

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import parallel
from mvrecon.geometry.grid import Grid


def sinogram_rig(grid: Grid, angles: int, bins: int | None = None) -> Cameras:
    """Parallel beams across a grid's slices, one row for each slice and pixels as wide as the
    narrower side of a voxel.

    Convention: view a is the Radon transform at theta = 360 a / angles degrees, its column measures
    s along (cos theta, sin theta) of the grid's own axes x and y from its centre, its row k is
    slice k of the volume.

    Args:
        grid: the slices.
        angles: of the full circle.
        bins: columns; None: enough for the diagonal of a slice.

    Raises:
        ValueError: a grid whose axes are not at right angles.
    """
    x, y, z = grid.spacing
    axes = grid.affine[:3, :3] / grid.affine.new_tensor([x, y, z])
    if not torch.allclose(axes.T @ axes, torch.eye(3).to(axes), atol=1e-6):
        raise ValueError(
            f"Sinograms of slices need a grid with axes at right angles, got {grid.affine.tolist()}"
        )
    width = min(x, y)
    diagonal = math.hypot(grid.shape[2] * (x / width), grid.shape[1] * (y / width))
    detector = {"pixels": [grid.shape[0], bins or math.ceil(diagonal)], "pixel_mm": [z, width]}
    rig = parallel(angles, detector, 2 * width * diagonal, arc_degrees=360.0, start_degrees=90.0)
    rows, columns = rig.shape
    turned = (columns - 1) * rig.u + (rows - 1) * rig.v  # rows upwards, as slices run
    return Cameras(
        rig.source + turned, rig.origin + turned, -rig.u, -rig.v, rig.shape, parallel=True
    ).moved(axes, grid.centre)
