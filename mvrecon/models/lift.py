"""The inverse projection transform: views to frusta of density, and the warps between frusta and the world.

In a camera's own frustum projecting is a plain sum: p[v, u] = sum over d of g[d, v, u] * step[v, u], so a lift that
divides by the step conserves every ray's integral exactly. A warp is one trilinear fetch per bin or voxel.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.frusta import frusta_lattice
from mvrecon.geometry.frustum import Spacing, depth_edges
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import grid_lattice, lattice_maps
from mvrecon.geometry.sample import inside
from mvrecon.kernels.warps.reference import normalised_places
from mvrecon.kernels.warps.warp import warp


class Frusta(nn.Module):
    """The frusta of M cameras over one grid, cut tightly to its box.

    Args:
        grid: the region of interest, and where `to_world` puts its volumes.
        cameras: the rig; its detector's pixels are the frusta's rows and columns.
        depth: number of depth bins.
        spacing: bins equally spaced in depth "z", or in the homogeneous factor "k" = f/z.
    """

    frusta_from_world: Tensor  # [m 1 5 2 3] where each voxel lies in each frustum
    world_from_frusta: Tensor  # [1 m 5 2 3] where each bin lies in the world grid
    visible: Tensor  # [m 1 d h w] voxels that a frustum holds
    occupied: Tensor  # [m 1 D v u] bins inside the grid's box, ahead of the source
    step: Tensor  # [m 1 D v u] mm of ray in a bin

    def __init__(self, grid: Grid, cameras: Cameras, depth: int, spacing: Spacing = "z"):
        super().__init__()
        self.grid_shape, self.shape = grid.shape, (depth, *cameras.shape)
        edges = depth_edges(cameras.depth_range(grid), depth, spacing)
        world, frusta = grid_lattice(grid), frusta_lattice(cameras, grid, edges, spacing)
        of_voxels, of_bins = lattice_maps(frusta, world), lattice_maps(world, frusta)
        start, end = cameras.rays()
        per_mm = (end - start).norm(dim=-1) / cameras.distance[:, None, None]  # mm of ray per mm of depth
        step = (edges[:, 1:] - edges[:, :-1]).abs()[:, :, None, None] * per_mm[:, None]
        self.register_buffer("frusta_from_world", of_voxels, persistent=False)
        self.register_buffer("world_from_frusta", of_bins, persistent=False)
        self.register_buffer("visible", inside(normalised_places(of_voxels, self.shape, grid.shape)), persistent=False)
        held = inside(normalised_places(of_bins, grid.shape, self.shape)).transpose(0, 1)
        ahead = frusta.ahead[:, None, :, None, None]
        self.register_buffer("occupied", held & ahead, persistent=False)
        self.register_buffer("step", step[:, None].float(), persistent=False)

    def _apply(self, fn, recurse: bool = True):
        exact = self.frusta_from_world, self.world_from_frusta
        super()._apply(fn, recurse)  # moves the maps; their digits stay
        self.frusta_from_world, self.world_from_frusta = (maps.to(self.step.device) for maps in exact)
        return self

    def spread(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b m c D v u"]:
        """Uniform lift: each pixel's integral spread evenly along its ray's chord of the grid's box."""
        share = self.occupied / self.chord.clamp_min(torch.finfo(views.dtype).tiny)
        return views.transpose(1, 2)[:, :, :, None] * share

    @property
    def chord(self) -> Float[Tensor, "m 1 1 v u"]:
        """Length in mm of each ray inside the grid's box, as the frustum's bins see it."""
        return (self.occupied * self.step).sum(dim=2, keepdim=True)

    def integrate(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b c m v u"]:
        """Each camera's own view of its own frustum: the sum along every ray, exactly."""
        return (frusta * self.step).sum(dim=3).transpose(1, 2)

    def to_world(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b m c d h w"]:
        """Each frustum's density at the voxels of the grid; zero where the camera does not see."""
        return warp(frusta, self.frusta_from_world, self.grid_shape)[:, :, 0]

    def to_frusta(self, volumes: Float[Tensor, "b m c d h w"]) -> Float[Tensor, "b m c D v u"]:
        """World volumes at the bins of the frusta, one volume for each camera (or one for all, m = 1)."""
        if volumes.shape[1] == 1:
            return warp(volumes, self.world_from_frusta, self.shape)[:, 0]
        return warp(volumes, self.world_from_frusta.transpose(0, 1), self.shape)[:, :, 0]
