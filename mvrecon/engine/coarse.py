"""A coarser grid in the same box, for what is told of a scan before or beside its volume."""

import math

from mvrecon.geometry.grid import Grid


def coarse(grid: Grid, most: int) -> Grid:
    """The same box in mm in at most `most` voxels a side, about as long along all axes; the grid
    itself where it is as coarse.
    """
    lengths = grid.affine.new_tensor(grid.spacing) * grid.affine.new_tensor(grid.size)
    step = lengths.max() / most
    counts = [
        min(n, math.ceil(mm / step - 1e-6))
        for n, mm in zip(grid.size, lengths.tolist(), strict=True)
    ]
    ratio = grid.affine.new_tensor(grid.size) / grid.affine.new_tensor(counts)
    affine = grid.affine.clone()
    affine[:3, :3] *= ratio
    affine[:3, 3] = grid.to_world((ratio - 1) / 2)
    return Grid((counts[2], counts[1], counts[0]), affine)
