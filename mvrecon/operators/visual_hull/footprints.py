"""Footprints, the rectangles of pixels onto which bricks of voxels project, and sums of views over
them in constant time, for the bricks that stay.

A brick on one side of a camera's source has its image between those of its corners, as it is
convex. Sums over rectangles are four reads of a summed-area table (Crow, SIGGRAPH 1984).

Convention: bounds are half-open: of voxels (z, y, x) as in `Box`, of pixels (u, v) = (column, row).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, bricks_along
from mvrecon.kernels.cuda.bricks import Prints, Rule
from mvrecon.kernels.rays.lines import beside

#: Part of a pixel by which rounding to float32 may shift a ray.
ROUNDING_PX = 1e-3


@dataclass(frozen=True, eq=False)
class Bricks:
    """N boxes of voxels, cubes of one edge except at the grid's end.

    Args:
        low: first voxel of every brick along (z, y, x).
        high: one past the last.
    """

    low: Int[Tensor, "n 3"]
    high: Int[Tensor, "n 3"]

    @classmethod
    def at(cls, places: Int[Tensor, "n 3"], edge: int, shape: Sequence[int]) -> "Bricks":
        """The bricks at indices (z, y, x) of the lattice with that edge in voxels; the last are cut
        at the grid's end.
        """
        low = places * edge
        return cls(low, torch.minimum(low + edge, low.new_tensor(list(shape))))

    def __len__(self) -> int:
        return len(self.low)


@dataclass(frozen=True, eq=False)
class BrickFootprints:
    """The footprint of every brick in every view: the pixels whose rays may meet the brick.

    Args:
        low: first column and row (u, v), within the detector.
        high: one past the last; equal to `low` if the camera does not see the brick.
        whole: the camera sees all of the brick: its footprint, grown by at most a diagonal of a
            pixel, ends within the detector, and it lies in the range of the rays.
    """

    low: Int[Tensor, "2 m n"]
    high: Int[Tensor, "2 m n"]
    whole: Bool[Tensor, "m n"]


def footprints(
    cameras: Cameras, grid: Grid, bricks: Bricks, reach: float = 0.5, gaps: float = 0.0
) -> BrickFootprints:
    """The footprints of bricks in all views, in float64.

    Args:
        cameras: the rig.
        grid: grid of the bricks' voxels.
        bricks: N of them; all cameras' corners are held at once, 500 bytes per brick and camera.
        reach: voxels by which interpolation extends a value beyond the faces of its voxel: 0.5 for
            joseph and trilinear (a voxel from its centre), 0 for siddon.
        gaps: number of gaps between rays; from 1 on, footprints grow for bodies between rays, by
            half a pixel and half of so many diagonals of one, as all rays of a brick's own
            footprint may miss a body's part in it. With 1, a ray of the grown footprint meets every
            ball as wide as a pixel's diagonal magnified to there (`ray_gap`); larger values meet
            more of thinner bodies.
    """
    return footprints_of(prints_of(cameras, grid, gaps), cameras.shape, grid.shape, bricks, reach)


def footprints_of(
    prints: Prints, detector: Sequence[int], shape: Sequence[int], bricks: Bricks, reach: float
) -> BrickFootprints:
    """The footprints of bricks of a grid of `shape`, on detectors of (rows, columns)."""
    numbers, (first, last) = prints.numbers, prints.window
    margin, more = (numbers[:, part].T[..., None] for part in (slice(12, 14), slice(15, 17)))
    slack = numbers[:, 14:15]
    images, w = _images(prints, shape, bricks, reach)
    near, far = w.amin(dim=1), w.amax(dim=1)
    across = (near <= 0) & (far >= 0) & (not prints.parallel)  # its image may be anywhere
    unseen = (far <= first) | (near >= last)
    low, high = images.amin(dim=2) - margin - ROUNDING_PX, images.amax(dim=2) + margin + ROUNDING_PX
    size = low.new_tensor(detector[::-1]).reshape(2, 1, 1)
    whole = (
        ((low > -1) & (high < size)).all(dim=0)
        & (near >= first + slack)
        & (far <= last - slack)
        & ~across
    )
    low = torch.where(across, 0, (low - more).ceil()).clamp(min=0).minimum(size)
    high = torch.where(across, size, (high + more).floor() + 1).minimum(size)
    return BrickFootprints(
        low.long(), torch.where(unseen, low, torch.maximum(low, high)).long(), whole
    )


def prints_of(cameras: Cameras, grid: Grid, gaps: float) -> Prints:
    """Return the data from which a rig's footprints are computed, on the cameras' device; `gaps` as
    of `footprints`.
    """
    # margin: greatest distance in pixels (u, v) from a point's image to the nearest ray through any
    # ball that holds the point and is a pixel's diagonal wide: the ball's centre is at most half a
    # diagonal away, and half a pixel along each axis from a ray; slack: that diagonal as a fraction
    # of the way from source to detector
    u, v, diagonal = cameras.u.detach(), cameras.v.detach(), _diagonals(cameras)
    area = torch.linalg.cross(u, v).norm(dim=-1)
    pitch = torch.stack([area / v.norm(dim=-1), area / u.norm(dim=-1)])  # of columns, of rows
    margin = 0.5 + (diagonal / (2 * pitch)).T
    slack = (diagonal / cameras.distance.detach())[:, None]
    if not gaps:
        margin, slack = torch.zeros_like(margin), torch.zeros_like(slack)
    more = max(0.0, gaps - 1) * (margin - 0.5)
    # maps: from voxels about the grid's centre to pixels (u w, v w, w), of parallel beams (u, v,
    # w); cameras are never flat, so the inverse needs no check, which would synchronise
    inverse = torch.linalg.inv_ex(cameras.frame.detach()).inverse
    turn = inverse @ beside(grid.affine[:3, :3], inverse)
    shift = inverse @ (beside(grid.centre, inverse) - cameras.source.detach())[..., None]
    maps = torch.cat([turn, shift], dim=-1)
    numbers = torch.cat([maps.flatten(1), margin, slack, more], dim=1)
    return Prints(numbers, cameras.ray_extent, cameras.parallel)


def _images(
    prints: Prints, shape: Sequence[int], bricks: Bricks, reach: float
) -> tuple[Float[Tensor, "2 m 8 n"], Float[Tensor, "m 8 n"]]:
    """Pixels (u, v) of the corners of bricks grown by `reach`, not finite where w = 0; and w."""
    maps = prints.numbers[:, :12].unflatten(1, (3, 4))
    sides = [(bricks.low.to(maps), -reach), (bricks.high.to(maps), reach)]
    faces = [
        [index[:, 2 - axis] - shape[2 - axis] / 2 + by for axis in range(3)] for index, by in sides
    ]
    one = torch.ones_like(faces[0][0])
    corners = [
        torch.stack([faces[i][0], faces[j][1], faces[k][2], one])
        for i, j, k in product((0, 1), repeat=3)
    ]
    q = (maps.transpose(0, 1).reshape(-1, 4) @ torch.cat(corners, dim=1)).reshape(
        3, len(maps), 8, -1
    )
    return (q[:2] if prints.parallel else q[:2] / q[2]), q[2]


def ray_gap(cameras: Cameras, grid: Grid) -> float:
    """Return the widest diagonal of a pixel, magnified to the grid, in mm: a ball of that diameter
    cannot pass between the rays of any view; 0 if no view's rays pass the grid.
    """
    diagonal = _diagonals(cameras)
    if cameras.parallel:
        return diagonal.amax().item()
    w = cameras.depth_range(grid).detach() / cameras.distance.detach()[:, None]
    first, last = cameras.ray_extent
    return (diagonal * w.clamp(first, last).abs().amax(dim=-1)).amax().item()


def _diagonals(cameras: Cameras) -> Float[Tensor, " m"]:
    """The longer diagonal of each camera's pixels in mm."""
    u, v = cameras.u.detach(), cameras.v.detach()
    return torch.maximum((u + v).norm(dim=-1), (u - v).norm(dim=-1))


