"""The frusta of a rig as lattices, for the warps between frusta and the world."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.convert import to_frustum
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import Lattice, centred_affine


def frusta_lattice(cameras: Cameras, grid: Grid, edges: Float[Tensor, "m e"]) -> Lattice:
    """The bins (depth, row, column) of the cameras' frusta, in float64; differentiable in the
    cameras.

    Args:
        cameras: the rig; its pixels are the frusta's rows and columns.
        grid: by whose voxels, about whose centre, space is measured.
        edges: the planes in mm between the depth bins, from `depth_edges`.
    """
    H = to_frustum(cameras) @ centred_affine(grid).to(cameras.source)
    count = edges.shape[1] - 1
    middle, step = (edges[:, -1] + edges[:, 0]) / 2, (edges[:, -1] - edges[:, 0]) / count
    if cameras.parallel:  # homogeneous (u, v, z, 1)
        scale, across = torch.ones_like(middle), H[:, 3, None]
        lift = torch.stack([scale, torch.zeros_like(scale)], dim=-1)
    else:
        H = H[:, [0, 1, 3, 2]]  # homogeneous (u z, v z, z, 1)
        side = 1.0 if cameras.ray_extent[1] > 0 else -1.0
        scale, across = side / edges.abs().amax(dim=1), H[:, 2, None]
        lift = torch.stack([scale * middle, scale * step], dim=-1)
    centre = H.new_tensor([(n - 1) / 2 for n in cameras.shape[::-1]])[:, None]
    pixels = scale[:, None, None] * (H[:, :2] - centre * across)
    bins = (H[:, 2:3] - middle[:, None, None] * H[:, 3:]) / step[:, None, None]
    return Lattice((count, *cameras.shape), torch.cat([pixels, bins, H[:, 3:]], dim=1), lift)
