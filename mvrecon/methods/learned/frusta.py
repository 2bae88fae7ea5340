"""The lift: views to frusta of density, and the warps between frusta and the world.

In a camera's own frustum projecting is a plain sum: p[v, u] = sum over d of g[d, v, u] * step[v,
u], so a lift that divides by the step conserves every ray's integral exactly. A warp is one
trilinear fetch per bin or voxel.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.convert import to_frustum
from mvrecon.geometry.cameras.field import seen_depth_range
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import (
    Lattice,
    Spans,
    centred_affine,
    depth_edges,
    enclosed,
    grid_lattice,
    lattice_maps,
)
from mvrecon.kernels.warps.warp import warp


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


@dataclass(frozen=True, eq=False)
class Frusta:
    """The frusta of M cameras over one grid; `Frusta.of` makes them.

    Of each camera it holds images and rows, no volume: what has a value for every bin or voxel is
    made where it is asked for.

    Args:
        frusta_from_world: where each voxel lies in each frustum, float64.
        world_from_frusta: where each bin lies in the grid, float64.
        edges: planes between the depth bins in mm, float64.
        voxels: those inside a frustum.
        bins: bins inside the grid's box, ahead of the source.
        thickness: mm of depth of a bin.
        slant: mm of ray per mm of depth.
    """

    frusta_from_world: Float[Tensor, "m 1 5 2 3"]
    world_from_frusta: Float[Tensor, "1 m 5 2 3"]
    edges: Float[Tensor, "m e"]
    voxels: Spans
    bins: Spans
    thickness: Float[Tensor, "m D"]
    slant: Float[Tensor, "m v u"]

    @classmethod
    def of(cls, grid: Grid, cameras: Cameras, depth: int) -> "Frusta":
        """Frusta cut tightly to what each camera sees of a grid's box.

        Args:
            grid: the region of interest, and where `to_volume` puts its volumes.
            cameras: the rig; its detector's pixels are the frusta's rows and columns.
            depth: number of depth bins.
        """
        edges = depth_edges(seen_depth_range(cameras, grid), depth)
        frusta_from_world, world_from_frusta = maps_between(grid, cameras, edges)
        ahead = frusta_lattice(cameras, grid, edges).ahead[:, None, :, None]
        shape = depth, *cameras.shape
        bins = enclosed(world_from_frusta[0, :, None], grid.shape, shape)
        start, end = cameras.rays()
        slant = (end - start).norm(dim=-1) / cameras.distance[:, None, None]
        return cls(
            frusta_from_world,
            world_from_frusta,
            edges,
            voxels=enclosed(frusta_from_world, shape, grid.shape),
            bins=replace(bins, end=bins.end * ahead),
            thickness=(edges[:, 1:] - edges[:, :-1]).abs().float(),
            slant=slant.float(),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Bins (depth, row, column)."""
        return self.bins.shape

    @property
    def step(self) -> Float[Tensor, "m 1 D v u"]:
        """Length in mm of ray in a bin."""
        return (self.thickness[:, :, None, None] * self.slant[:, None])[:, None]

    @property
    def visible(self) -> Bool[Tensor, "m 1 d h w"]:
        """Voxels inside a frustum."""
        return self.voxels.mask

    @property
    def occupied(self) -> Bool[Tensor, "m 1 D v u"]:
        """Bins that may be other than zero: those inside the grid's box, ahead of the source."""
        return self.bins.mask

    @property
    def chord(self) -> Float[Tensor, "m 1 1 v u"]:
        """Length in mm of each ray's occupied bins."""
        return (self.occupied * self.step).sum(dim=-3, keepdim=True)

    def to(self, *where: Any) -> "Frusta":
        """On another device, or with steps of another dtype; the maps keep their digits."""
        slant = self.slant.to(*where)
        device = slant.device
        names = ("frusta_from_world", "world_from_frusta", "edges", "voxels", "bins")
        moved = {name: getattr(self, name).to(device) for name in names}
        thickness = self.thickness.to(slant)
        return replace(self, slant=slant, thickness=thickness, **moved)

    def spread(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b m c D v u"]:
        """Uniform lift: each pixel's integral spread evenly along its ray's occupied bins."""
        share = self.occupied / self.chord.clamp_min(torch.finfo(views.dtype).tiny)
        return views.transpose(1, 2)[:, :, :, None] * share

    def integrate(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b c m v u"]:
        """Each camera's own view of its own frustum: the sum along every ray, exactly."""
        return (frusta * self.step).sum(dim=3).transpose(1, 2)

    def depths(self, like: Tensor) -> Float[Tensor, "D 1 1"]:
        """The depth of each bin, from -1 to 1."""
        ramp = torch.linspace(-1, 1, self.shape[0], device=like.device, dtype=like.dtype)
        return ramp[:, None, None]

    def to_volume(self, frusta: Float[Tensor, "b m c D v u"]) -> Float[Tensor, "b m c d h w"]:
        """Each frustum's density at the voxels of the grid; zero where the camera does not see."""
        return warp(frusta, self.frusta_from_world, self.voxels.shape)[:, :, 0]

    def to_frusta(self, volumes: Float[Tensor, "b m c d h w"]) -> Float[Tensor, "b m c D v u"]:
        """Volumes at the bins of the frusta, one volume for each camera (or one for all, m =
        1).
        """
        if volumes.shape[1] == 1:
            return warp(volumes, self.world_from_frusta, self.shape)[:, 0]
        return warp(volumes, self.world_from_frusta.transpose(0, 1), self.shape)[:, :, 0]


def maps_between(
    grid: Grid, cameras: Cameras, edges: Float[Tensor, "m e"]
) -> tuple[Float[Tensor, "m 1 5 2 3"], Float[Tensor, "1 m 5 2 3"]]:
    """The maps of the warps: where voxels lie in frusta, and where bins lie in the grid."""
    world, frusta = grid_lattice(grid), frusta_lattice(cameras, grid, edges)
    return lattice_maps(frusta, world), lattice_maps(world, frusta)
