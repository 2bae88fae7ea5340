"""The geometry of a crop: its operator, the cameras that see it, and the part of each camera's
frustum that it needs.

Bins of a part are bins of the whole frustum, neither moved nor stretched: what is computed in a
part is what would be computed in the whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.culling import views_that_see
from mvrecon.geometry.box import Box
from mvrecon.geometry.frustum import depth_index
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import Spans
from mvrecon.models.frusta import Frusta, maps_between
from mvrecon.models.geometry import Geometry
from mvrecon.models.networks import MULTIPLE
from mvrecon.projectors.operator import Projector

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
        first = self.first[:, [2, 1]].to(cameras.source)
        return replace(cameras.shifted(first), shape=self.shape[1:])

    def edges(self, edges: Float[Tensor, "m e"]) -> Float[Tensor, "m f"]:
        """The planes between the window's depth bins, of those between all."""
        index = self.first[:, :1] + torch.arange(self.shape[0] + 1)
        return edges.gather(1, index.to(edges.device))

    def parts(self, values: Shaped[Tensor, "m *n"], axes: Sequence[int]) -> Shaped[Tensor, "m *k"]:
        """The window's part of each camera's values.

        Args:
            values: of all bins.
            axes: what their last axes run along: 0 depth, 1 rows, 2 columns.
        """
        # slices, since an index for each bin takes ten times as long
        ranges = [
            [slice(first[axis], first[axis] + self.shape[axis]) for axis in axes]
            for first in self.first.tolist()
        ]
        return torch.stack([x[..., *part] for x, part in zip(values, ranges, strict=True)])

    def spans(self, spans: Spans) -> Spans:
        """The window's part of rows of bins."""
        start = self.first[:, 2].to(spans.first).reshape(-1, 1, 1, 1)
        first, end = (
            (self.parts(index, (0, 1)) - start).clamp(0, self.shape[2])
            for index in (spans.first, spans.end)
        )
        return Spans(first, end, self.shape[2])


def cropped_geometry(
    whole: Geometry, box: Box, bricks: Bool[Tensor, "z y x"] | None = None
) -> Geometry:
    """The geometry of the voxels in a box, and of the cameras that see any of it.

    What the whole geometry holds already is copied from it.

    Args:
        whole: of the grid.
        box: the voxels.
        bricks: of the box, those that may be other than zero, from `occupied_bricks`: the frusta
            have no bins for others. None: all.
    """
    grid = whole.A.grid.cropped(box)
    index = _seeing(whole.A.cameras, grid).to(whole.row.device)
    A = cast(Projector, whole.A.cropped(box, index.tolist()))  # it keeps its grid and cameras
    crop = Geometry(A, whole.row[:, :, index], whole.column[..., *box.slices], index)
    if whole.frusta is None:
        return crop
    fine, coarse = whole.frusta
    binning = fine.shape[1] // coarse.shape[1]
    binned = A.cameras.binned(binning)
    window = window_of(brick_corners(grid, bricks), binned, coarse.edges[index])
    finer = window.scaled(2, binning)
    if fine.shape[0] % 2:  # coarse bins are no pairs of fine ones: both keep all of them
        window, finer = window.deep(coarse.shape[0]), finer.deep(fine.shape[0])
    parts = (
        _part(fine, index, box, finer, grid, A.cameras),
        _part(coarse, index, box, window, grid, binned),
    )
    return replace(crop, frusta=parts)


def _seeing(cameras: Cameras, grid: Grid) -> Int[Tensor, " k"]:
    """Which cameras see any of a grid; all of them, where none does."""
    seeing = views_that_see(cameras, grid)
    return (seeing if seeing.any() else ~seeing).nonzero()[:, 0]


def _part(
    whole: Frusta,
    index: Int[Tensor, " k"],
    box: Box,
    window: Window,
    grid: Grid,
    cameras: Cameras,
) -> Frusta:
    """A window of the frusta of some cameras; `grid` and `cameras` are the crop's."""
    cut = window.cameras(cameras)
    edges = window.edges(whole.edges[index]).to(cut.source)
    frusta_from_world, world_from_frusta = maps_between(grid, cut, edges)
    part = Frusta(
        frusta_from_world,
        world_from_frusta,
        edges,
        voxels=_within(whole.voxels, index, box),
        bins=window.spans(_of_cameras(whole.bins, index)),
        thickness=window.parts(whole.thickness[index], (0,)),
        slant=window.parts(whole.slant[index], (1, 2)),
        n_depths=whole.n_depths,
        first=window.first,
    )
    return part.to(whole.slant.device)


def _within(voxels: Spans, index: Int[Tensor, " k"], box: Box) -> Spans:
    """Rows of voxels of a box, for some cameras."""
    rows, columns = box.slices[:2], box.slices[2]
    width = columns.stop - columns.start
    first, end = (
        (place[index][..., *rows] - columns.start).clamp(0, width)
        for place in (voxels.first, voxels.end)
    )
    return Spans(first, end, width)


def _of_cameras(spans: Spans, index: Int[Tensor, " k"]) -> Spans:
    return replace(spans, first=spans.first[index], end=spans.end[index])


def window_of(
    corners: Float[Tensor, "n 3"], cameras: Cameras, edges: Float[Tensor, "m e"]
) -> Window:
    """The least window of frusta that holds every bin which the voxels of some boxes read, or are
    read by.

    Bounds are multiples of 4, so that the coarser levels of a network keep their places; an axis
    whose size is none is kept whole, and so are the pixels of a camera whose source lies between
    the planes that bound the boxes.

    Args:
        corners: of the boxes, in world mm.
        cameras: the rig.
        edges: the planes in mm between the whole frusta's depth bins.
    """
    uvz = cameras.project(corners.to(cameras.source)).cpu()  # [m n 3]
    place = torch.stack([depth_index(uvz[..., 2], edges.cpu()), uvz[..., 1], uvz[..., 0]], dim=-1)
    sizes = torch.tensor([edges.shape[1] - 1, *cameras.shape])
    across = (uvz[..., 2].amin(dim=1) * uvz[..., 2].amax(dim=1) <= 0) & (not cameras.parallel)
    least, most = place.amin(dim=1), place.amax(dim=1)
    least[across, 1:], most[across, 1:] = 0.0, torch.inf
    low = least.floor().clamp_min(0).minimum(sizes)
    high = (most.floor() + 2).clamp_min(0).minimum(sizes)
    low, high = (low / MULTIPLE).floor() * MULTIPLE, (high / MULTIPLE).ceil() * MULTIPLE
    count = (high - low).amax(dim=0).clamp_min(MULTIPLE)
    count = torch.where(sizes % MULTIPLE > 0, sizes, count.minimum(sizes)).long()
    first = low.long().minimum(sizes - count)
    d, v, u = count.tolist()
    return Window(first, (d, v, u))


def occupied_bricks(mask: Bool[Tensor, "b 1 d h w"]) -> Bool[Tensor, "z y x"]:
    """The bricks, at most 16 along each axis, in which any of the masks has a voxel."""
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
