"""Rigs about one grid, and volumes of which little is not zero."""

import torch

from mvrecon.geometry.cameras.rigs import circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.kernels.rays.occupancy import EDGE
from tests.operators.cases import Case, curved

#: No size is a multiple of a brick's edge, and no two spacings are alike.
GRID = Grid.centred(size=(33, 26, 19), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
DETECTOR = {"pixels": [17, 14], "pixel_mm": [3.1, 4.3], "offset_mm": [0.37, -0.6]}
TURNED = random_rotation(torch.Generator().manual_seed(3))


def about(rig):
    """A rig about the grid's centre."""
    return rig.moved(torch.eye(3), GRID.centre)


ALONG = parallel(4, {"pixels": [19, 40], "pixel_mm": [1.0, 0.9]}, 60.0, start_degrees=0.0)
CASES = {
    "cone": Case(GRID, about(circular(5, 60.0, 100.0, DETECTOR, start_degrees=13.0))),
    "stack": Case(GRID, about(parallel(4, DETECTOR, 90.0, start_degrees=11.0))),
    "dome": Case(GRID, about(dome(5, 45.0, 30.0, 120.0, DETECTOR))),
    "beams": Case(GRID, parallel(3, DETECTOR, 90.0, start_degrees=11.0).moved(TURNED, GRID.centre)),
    "along rows": Case(GRID, about(ALONG)),
    "inside": Case(
        GRID,
        about(circular(3, 9.0, 40.0, DETECTOR, start_degrees=13.0).moved(TURNED, torch.ones(3))),
    ),
    "dcspect80": Case(
        Grid.centred(size=(33, 26, 19), spacing=(9.0, 8.0, 7.0)), dcspect80()[::13].binned(6)
    ),
    "explicit": Case(GRID, curved(9, 7)),
}


METHODS = ["joseph", "siddon", "trilinear", "trilinear:7"]


def volumes(kind: str, dtype: torch.dtype = torch.float32, count: int = 1) -> torch.Tensor:
    """Volumes [1 c d h w] of which little is there."""
    rng = torch.Generator().manual_seed(5)
    values = torch.rand(1, count, *GRID.shape, generator=rng, dtype=torch.float64) + 0.5
    mask = torch.zeros(GRID.shape, dtype=torch.bool)
    if kind == "blob":
        mask[5:9, 11:20, 8:14] = True
    elif kind == "corners":  # a voxel in each corner and on an edge of a brick
        for z, y, x in [
            (8, 8, 8),
            (15, 15, 15),
            (8, 15, 23),
            (12, 16, 24),
            (7, 7, 31),
            (16, 8, 12),
        ]:
            mask[z, y, x] = True
    elif kind == "checkerboard":
        z, y, x = torch.meshgrid(*[torch.arange(n) // EDGE for n in GRID.shape], indexing="ij")
        mask = (z + y + x) % 2 == 0
    elif kind == "end":
        mask[18, 25, 32] = mask[0, 25, 0] = True
    elif kind == "full":
        mask[:] = True
    return torch.where(mask, values, 0).to(dtype)


KINDS = ["blob", "corners", "checkerboard", "end", "full", "empty"]