def summed_area_tables(images: Shaped[Tensor, "*n v u"]) -> Int[Tensor, "*n v1 u1"]:
    """Return the summed-area tables of integer images: at every pixel corner the exact sum of all
    pixels above and to the left.
    """
    dtype = torch.int32 if images.dtype == torch.bool else torch.int64
    sums = images.cumsum(dim=-1, dtype=dtype).cumsum(dim=-2, dtype=dtype)
    return torch.nn.functional.pad(sums, (1, 0, 1, 0))


def footprint_sums(
    table: Int[Tensor, "*b m v1 u1"], prints: BrickFootprints
) -> Int[Tensor, "*b m n"]:
    """Sums of views over every footprint, from the views' summed-area tables."""
    width = table.shape[-1]
    flat = table.flatten(-2)
    (u0, v0), (u1, v1) = prints.low, prints.high

    def corner(v: Tensor, u: Tensor) -> Tensor:
        index = v * width + u
        return flat.gather(-1, index.expand(*flat.shape[:-1], -1))

    return corner(v1, u1) - corner(v0, u1) - corner(v1, u0) + corner(v0, u0)


#: Footprints at a time, which bounds the memory (500 bytes a footprint).
AT_ONCE = 2**15


def kept_bricks(
    tables: Int[Tensor, "b m v1 u1"], prints: Prints, rule: Rule, shape: Sequence[int]
) -> Bool[Tensor, "b z y x"]:
    """The bricks of a grid of `shape` that stay, from the summed-area tables of the views'
    foreground.
    """
    numbers, window, parallel = prints
    return _kept_bricks(tables, numbers, list(window), parallel, [*rule], list(shape))


