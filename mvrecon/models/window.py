"""The part of each camera's frustum that a part of the grid needs: some depths, rows and columns,
as many for all.

Its bins are bins of the whole frustum, so what is worked out in a window is what would be worked
out without it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.box import Box, three
from mvrecon.geometry.frustum import depth_index
from mvrecon.geometry.grid import Grid

#: Bricks along the longest side of a mask, at most: enough to follow a body, few enough to be
#: projected at once.
BRICKS = 16


@dataclass(frozen=True, eq=False)
class Window:
    """Bins first <= index < first + shape of each camera's frustum.

    Args:
        first: (depth, row, column) for each camera.
        shape: bins (D, v, u).
    """

    first: Int[Tensor, "m 3"]
    shape: tuple[int, int, int]

    def scaled(self, depth: int, pixels: int) -> "Window":
        """The same part of frusta whose bins are `depth` times as fine in depth, `pixels` times
        across.
        """
        d, v, u = self.shape
        factors = self.first.new_tensor([depth, pixels, pixels])
        return Window(self.first * factors, (d * depth, v * pixels, u * pixels))

    def deep(self, depth: int) -> "Window":
        """The same rows and columns with all of the depth's bins."""
        first = torch.cat([torch.zeros_like(self.first[:, :1]), self.first[:, 1:]], dim=1)
        return Window(first, (depth, *self.shape[1:]))

    def cameras(self, cameras: Cameras) -> Cameras:
        """The rig with its detectors cut."""
        row, column = self.first[:, 1:].to(cameras.source).split(1, dim=1)
        shift = column * cameras.u + row * cameras.v
        source = cameras.source + shift if cameras.parallel else cameras.source
        return replace(cameras, source=source, origin=cameras.origin + shift, shape=self.shape[1:])

    def edges(self, edges: Float[Tensor, "m e"]) -> Float[Tensor, "m f"]:
        """The planes between the depth bins that are kept."""
        kept = self.first[:, :1] + torch.arange(self.shape[0] + 1)
        return edges.gather(1, kept.to(edges.device))

    def views(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c m r s"]:
        """The part of every view that falls on the cut detectors."""
        return torch.stack(
            [
                view[..., v, u]
                for view, (_, v, u) in zip(views.unbind(2), self._parts(), strict=True)
            ],
            2,
        )

    def bins(self, values: Shaped[Tensor, "m 1 D v u"]) -> Shaped[Tensor, "m 1 E r s"]:
        """Values of all bins at those that are kept."""
        return torch.stack(
            [each[:, *part] for each, part in zip(values, self._parts(), strict=True)]
        )

    def _parts(self) -> list[tuple[slice, slice, slice]]:
        """What cuts each camera's bins out of all; slices, since an index for each bin takes ten
        times as long.
        """
        first = self.first.tolist()
        return [
            Box(three(low), three(a + n for a, n in zip(low, self.shape, strict=True))).slices
            for low in first
        ]


def window_of(
    corners: Float[Tensor, "n 3"], cameras: Cameras, edges: Float[Tensor, "m e"], multiple: int
) -> Window:
    """The least window of frusta that holds every bin which the voxels of some boxes read, or are
    read by.

    Bounds are multiples of a number, so that the coarser levels of a network keep their places; an
    axis whose size is none is kept whole, and so are the pixels of a camera whose source lies
    between the planes that bound the boxes.

    Args:
        corners: of the boxes, in world mm.
        cameras: the rig.
        edges: the planes in mm between the whole frusta's depth bins.
        multiple: that number.
    """
    seen = cameras.project(corners.to(cameras.source)).cpu()  # [m n 3]
    place = torch.stack(
        [depth_index(seen[..., 2], edges.cpu()), seen[..., 1], seen[..., 0]], dim=-1
    )
    sizes = torch.tensor([edges.shape[1] - 1, *cameras.shape])
    across = (seen[..., 2].amin(dim=1) * seen[..., 2].amax(dim=1) <= 0) & (not cameras.parallel)
    least, most = place.amin(dim=1), place.amax(dim=1)
    least[across, 1:], most[across, 1:] = 0.0, torch.inf
    low = least.floor().clamp_min(0).minimum(sizes)
    high = (most.floor() + 2).clamp_min(0).minimum(sizes)
    low, high = (low / multiple).floor() * multiple, (high / multiple).ceil() * multiple
    count = (high - low).amax(dim=0).clamp_min(multiple)
    count = torch.where(sizes % multiple > 0, sizes, count.minimum(sizes)).long()
    first = low.long().minimum(sizes - count)
    d, v, u = count.tolist()
    return Window(first, (d, v, u))


def held_bricks(mask: Bool[Tensor, "b 1 d h w"]) -> Bool[Tensor, "z y x"]:
    """The bricks, at most 16 along each axis, in which any of the masks holds a voxel."""
    edge = _edge(mask.shape[2:])
    return max_pool3d(mask.any(dim=0).float(), edge, ceil_mode=True)[0] > 0


def brick_corners(grid: Grid, bricks: Bool[Tensor, "z y x"] | None = None) -> Float[Tensor, "n 3"]:
    """World positions in mm of the corners of those bricks of a grid; of its box, where there is
    none.
    """
    if bricks is None or not bricks.any():
        return grid.corners()
    around = pad(bricks.float(), (1, 1, 1, 1, 1, 1))[None]
    index = (max_pool3d(around, 2, stride=1)[0] > 0).nonzero().cpu() * _edge(grid.shape)
    index = index.minimum(torch.tensor(grid.shape))
    return grid.to_world(index.flip(1).double() - 0.5)


def _edge(shape: Sequence[int]) -> int:
    """Of a brick, in voxels."""
    return -(-max(shape) // BRICKS)
