"""The field that a rig sees: its isocentre, a grid for it, and a check that the rig sees a grid."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.culling import views_that_see
from mvrecon.geometry.cameras.detector import detector_centre
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import unit

#: Of a full set of directions: beams nearer to one direction than this have no isocentre.
ONE_SIDED = 1e-4
#: Halvings that find a field's edge: 2^-40 of the rig's size.
HALVINGS = 40


def isocentre(cameras: Cameras) -> Float[Tensor, "3"]:
    """Isocentre in world mm: the point nearest to all principal rays (least squares).

    A principal ray runs through the source, square to the detector, wherever the detector's middle
    is; of a parallel beam, through the detector's middle.

    Raises:
        ValueError: beams of one direction alone, which meet nowhere in particular.
    """
    if cameras.parallel:
        start, way = detector_centre(cameras), unit(cameras.origin - cameras.source)
    else:
        start, way = cameras.source, unit(torch.linalg.cross(cameras.u, cameras.v))
    across = torch.eye(3).to(way) - way[:, :, None] * way[:, None, :]
    total = across.mean(dim=0)
    if torch.linalg.eigvalsh(total)[0] < ONE_SIDED:
        raise ValueError(
            f"expected views from at least two directions to find an isocentre, got {len(cameras)} "
            f"of nearly one; say the grid"
        )
    return torch.linalg.solve(total, (across @ start[..., None])[..., 0].mean(dim=0))


def sees(cameras: Cameras, xyz: Float[Tensor, "n 3"]) -> Bool[Tensor, "m n"]:
    """Which points in world mm each camera sees: on its detector, and where its rays count."""
    uvz = cameras.project(xyz)
    edge = uvz.new_tensor(cameras.shape[::-1]) - 0.5
    within = ((uvz[..., :2] >= -0.5) & (uvz[..., :2] <= edge)).all(dim=-1)
    return within & cameras.valid(uvz)


@torch.no_grad()
def common_field(cameras: Cameras, grid: Grid) -> Bool[Tensor, "1 d h w"]:
    """The common field of view: the voxels whose centres all cameras see.

    Raises:
        ValueError: there is none.
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
    """Grid about the isocentre over the field that all views see, with the detector's resolution
    there, in mm.

    The box reaches, along x, y and z through the isocentre, as far as the views see; its corners
    may be seen by fewer. The voxel is the finest pixel's pitch, demagnified to the isocentre.

    Args:
        cameras: the rig.
        size: voxels along (x, y, z) in place of the detector's resolution; they are cubes that
            cover the same field.
        seen_by: the share of the views that must see a point; 0.5 for a detector shifted aside to
            double the field (half fan).

    Raises:
        ValueError: beams of one direction, an isocentre that too few views see, a share outside 0
            to 1, or a grid that does not fit into memory.
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
            f"right?"
        )
    ends = torch.stack([rig.source, detector_centre(rig)]) - centre
    high = torch.full_like(low, 2 * ends.norm(dim=-1).max().item())
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        inside = enough(middle)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    extent = low[:3] + low[3:]
    centre = centre + (low[:3] - low[3:]) / 2
    if size is not None:
        step = (extent / extent.new_tensor(list(size))).max().item()
        return Grid.centred(size=size, spacing=step, centre=centre.tolist())
    step = resolution(rig, centre)
    counts = [max(1, math.ceil(mm / step - 1e-6)) for mm in extent.tolist()]
    return Grid.centred(size=counts, spacing=step, centre=centre.tolist())


def resolution(cameras: Cameras, point: Float[Tensor, "3"]) -> float:
    """The median over views of the finer pixel pitch, demagnified to a point, in mm."""
    pitch = torch.minimum(cameras.u.norm(dim=-1), cameras.v.norm(dim=-1))
    if not cameras.parallel:
        pitch = pitch * (cameras.project(point)[:, 2] / cameras.distance).abs()
    return pitch.median().item()


def check_rig_sees(cameras: Cameras, grid: Grid) -> Bool[Tensor, " m"]:
    """Which views see a grid's box; refuses a rig of which none does.

    Raises:
        ValueError: no view meets the box; the message tells where the box and the isocentre are, in
            mm.
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
