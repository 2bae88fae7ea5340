"""Which cameras see a grid's box, and at which depths in mm: every view's pyramid cut with the box,
both intersections of half-spaces.

The cut is convex and bounded, so it is empty where it has no corner, and its depths are those of
its corners. Every corner is the meeting point of three of the (at most twelve) planes; it is kept
where it satisfies all others.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.lattice import centred_affine

#: Of half a box: how far a corner may miss a half-space. Above all rounding, so that nothing seen
#: is lost.
SLACK = 1e-6
#: Three unit normals with a smaller determinant meet nowhere in particular; other corners of the
#: cut are close by.
FLAT = 1e-9


@torch.no_grad()
def views_that_see(cameras: Cameras, grid: Grid, margin: float = 0.5) -> Bool[Tensor, " m"]:
    """Which cameras have a ray, between their detector's outer edges, that meets the grid's box.

    Exact but for `SLACK`, on the side of seeing: a camera that is not chosen has views of nothing,
    whatever the volume.

    Args:
        cameras: the rig.
        grid: whose box is meant; a cropped one for a region of interest.
        margin: voxels by which the box grows on every side; 0.5 is as far as interpolation between
            voxels reaches.
    """
    return _cut(cameras, grid, margin)[1].any(dim=1)


@torch.no_grad()
def seen_depth_range(cameras: Cameras, grid: Grid) -> Float[Tensor, "m 2"]:
    """The least and the greatest depth z in mm of what each camera sees of the grid's box,
    detectors' edges included.

    `Cameras.depth_range` less what lies beside the field of view or outside the part of the ray
    that counts. A camera that sees nothing of the box has the box's whole range, and one that sees
    all of it has it to the last bit.
    """
    whole = cameras.depth_range(grid)
    z, kept = _cut(cameras, grid, 0.0)
    nearest = torch.where(kept, z, torch.inf).amin(dim=1).clamp(*whole.T)
    farthest = torch.where(kept, z, -torch.inf).amax(dim=1).clamp(*whole.T)
    visible = torch.stack([nearest, farthest], dim=1)
    less = (visible - whole).abs() > SLACK * (whole[:, 1:] - whole[:, :1])
    return torch.where(kept.any(dim=1)[:, None] & less, visible, whole)


def _cut(
    cameras: Cameras, grid: Grid, margin: float
) -> tuple[Float[Tensor, "m k"], Bool[Tensor, "m k"]]:
    """Depths in mm of where any three planes meet, and which of these are corners of a view cut
    with the box.
    """
    half = torch.tensor(grid.shape[::-1], dtype=torch.float64) / 2 + margin
    world = centred_affine(grid) @ torch.diag(
        torch.cat([half, half.new_ones(1)])
    )  # of points in the cube -1 .. 1
    frame = replace(cameras, parallel=False).matrix @ world.to(cameras.source)
    cube = torch.cat([torch.eye(3), -torch.eye(3)]).to(frame)
    cube = torch.cat([cube, cube.new_ones(6, 1)], dim=1).expand(len(frame), 6, 4)
    cuts = [_corners(torch.cat([view, cube], dim=1)) for view in _views(frame, cameras)]
    corners, kept = (torch.cat(parts, dim=1) for parts in zip(*cuts, strict=True))
    w = (corners * frame[:, 2:, :3]).sum(-1) + frame[:, 2:, 3]
    return w * cameras.distance[:, None], kept


def _views(frame: Float[Tensor, "m 3 4"], cameras: Cameras) -> Iterator[Float[Tensor, "m n 4"]]:
    """The half-spaces n . (x, 1) >= 0 that make up each view, twice where both sides of a source
    count.

    The rows of `frame` are (u w, v w, w) of a point, and (u, v, w) for a parallel beam.
    """
    u, v, w = frame.unbind(dim=1)
    one = w.new_tensor([0, 0, 0, 1]).expand_as(w)
    (least, most), (rows, columns) = cameras.ray_extent, cameras.shape
    ends = [
        plane
        for plane, end in ((w - least * one, least), (most * one - w, most))
        if abs(end) < torch.inf
    ]
    for side in (
        (1,) if cameras.parallel else [sign for sign, end in ((-1, least), (1, most)) if end]
    ):
        scale = one if cameras.parallel else side * w
        edges = [(side * u, columns), (side * v, rows)]
        across = [
            plane for at, count in edges for plane in (at + scale / 2, (count - 0.5) * scale - at)
        ]
        yield torch.stack([*across, *ends], dim=1)


def _corners(planes: Float[Tensor, "m n 4"]) -> tuple[Float[Tensor, "m k 3"], Bool[Tensor, "m k"]]:
    """Where every three planes meet (Cramer's rule), and which of these points satisfy all
    half-spaces.
    """
    planes = planes / planes[..., :3].norm(dim=-1, keepdim=True)
    triples = torch.tensor(list(combinations(range(planes.shape[1]), 3)), device=planes.device)
    a, b, c = planes[:, triples].unbind(dim=2)
    bc, ca, ab = (torch.linalg.cross(x[..., :3], y[..., :3]) for x, y in ((b, c), (c, a), (a, b)))
    volume = (a[..., :3] * bc).sum(-1, keepdim=True)
    meets = volume.abs() > FLAT
    corners = -(a[..., 3:] * bc + b[..., 3:] * ca + c[..., 3:] * ab) / torch.where(
        meets, volume, 1.0
    )
    within = corners @ planes[..., :3].mT + planes[:, None, :, 3] > -SLACK
    return corners, within.all(dim=-1) & meets[..., 0]
