"""Scenes that are small enough for numba's simulator of CUDA, and where they are computed."""

import os
from dataclasses import replace

import pytest
import torch

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.dcspect80 import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.lines import lines_of
from mvrecon.kernels.rays.occupancy import Occupancy
from tests.projectors.rigs import GRID, PARALLEL, PINHOLES

SIMULATED = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"
DEVICE = "cuda" if torch.cuda.is_available() and not SIMULATED else "cpu"
kernels = pytest.mark.skipif(
    not SIMULATED and DEVICE == "cpu", reason="no CUDA device and no simulator"
)

whole = Occupancy.whole
SMALL = Grid.centred(size=(6, 4, 5), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
BODY = Grid.centred(size=(4, 5, 4), spacing=45.0)
RIGS = {
    "dome": (SMALL, PINHOLES[1:3]),
    "parallel": (SMALL, replace(PARALLEL[:2], extent="line")),
    "dcspect80": (BODY, dcspect80()[::40].binned(16)),
    "slice": (
        Grid.centred(size=(6, 5, 1), spacing=(1.0, 1.2, 0.9), centre=tuple(GRID.centre.tolist())),
        PARALLEL[:2],
    ),
}
METHODS = ("joseph", "siddon", "trilinear:8")  # of an odd number, one sample may lie on a kink
CASES = [(kind, method) for kind in RIGS for method in METHODS]


def scene(kind: str, dtype: torch.dtype = torch.float64, count: int = 1):
    """Lines, window, detector, and volumes and views of noise."""
    torch.manual_seed(1)
    grid, cameras = RIGS[kind]
    x = torch.randn(count, *grid.shape, dtype=dtype, device=DEVICE)
    y = torch.randn(count, len(cameras), *cameras.shape, dtype=dtype, device=DEVICE)
    return x, y, lines_of(cameras, grid).to(DEVICE), list(cameras.ray_extent), list(cameras.shape)


def close(one: torch.Tensor, two: torch.Tensor, tolerance: float = 1e-11) -> bool:
    return two.abs().max() > 0 and torch.allclose(
        one, two, rtol=0, atol=tolerance * float(two.abs().max())
    )


def rays_as_views(grid: Grid, cameras: Cameras) -> torch.Tensor:
    """Every ray of a rig as a view of one pixel: maps of the constant alone."""
    rows, columns = cameras.shape
    v, u = torch.meshgrid(
        torch.arange(rows) - (rows - 1) / 2,
        torch.arange(columns) - (columns - 1) / 2,
        indexing="ij",
    )
    p = torch.stack([u, v, torch.ones_like(u)], dim=-1).double().reshape(-1, 3)
    maps = torch.einsum("mkxc,rc->mrkx", lines_of(cameras, grid), p)
    return maps.flatten(0, 1)[..., None].contiguous().to(DEVICE)
