"""The field of view of a rig: its isocentre, a grid for it, and the cameras and depths that see a
grid's box.

The visible part of a box is the intersection of a camera's pyramid with it, convex and bounded:
empty without corners, and with the depth range of its corners. Corners are the intersections of
three of the (at most twelve) planes that satisfy all others.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.lattice import centred_affine
from mvrecon.geometry.rigid import unit

#: Least spread of directions relative to an isotropic set; below, beams have no isocentre.
MIN_DIRECTION_SPREAD = 1e-4
#: Least voxels of an automatic grid's edge relative to the pixels of the detector's shorter side.
MIN_EDGE_SHARE = 0.1
#: Part of a voxel by which the field may be longer than an automatic grid: one row has one slice,
#: also if it is tilted, or its pixels are a little taller than wide. Two would leave the row on the
#: source's side of the isocentre.
MAX_BEYOND = 0.25
#: Bisection steps to a field's edge: 2^-40 of the rig's size.
BISECTION_STEPS = 40
#: Greatest ratio of the detector's widths on both sides of the isocentre in a half fan, and widest
#: gap between its views, in steps of an even circle of as many directions, or as an angle.
MAX_WIDTH_RATIO, MAX_GAP_STEPS, MAX_GAP = 0.75, 2.0, math.radians(15.0)
#: Views within this angle are exposures of one direction, as encoders repeat it.
SAME_ANGLE = math.radians(0.05)
#: Rounding of pixels, ratios and angles, which decides nothing.
ROUNDING_ERROR = 1e-6


def isocentre(cameras: Cameras) -> Float[Tensor, "3"]:
    """Return the isocentre in world mm: the least-squares intersection of all principal rays.

    A principal ray passes through the source, perpendicular to the detector; of a parallel beam,
    through the detector's centre.

    Raises:
        ValueError: beams of a single direction.
    """
    if cameras.parallel:
        start, way = cameras.detector_centre, unit(cameras.origin - cameras.source)
    else:
        start, way = cameras.source, unit(torch.linalg.cross(cameras.u, cameras.v))
    across = torch.eye(3).to(way) - way[:, :, None] * way[:, None, :]
    total = across.mean(dim=0)
    if torch.linalg.eigvalsh(total)[0] < MIN_DIRECTION_SPREAD:
        raise ValueError(
            f"expected views from at least two directions to find an isocentre, got {len(cameras)} "
            f"of nearly one; give the grid explicitly"
        )
    return torch.linalg.solve(total, (across @ start[..., None])[..., 0].mean(dim=0))


def sees(cameras: Cameras, xyz: Float[Tensor, "n 3"]) -> Bool[Tensor, "m n"]:
    """Whether each camera sees points in world mm: on its detector, edges included, within the
    valid range of rays.
    """
    uvz = cameras.project(xyz)
    half = uvz.new_tensor(cameras.shape[::-1]) / 2
    within = ((uvz[..., :2] + 0.5 - half).abs() <= half + ROUNDING_ERROR).all(dim=-1)
    return within & cameras.valid(uvz)


@torch.no_grad()
def common_field(cameras: Cameras, grid: Grid) -> Bool[Tensor, "1 d h w"]:
    """Return the common field of view: the voxels whose centres all cameras see.

    Raises:
        ValueError: it is empty.
    """
    rig, points = cameras.to("cpu"), voxel_centres(grid).reshape(-1, 3)
    for camera in range(len(rig)):
        points = points[sees(rig[[camera]], points)[0]]
    if not len(points):
        raise ValueError(f"Expected a voxel that all of {len(rig)} cameras see, got none")
    z, y, x = grid.to_index(points).round().long().flip(-1).unbind(-1)
    field = torch.zeros(1, *grid.shape, dtype=torch.bool)
    field[0, z, y, x] = True
    return field.to(cameras.source.device)


@torch.no_grad()
def auto_grid(cameras: Cameras, size: Sequence[int] | None = None, seen_by: float = 1.0) -> Grid:
    """Return a grid about the isocentre over the common field of view, with the detector's
    resolution there, in mm.

    The box extends along x, y and z through the isocentre as far as the field, to a quarter of a
    voxel, and so contains what all views see whole. Fewer views may see its corners: of cones, at a
    distance r from the axis, all see 1 - r / SID of its height. The box is centred on the
    field, which is beside the isocentre where more views see one side, as for a part of a helix.
    The voxel is the finest pixel's pitch, demagnified to the isocentre.

    Args:
        cameras: the rig.
        size: voxels along (x, y, z) instead of the detector's resolution; they are cubes that cover
            the same field.
        seen_by: share of the views that must see a point; of a half fan see `full_fan`.

    Raises:
        ValueError: beams of one direction, an isocentre that too few views see, a field much
            smaller than the detector, a share outside (0, 1], or a grid that does not fit into
            memory.
    """
    if not 0 < seen_by <= 1:
        raise ValueError(f"expected a share of the views above 0 and up to 1, got {seen_by}")
    rig = cameras.to("cpu")
    centre = isocentre(rig)
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(centre)

    def enough(reach: Tensor) -> Tensor:
        share = sees(rig, centre + reach[:, None] * axes).double().mean(dim=0)
        return share >= seen_by - 1e-9

    low = torch.zeros(6).to(centre)
    if not enough(low).all():
        raise ValueError(
            f"expected {seen_by:.0%} of the views to see the isocentre "
            f"{[round(mm, 3) for mm in centre.tolist()]} mm, got "
            f"{sees(rig, centre[None]).double().mean().item():.0%}; are detector offsets and axes "
            f"right? Of a helix, say, take a smaller share (seen_by), or give the grid explicitly"
        )
    # a parallel field may be wider than its rays are drawn long
    ends = torch.stack([rig.source, 2 * rig.detector_centre - rig.origin, rig.origin]) - centre
    high = torch.full_like(low, 2 * ends.norm(dim=-1).max().item())
    for _ in range(BISECTION_STEPS):
        middle = (low + high) / 2
        inside = enough(middle)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    extent = low[:3] + low[3:]
    step = resolution(rig, centre)
    centre = centre + (low[:3] - low[3:]) / 2
    if size is not None:
        step = (extent / extent.new_tensor(list(size))).max().item()
        return Grid.centred(size=size, spacing=step, centre=centre.tolist())
    counts = [max(1, math.ceil(mm / step - MAX_BEYOND)) for mm in extent.tolist()]
    if min(counts) < min(rig.shape) * MIN_EDGE_SHARE:
        raise ValueError(
            f"expected a common field of view of about {min(rig.shape)} voxels, the detector's "
            f"shorter side, got {' x '.join(map(str, counts))} along (x, y, z); are detector "
            f"offsets and axes right? For an offset detector (half fan), take "
            f"auto_grid(full_fan(cameras)), or give the grid explicitly"
        )
    return Grid.centred(size=counts, spacing=step, centre=centre.tolist())


def extended_to_field(cameras: Cameras, grid: Grid) -> Grid:
    """A grid with more voxels on each side where it ends inside the field of half of the views, by
    more than half of a pixel's image; the grid itself for a rig without such a field.
    """
    try:
        field = auto_grid(cameras, seen_by=0.5)
    except ValueError:  # of a rig without a common field
        return grid
    low, high = grid.to_index(field.corners()).aminmax(dim=0)
    # above rounding
    slack = max(field.spacing) / 2 / low.new_tensor(grid.spacing) + 1e-6
    before = (-0.5 - slack - low).ceil().clamp_min(0)
    after = (high - low.new_tensor(grid.size) + 0.5 - slack).ceil().clamp_min(0)
    affine = grid.affine.clone()
    affine[:3, 3] = grid.to_world(-before)
    more = (before + after).long().tolist()
    x, y, z = (n + k for n, k in zip(grid.size, more, strict=True))
    return Grid((z, y, x), affine)


def half_fan(cameras: Cameras) -> bool:
    """Whether a rig is a half fan: views all around the isocentre, with detectors that reach
    farther on the same side of it, so that half of the views see the outer field.
    """
    return full_fan(cameras) is not cameras


def full_fan(cameras: Cameras) -> Cameras:
    """A half fan with detectors that reach as far on the narrow side as on the wide one: all of its
    views see the field whose lines the half fan measures; any other rig as it is.
    """
    rig = cameras.to("cpu")
    try:
        centre = isocentre(rig)
    except ValueError:
        return cameras
    column = rig.project(centre)[:, 0]
    left, right = column + 0.5, rig.shape[1] - 0.5 - column
    ratio = torch.minimum(left, right) / torch.maximum(left, right)
    if not (ratio.max() < MAX_WIDTH_RATIO + ROUNDING_ERROR and left.min() > 0):
        return cameras
    one_sided = (left < right).all() or (left > right).all()
    ways = unit(rig.origin - rig.source if rig.parallel else centre - rig.source)
    # of a circle, the last one is the axis of rotation
    axes = torch.linalg.svd(ways, full_matrices=False).Vh
    angles = torch.atan2(ways @ axes[1], ways @ axes[0]).sort().values
    gaps = torch.cat([angles, angles[:1] + 2 * math.pi]).diff()
    directions, last = 0, -math.inf
    for angle in angles.tolist():  # a fine scan has steps below those of repeated directions
        if angle - last > SAME_ANGLE:
            directions, last = directions + 1, angle
    widest = max(MAX_GAP, MAX_GAP_STEPS * 2 * math.pi / directions)
    if not one_sided or directions < 3 or gaps.max() > widest + ROUNDING_ERROR:
        return cameras
    more = math.ceil((left - right).abs().max().item() - ROUNDING_ERROR)
    first = cameras.source.new_tensor([[-float(more) if left[0] < right[0] else 0.0, 0.0]])
    return replace(cameras.shifted(first), shape=(rig.shape[0], rig.shape[1] + more))


def resolution(cameras: Cameras, point: Float[Tensor, "3"]) -> float:
    """The median over views of the finer pixel pitch, demagnified to a point, in mm."""
    pitch = torch.minimum(cameras.u.norm(dim=-1), cameras.v.norm(dim=-1))
    if not cameras.parallel:
        pitch = pitch * (cameras.project(point)[:, 2] / cameras.distance).abs()
    return pitch.median().item()


def pixels_of_voxel(cameras: Cameras, grid: Grid) -> int:
    """Whole pixels that the image of a voxel at the grid's centre holds along its longest edge, one
    at least; rounding does not decide them.
    """
    return max(1, int(max(grid.spacing) / resolution(cameras, grid.centre) + ROUNDING_ERROR))


def check_rig_sees(cameras: Cameras, grid: Grid) -> Bool[Tensor, " m"]:
    """Return which views see a grid's box; raises if none does.

    Raises:
        ValueError: no view meets the box; the message gives box and isocentre in mm.
    """
    meeting = views_that_see(cameras, grid)
    if meeting.any():
        return meeting
    low, high = grid.corners().aminmax(dim=0)
    box = ", ".join(
        f"{axis} {a:.4g} to {b:.4g}"
        for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    )
    try:
        middle = f"at {[round(mm, 1) for mm in isocentre(cameras).tolist()]} mm"
    except ValueError:
        middle = "nowhere"
    raise ValueError(
        f"expected a rig that sees the grid, got {len(cameras)} views that all miss it: it spans "
        f"{box} mm, and the views' axes meet {middle}; look at the picture of the rig"
    )


#: Tolerance of half-spaces relative to half a box, above rounding, so that no visible part is lost.
PLANE_TOLERANCE = 1e-6
#: Least determinant of three unit normals; other corners of the intersection are near by.
MIN_DETERMINANT = 1e-9


@torch.no_grad()
def views_that_see(cameras: Cameras, grid: Grid, margin: float = 0.5) -> Bool[Tensor, " m"]:
    """Return which cameras have a ray, between their detector's outer edges, that meets the grid's
    box.

    Exact up to `PLANE_TOLERANCE`, towards seeing: other cameras have zero views of any volume.

    Args:
        cameras: the rig.
        grid: its box; cropped for a region of interest.
        margin: voxels by which the box is enlarged on every side; 0.5 is the reach of interpolation
            between voxels.
    """
    return _cut(cameras, grid, margin)[1].any(dim=1)


@torch.no_grad()
def seen_depth_range(cameras: Cameras, grid: Grid) -> Float[Tensor, "m 2"]:
    """Return the least and greatest depth z in mm of the visible part of the grid's box for each
    camera, detectors' edges included.

    `Cameras.depth_range` without parts outside the field of view or the valid range of rays. For a
    camera that sees none of the box it is the box's whole range, for one that sees all of it the
    bitwise equal range.
    """
    whole = cameras.depth_range(grid)
    z, kept = _cut(cameras, grid, 0.0)
    nearest = torch.where(kept, z, torch.inf).amin(dim=1).clamp(*whole.T)
    farthest = torch.where(kept, z, -torch.inf).amax(dim=1).clamp(*whole.T)
    visible = torch.stack([nearest, farthest], dim=1)
    less = (visible - whole).abs() > PLANE_TOLERANCE * (whole[:, 1:] - whole[:, :1])
    return torch.where(kept.any(dim=1)[:, None] & less, visible, whole)


def _cut(
    cameras: Cameras, grid: Grid, margin: float
) -> tuple[Float[Tensor, "m k"], Bool[Tensor, "m k"]]:
    """Depths in mm of the intersections of any three planes, and whether they are corners of a view
    cut with the box.
    """
    half = torch.tensor(grid.shape[::-1], dtype=torch.float64) / 2 + margin
    cube_to_box = torch.diag(torch.cat([half, half.new_ones(1)]))
    world = centred_affine(grid) @ cube_to_box  # of points in the cube -1 .. 1
    frame = replace(cameras, parallel=False).matrix @ world.to(cameras.source)
    cube = torch.cat([torch.eye(3), -torch.eye(3)]).to(frame)
    cube = torch.cat([cube, cube.new_ones(6, 1)], dim=1).expand(len(frame), 6, 4)
    cuts = [_corners(torch.cat([view, cube], dim=1)) for view in _views(frame, cameras)]
    corners, kept = (torch.cat(parts, dim=1) for parts in zip(*cuts, strict=True))
    w = (corners * frame[:, 2:, :3]).sum(-1) + frame[:, 2:, 3]
    return w * cameras.distance[:, None], kept


def _views(frame: Float[Tensor, "m 3 4"], cameras: Cameras) -> Iterator[Float[Tensor, "m n 4"]]:
    """The half-spaces n . (x, 1) >= 0 that bound each view, twice if both sides of a source are
    valid.

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
    """The intersections of every three planes (Cramer's rule), and whether they satisfy all
    half-spaces.
    """
    planes = planes / planes[..., :3].norm(dim=-1, keepdim=True)
    triples = torch.tensor(list(combinations(range(planes.shape[1]), 3)), device=planes.device)
    a, b, c = planes[:, triples].unbind(dim=2)
    bc, ca, ab = (torch.linalg.cross(x[..., :3], y[..., :3]) for x, y in ((b, c), (c, a), (a, b)))
    volume = (a[..., :3] * bc).sum(-1, keepdim=True)
    meets = volume.abs() > MIN_DETERMINANT
    corners = -(a[..., 3:] * bc + b[..., 3:] * ca + c[..., 3:] * ab) / torch.where(
        meets, volume, 1.0
    )
    within = corners @ planes[..., :3].mT + planes[:, None, :, 3] > -PLANE_TOLERANCE
    return corners, within.all(dim=-1) & meets[..., 0]
