"""The inverse projection transform: views to frusta of density, and the warps between frusta and
the world.

In a camera's own frustum projecting is a plain sum: p[v, u] = sum over d of g[d, v, u] * step[v,
u], so a lift that divides by the step conserves every ray's integral exactly. A warp is one
trilinear fetch per bin or voxel.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.culling import seen_depth_range
from mvrecon.cameras.frusta import frusta_lattice
from mvrecon.geometry.frustum import Spacing, depth_edges
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import enclosed, grid_lattice, lattice_maps
from mvrecon.kernels.warps.warp import warp
from mvrecon.models.bins import Bins

#: Of a voxel: a smaller share is a rounding error, of a bin and a voxel at equal places.
TOUCH = 1e-5


class Frusta(Bins, nn.Module):
    """The frusta of M cameras over one grid, cut tightly to what each sees of its box.

    Args:
        grid: the region of interest, and where `to_world` puts its volumes.
        cameras: the rig; its detector's pixels are the frusta's rows and columns.
        depth: number of depth bins.
        spacing: bins equally spaced in depth "z", or in the homogeneous factor "k" = f/z.
    """

    frusta_from_world: Tensor  # [m 1 5 2 3] where each voxel lies in each frustum
    world_from_frusta: Tensor  # [1 m 5 2 3] where each bin lies in the world grid
    edges: Tensor  # [m e] planes between the depth bins in mm, float64
    visible: Tensor  # [m 1 d h w] voxels that a frustum holds
    occupied: Tensor  # [m 1 D v u] bins inside the grid's box, ahead of the source
    step: Tensor  # [m 1 D v u] mm of ray in a bin

    def __init__(self, grid: Grid, cameras: Cameras, depth: int, spacing: Spacing = "z"):
        super().__init__()
        edges = depth_edges(seen_depth_range(cameras, grid), depth, spacing)
        self._place(grid, cameras, edges, spacing)
        ahead = frusta_lattice(cameras, grid, edges, spacing).ahead[:, None, :, None, None]
        held = enclosed(self.world_from_frusta, grid.shape, self.shape).transpose(0, 1)
        visible = enclosed(self.frusta_from_world, self.shape, grid.shape)
        start, end = cameras.rays()
        per_mm = (end - start).norm(dim=-1) / cameras.distance[
            :, None, None
        ]  # mm of ray per mm of depth
        step = (edges[:, 1:] - edges[:, :-1]).abs()[:, :, None, None] * per_mm[:, None]
        self._hold(visible, held & ahead, step[:, None].float())

    def _place(
        self, grid: Grid, cameras: Cameras, edges: Float[Tensor, "m e"], spacing: Spacing
    ) -> None:
        self.grid_shape, self.shape = grid.shape, (edges.shape[1] - 1, *cameras.shape)
        self.spacing: Spacing = spacing
        world, frusta = grid_lattice(grid), frusta_lattice(cameras, grid, edges, spacing)
        self.register_buffer("edges", edges, persistent=False)
        self.register_buffer("frusta_from_world", lattice_maps(frusta, world), persistent=False)
        self.register_buffer("world_from_frusta", lattice_maps(world, frusta), persistent=False)

    def _hold(self, visible: Tensor, occupied: Tensor, step: Tensor) -> None:
        self.register_buffer("visible", visible, persistent=False)
        self.register_buffer("occupied", occupied, persistent=False)
        self.register_buffer("step", step, persistent=False)

    def _apply(self, fn, recurse: bool = True):
        exact = {
            name: getattr(self, name)
            for name in ("edges", "frusta_from_world", "world_from_frusta")
        }
        super()._apply(fn, recurse)  # moves them; their digits stay
        for name, given in exact.items():
            setattr(self, name, given.to(self.step.device))
        return self

    def part_of(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c m r s"]:
        """The pixels that the frusta have: all."""
        return views

    def ramp(self, like: Tensor) -> Float[Tensor, "*m D 1 1"]:
        """The bins' depth, from -1 to 1."""
        return torch.linspace(-1, 1, self.shape[0], device=like.device, dtype=like.dtype)[
            :, None, None
        ]

    def to_world(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b m c d h w"]:
        """Each frustum's density at the voxels of the grid; zero where the camera does not see."""
        return warp(frusta, self.frusta_from_world, self.grid_shape)[:, :, 0]

    def to_frusta(self, volumes: Float[Tensor, "b m c d h w"]) -> Float[Tensor, "b m c D v u"]:
        """World volumes at the bins of the frusta, one volume for each camera (or one for all, m =
        1).
        """
        if volumes.shape[1] == 1:
            return warp(volumes, self.world_from_frusta, self.shape)[:, 0]
        return warp(volumes, self.world_from_frusta.transpose(0, 1), self.shape)[:, :, 0]

    def touched(self, mask: Bool[Tensor, "b 1 d h w"]) -> Bool[Tensor, "b m 1 D v u"]:
        """Every bin that reads a voxel of the mask, or that one reads: none that holds a part of it
        is left out.
        """
        with torch.inference_mode(False), torch.enable_grad():
            volume = mask.to(self.step.dtype, copy=True)[:, None]
            m = len(self.step)
            bins = self.step.new_zeros(len(mask), m, 1, *self.shape, requires_grad=True)
            (read,) = torch.autograd.grad(
                self.to_world(bins), bins, volume.expand(-1, m, -1, -1, -1, -1)
            )
        return (self.to_frusta(volume) > TOUCH) | (read > TOUCH)
