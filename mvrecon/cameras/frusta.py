"""The frusta of a rig as lattices, for the warps between frusta and the world."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.convert import to_frustum
from mvrecon.geometry.frustum import Spacing
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import Lattice, centred_affine


def frusta_lattice(
    cameras: Cameras, grid: Grid, edges: Float[Tensor, "m e"], spacing: Spacing = "z"
) -> Lattice:
    """The bins (depth, row, column) of the cameras' frusta, in float64; differentiable in the
    cameras.

    Args:
        cameras: the rig; its pixels are the frusta's rows and columns.
        grid: by whose voxels, about whose centre, space is measured.
        edges: the planes in mm between the depth bins, from `depth_edges`.
        spacing: what the bins' depths are equally spaced in, as given to `depth_edges`.
    """
    H = to_frustum(cameras) @ centred_affine(grid).to(cameras.source)
    t = edges if spacing == "z" else 1 / edges
    count = edges.shape[1] - 1
    middle, step = (t[:, -1] + t[:, 0]) / 2, (t[:, -1] - t[:, 0]) / count
    central = torch.full_like(middle, 1.0 if cameras.ray_extent[1] > 0 else -1.0)
    side = middle.sign() if cameras.parallel else central
    if spacing == "k":
        H = H * (side / edges.abs().amax(dim=1))[:, None, None]  # its denominator is z
    if (spacing == "z") != cameras.parallel:
        H = H[:, [0, 1, 3, 2]]  # homogeneous (u t, v t, t, 1)
        scale, across = side / t.abs().amax(dim=1), H[:, 2, None]
        lift = torch.stack([scale * middle, scale * step], dim=-1)
    else:  # homogeneous (u, v, t, 1)
        scale, across = torch.ones_like(middle), H[:, 3, None]
        lift = torch.stack([scale, torch.zeros_like(scale)], dim=-1)
    centre = H.new_tensor([(n - 1) / 2 for n in cameras.shape[::-1]])[:, None]
    pixels = scale[:, None, None] * (H[:, :2] - centre * across)
    bins = (H[:, 2:3] - middle[:, None, None] * H[:, 3:]) / step[:, None, None]
    return Lattice((count, *cameras.shape), torch.cat([pixels, bins, H[:, 3:]], dim=1), lift)
