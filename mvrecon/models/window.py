"""The part of each camera's frustum that a crop of the grid needs: some depths, rows and columns, as many for all.

Its bins are bins of the whole frustum, so what is worked out in a window is what would be worked out without it.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.culling import seen_depth_range
from mvrecon.geometry.frustum import depth_edges, depth_index
from mvrecon.geometry.grid import Grid


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
        """The same part of frusta whose bins are `depth` times as fine in depth, `pixels` times across."""
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
        m, _, rows, columns = (index[:, 0] for index in self._index(views.device))
        return views[:, :, m, rows, columns]

    def bins(self, values: Shaped[Tensor, "m 1 D v u"]) -> Shaped[Tensor, "m 1 E r s"]:
        """Values of all bins at those that are kept."""
        m, depths, rows, columns = self._index(values.device)
        return values[m, 0, depths, rows, columns][:, None]

    def _index(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Camera, depth, row and column of the bins, each with four axes."""
        first = self.first.to(device)[:, :, None, None, None]
        each = [torch.arange(n, device=device) for n in (len(first), *self.shape)]
        m, d, v, u = (axis.reshape([-1 if k == i else 1 for k in range(4)]) for i, axis in enumerate(each))
        return m, d + first[:, 0], v + first[:, 1], u + first[:, 2]


def window_of(crop: Grid, whole: Grid, cameras: Cameras, depth: int, multiple: int) -> Window:
    """The least window of frusta over a grid that holds every bin which the voxels of a crop read, or are read by.

    Bounds are multiples of a number, so that the coarser levels of a network keep their places; an axis whose size is
    none is kept whole, and so are the pixels of a camera whose source lies between the planes that bound the crop.

    Args:
        crop: the part of the grid.
        whole: the grid.
        cameras: the rig.
        depth: bins of the whole frusta along depth.
        multiple: that number.
    """
    seen = cameras.project(crop.corners().to(cameras.source)).cpu()  # [m 8 3]
    edges = depth_edges(seen_depth_range(cameras, whole), depth).cpu()
    place = torch.stack([depth_index(seen[..., 2], edges), seen[..., 1], seen[..., 0]], dim=-1)
    sizes = torch.tensor([depth, *cameras.shape])
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
