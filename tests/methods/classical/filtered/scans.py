"""Scans of one uniform object, for filtered back-projection."""

import math
from typing import NamedTuple

import torch

from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular, parallel
from mvrecon.geometry.grid import Grid, voxel_centres

VALUE = 0.02  # 1/mm
SLICE = Grid.centred(size=(64, 64, 1), spacing=1.8)
VOLUME = Grid.centred(size=(48, 48, 16), spacing=2.2)


class Case(NamedTuple):
    grid: Grid
    cameras: Cameras


def cylinder(radius: float = 40.0, height: float = 300.0) -> Phantom:
    """A cylinder along z, off the axis; 0.02/mm."""
    size = torch.tensor([[radius, radius, height / 2]])
    centre, turn = torch.tensor([[3.0, -5.0, 0.0]]), torch.eye(3)[None]
    return Phantom((Solids("cylinder", centre, turn, size, torch.tensor([VALUE])),))


def views_of(phantom: Phantom, cameras: Cameras) -> torch.Tensor:
    """Exact line integrals [1 1 m v u]."""
    start, end = cameras.rays()
    return phantom.integrals(start, end, cameras.ray_extent)[None, None].float()


def middle(x: torch.Tensor, grid: Grid, radius: float = 20.0) -> torch.Tensor:
    """The values of the middle slices, within a radius of the cylinder's axis."""
    off = voxel_centres(grid)[..., :2] - torch.tensor([3.0, -5.0], dtype=torch.float64)
    depth = grid.shape[0]
    inside = (off.norm(dim=-1) < radius)[(depth - 1) // 2 : depth // 2 + 1]
    return x[0, 0, (depth - 1) // 2 : depth // 2 + 1][inside]


def detector(columns: int, pixel_mm: float, shift_mm: float = 0.0, rows: int = 1) -> dict:
    return {"pixels": [rows, columns], "pixel_mm": pixel_mm, "offset_mm": [0.0, shift_mm]}


def uneven(count: int, arc: float) -> list[float]:
    """Angles that grow unevenly from 0 to an arc, in disorder."""
    steps = [1 + 0.5 * math.sin(k) for k in range(count)]
    angles = [arc * sum(steps[:k]) / sum(steps) for k in range(count)]
    return angles[1::2] + angles[::2]


LINE, FAN, CONE = detector(128, 1.0), detector(100, 2.0), detector(100, 2.0, rows=32)
RAYS = {"depth_mm": 400.0}

PARALLEL = {
    "180": parallel(120, LINE, **RAYS),
    "360": parallel(241, LINE, arc_degrees=360.0, **RAYS),
    "uneven": parallel(150, LINE, angles=uneven(150, 180.0), **RAYS),
    "clockwise": parallel(120, LINE, arc_degrees=-180.0, start_degrees=33.0, **RAYS),
    "offset": parallel(240, detector(80, 1.0, 25.0), arc_degrees=360.0, **RAYS),
}
FANS = {
    "full": circular(240, 400.0, 600.0, FAN),
    "uneven": circular(240, 400.0, 600.0, FAN, angles=uneven(240, 360.0)),
    "short": circular(140, 400.0, 600.0, FAN, arc_degrees=210.0, start_degrees=-70.0),
    "overscan": circular(200, 400.0, 600.0, FAN, arc_degrees=-300.0),
    "offset": circular(240, 400.0, 600.0, detector(66, 2.0, 35.0)),
    "offset left": circular(240, 400.0, 600.0, detector(66, 2.0, -35.0), arc_degrees=-360.0),
}
CONES = {
    "full": circular(120, 400.0, 600.0, CONE),
    "short": circular(90, 400.0, 600.0, CONE, arc_degrees=200.0),
    "offset": circular(120, 400.0, 600.0, detector(66, 2.0, 35.0, rows=32)),
}
