"""Lattices of frusta and grids, and homographies between small volumes."""

import torch

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, pixel_centres
from mvrecon.geometry.lattice import Lattice, depth_edges, grid_lattice
from mvrecon.methods.learned.view_frames import frusta_lattice
from tests.operators.rigs import CONE, GRID, PARALLEL, PINHOLES

BODY = Grid.centred(size=(10, 8, 9), spacing=22.0)
RIGS = {
    "cone": (GRID, CONE),
    "pinholes": (GRID, PINHOLES),
    "parallel": (GRID, PARALLEL),
    "dcspect80": (BODY, dcspect80()[::20].binned(8)),
}
DEPTH = 7
#: Shapes of a source and of an output.
SMALL, OTHER = (4, 3, 5), [3, 4, 4]


def edges_of(grid: Grid, cameras: Cameras) -> torch.Tensor:
    return depth_edges(cameras.depth_range(grid), DEPTH)


def lattices(grid: Grid, cameras: Cameras) -> tuple[Lattice, Lattice]:
    return frusta_lattice(cameras, grid, edges_of(grid, cameras)), grid_lattice(grid)


def depth_index(z: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
    """Depth coordinate of z in mm: -1/2 at the first edge, integer at bin centres."""
    pad = (len(edges),) + (1,) * (z.ndim - 1)
    near, far = edges[:, 0].reshape(pad), edges[:, -1].reshape(pad)
    return (z - near) / (far - near) * (edges.shape[1] - 1) - 0.5


def index_in_frusta(cameras: Cameras, edges: torch.Tensor, xyz: torch.Tensor) -> torch.Tensor:
    uvz = cameras.project(xyz)
    return torch.cat([uvz[..., :2], depth_index(uvz[..., 2], edges)[..., None]], dim=-1)


def bin_centres(cameras: Cameras, edges: torch.Tensor) -> torch.Tensor:
    z = (edges[:, 1:] + edges[:, :-1]) / 2
    uv = pixel_centres(cameras.shape)[None, None].expand(len(cameras), z.shape[1], -1, -1, -1)
    return cameras.unproject(
        torch.cat([uv, z[:, :, None, None, None].expand(*uv.shape[:-1], 1)], dim=-1)
    )


def generic(count: int = 2) -> torch.Tensor:
    """Homographies between small volumes, no sample on a cell's face."""
    torch.manual_seed(1)
    H = torch.eye(4, dtype=torch.float64).repeat(2, count, 1, 1)
    H[..., :3, :] += 0.15 * torch.randn_like(H[..., :3, :])
    H[..., 3, :3] += 0.03 * torch.randn_like(H[..., 3, :3])
    return H
