"""Volumes along the rays of every camera, at a few depths: what all cameras hold there."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.culling import seen_depth_range
from mvrecon.cameras.frusta import frusta_lattice
from mvrecon.geometry.frustum import depth_edges
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import grid_lattice, lattice_maps
from mvrecon.kernels.warps.warp import warp
from mvrecon.models.frusta import Frusta


class RaySamples(nn.Module):
    """Volumes of a grid sampled along the rays of each camera, at depths in the middle of equal
    slabs of what it sees of the grid's box; trilinear, zero outside.

    Of each camera a few numbers are kept, nothing of the size of a volume.

    Args:
        grid: of the volumes.
        cameras: whose pixels' rays are sampled.
        depths: samples along a ray.
    """

    def __init__(self, grid: Grid, cameras: Cameras, depths: int):
        super().__init__()
        edges = depth_edges(seen_depth_range(cameras, grid), depths)
        self.shape = depths, *cameras.shape
        # no buffer: places stay float64 in a model of float32
        self.maps = lattice_maps(grid_lattice(grid), frusta_lattice(cameras, grid, edges))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "RaySamples":
        super()._apply(fn, recurse)
        self.maps = self.maps.to(fn(self.maps.new_empty(0)).device)
        return self

    def forward(self, volumes: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b m c D v u"]:
        return warp(volumes[:, None], self.maps, self.shape)[:, 0]


class FixedFrusta(nn.Module):
    """The frusta of a rig over a grid, which move with a model to its device and dtype.

    Args:
        grid: where volumes in the world lie.
        cameras: the rig; its pixels are the frusta's rows and columns.
        depths: bins along a ray.
    """

    def __init__(self, grid: Grid, cameras: Cameras, depths: int):
        super().__init__()
        self.frusta = Frusta.of(grid, cameras, depths)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "FixedFrusta":
        super()._apply(fn, recurse)
        self.frusta = self.frusta.to(fn(self.frusta.step))
        return self
