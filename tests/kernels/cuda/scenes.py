"""Scenes that the kernels are compared with the reference on."""

from dataclasses import replace

import torch

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular, dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.kernels.rays.occupancy import Occupancy
from tests.operators.rigs import AXIAL, CONE, GRID, INSIDE, PARALLEL, PINHOLES

whole = Occupancy.whole
SMALL = Grid.centred(size=(6, 4, 5), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
BODY = Grid.centred(size=(10, 8, 9), spacing=22.0)
FLAT = Grid.centred(size=(6, 5, 1), spacing=(1.0, 1.2, 0.9), centre=tuple(GRID.centre.tolist()))
#: A detector of more than a tile, and no multiple of one.
LARGE = circular(
    2,
    40.0,
    70.0,
    {"pixels": [9, 37], "pixel_mm": [1.2, 0.4], "offset_mm": [0.13, 0.07]},
    start_degrees=13.0,
)
#: A source in the volume, its detector so wide that voxels lie on both sides of the source.
WIDE = circular(2, 40.0, 70.0, {"pixels": [6, 5], "pixel_mm": 25.0})
WIDE = WIDE.moved(torch.eye(3), GRID.centre)
WIDE = replace(
    WIDE, source=GRID.centre + torch.tensor([0.9, -0.7, 0.6]) + 0.02 * (WIDE.source - GRID.centre)
)
#: Grids and rigs: every kind of camera, all main axes, rays that end inside.
RIGS: dict[str, tuple[Grid, Cameras]] = {
    "cone": (GRID, CONE),
    "dome": (SMALL, PINHOLES[1:3]),
    "parallel": (GRID, PARALLEL),
    "line": (SMALL, replace(PARALLEL[:2], extent="line")),
    "inside": (GRID, INSIDE),
    "wide": (GRID, WIDE),
    "axial": (GRID, AXIAL),
    "slice": (FLAT, PARALLEL[:2]),
    "large": (SMALL, LARGE.moved(torch.eye(3), SMALL.centre)),
    "dcspect80": (BODY, dcspect80()[::16].binned(8)),
}
METHODS = ("joseph", "siddon", "trilinear:8")  # of an odd number, one sample may lie on a kink
CASES = [(kind, method) for kind in RIGS for method in METHODS]


def scene(kind: str, dtype: torch.dtype = torch.float64, count: int = 1):
    """Volumes and views of noise, lines, window, detector."""
    torch.manual_seed(1)
    grid, cameras = RIGS[kind]
    x = torch.randn(count, *grid.shape, dtype=dtype)
    y = torch.randn(count, len(cameras), *cameras.shape, dtype=dtype)
    return x, y, lines_of(cameras, grid), list(cameras.ray_extent), list(cameras.shape)


def difference(one: torch.Tensor, two: torch.Tensor) -> float:
    """The greatest difference, by the greatest value of the second."""
    greatest = two.detach().abs().max()
    assert greatest > 0
    return float((one.double() - two.detach().double()).abs().max() / greatest)
