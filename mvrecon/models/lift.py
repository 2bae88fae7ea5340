"""The inverse projection transform: views to frusta of density, and the warps between frusta and the world.

In a camera's own frustum projecting is a plain sum: p[v, u] = sum over d of g[d, v, u] * step[v, u], so a lift that
divides by the step conserves every ray's integral exactly. A warp is one trilinear fetch per bin or voxel.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.frustum import Spacing, depth_centres, depth_edges, depth_index
from mvrecon.geometry.grid import Grid, pixel_centres, voxel_centres
from mvrecon.geometry.sample import inside, normalised, sample


class Frusta(nn.Module):
    """The frusta of M cameras over one grid, cut tightly to its box.

    Args:
        grid: the region of interest, and where `to_world` puts its volumes.
        cameras: the rig; its detector's pixels are the frusta's rows and columns.
        depth: number of depth bins.
        spacing: bins equally spaced in depth "z", or in the homogeneous factor "k" = f/z.
    """

    points_in_frusta: Tensor  # [m d h w 3] where each voxel lies in each frustum
    points_in_world: Tensor  # [m D v u 3] where each bin lies in the world grid
    visible: Tensor  # [m 1 d h w] voxels that a frustum holds
    occupied: Tensor  # [m 1 D v u] bins inside the grid's box
    step: Tensor  # [m 1 D v u] mm of ray in a bin

    def __init__(self, grid: Grid, cameras: Cameras, depth: int, spacing: Spacing = "z"):
        super().__init__()
        self.shape = (depth, *cameras.shape)
        edges = depth_edges(cameras.depth_range(grid), depth, spacing)
        uvz = cameras.project(voxel_centres(grid).to(cameras.source))
        index = torch.cat([uvz[..., :2], depth_index(uvz[..., 2], edges, spacing)[..., None]], dim=-1)
        in_frusta = normalised(index, self.shape)
        in_world = normalised(grid.to_index(_bin_centres(cameras, edges, spacing)), grid.shape)
        start, end = cameras.rays()
        per_mm = (end - start).norm(dim=-1) / cameras.distance[:, None, None]  # mm of ray per mm of depth
        step = (edges[:, 1:] - edges[:, :-1]).abs()[:, :, None, None] * per_mm[:, None]
        self.register_buffer("points_in_frusta", in_frusta.float(), persistent=False)
        self.register_buffer("points_in_world", in_world.float(), persistent=False)
        self.register_buffer("visible", inside(in_frusta)[:, None], persistent=False)
        self.register_buffer("occupied", inside(in_world)[:, None], persistent=False)
        self.register_buffer("step", step[:, None].float(), persistent=False)

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
        return _warp(frusta, self.points_in_frusta)

    def to_frusta(self, volumes: Float[Tensor, "b m c d h w"]) -> Float[Tensor, "b m c D v u"]:
        """World volumes at the bins of the frusta, one volume for each camera (or one for all, m = 1)."""
        return _warp(volumes.expand(-1, len(self.step), -1, -1, -1, -1), self.points_in_world)


def _bin_centres(cameras: Cameras, edges: Tensor, spacing: Spacing) -> Float[Tensor, "m D v u 3"]:
    z = depth_centres(edges, spacing)
    pixels = pixel_centres(cameras.shape).to(z)
    uv = pixels[None, None].expand(len(cameras), z.shape[1], -1, -1, -1)
    return cameras.unproject(torch.cat([uv, z[:, :, None, None, None].expand(*uv.shape[:-1], 1)], dim=-1))


def _warp(volumes: Float[Tensor, "b m c *s"], points: Float[Tensor, "m d h w 3"]) -> Float[Tensor, "b m c d h w"]:
    b, m = volumes.shape[:2]
    warped = sample(volumes.flatten(0, 1), points.expand(b, *points.shape).flatten(0, 1))
    return warped.unflatten(0, (b, m))