def proofs(
    tables: Int[Tensor, "b m v1 u1"], prints: BrickFootprints
) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """The number of views that prove a brick empty, and whether no view has foreground in it."""
    none = footprint_sums(tables, prints) == 0
    return (none & prints.whole).sum(dim=1, dtype=torch.int32), none.all(dim=1)


@torch.library.custom_op("mvrecon::kept_bricks", mutates_args=(), device_types="cpu")
def _kept_bricks(
    tables: Tensor,
    numbers: Tensor,
    window: Sequence[float],
    parallel: bool,
    rule: Sequence[float],
    shape: Sequence[int],
) -> Tensor:
    """The bricks that stay; see `kept_bricks`."""
    prints, (edge, reach, enough, keep_unseen) = Prints(numbers, window, parallel), rule
    detector = [n - 1 for n in tables.shape[2:]]
    counts = bricks_along(shape, int(edge))
    places = torch.ones(counts, dtype=torch.bool).nonzero()
    parts = []
    for part in places.split(max(1, AT_ONCE // max(1, tables.shape[0] * tables.shape[1]))):
        bricks = Bricks.at(part, int(edge), shape)
        empty, dark = proofs(tables, footprints_of(prints, detector, shape, bricks, reach))
        parts.append((empty < enough) & (~dark | bool(keep_unseen)))
    return torch.cat(parts, dim=1).unflatten(1, counts)


@_kept_bricks.register_kernel("cuda")
def _(tables, numbers, window, parallel, rule, shape):
    from mvrecon.kernels.cuda.bricks import kept_bricks

    edge, reach, enough, keep_unseen = rule
    kept = Rule(int(edge), reach, int(enough), bool(keep_unseen))
    return kept_bricks(tables, Prints(numbers, window, parallel), kept, shape)


@_kept_bricks.register_fake
def _(tables, numbers, window, parallel, rule, shape):
    counts = bricks_along(shape, int(rule[0]))
    return tables.new_empty([len(tables), *counts], dtype=torch.bool)
