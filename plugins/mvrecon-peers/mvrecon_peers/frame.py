"""Transform a rig into the volume's own frame, which every library supports.

Libraries differ in the volumes and rays that they support. All of them support a volume whose axes
are x, y, z and whose centre is the origin, and rays between two points. A rig is therefore
transformed into that frame in float64, which removes the obliqueness of the grid and a distant
world origin; infinite rays are then truncated outside the box.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid


def framed(grid: Grid, cameras: Cameras) -> tuple[Grid, Cameras]:
    """The grid in its own frame, axis-aligned and centred at the origin, and the rig in this frame
    with its rays as segments.

    Differentiable in the cameras.

    Raises:
        ValueError: a grid with oblique axes, or cameras whose rays are not segments.
    """
    axes = grid.affine[:3, :3] / grid.affine[:3, :3].norm(dim=0)
    if not torch.allclose(axes.T @ axes, torch.eye(3, dtype=axes.dtype), atol=1e-6):
        raise ValueError(
            f"Other libraries take voxels with right angles, got axes with cosines "
            f"{(axes.T @ axes).tolist()}"
        )
    box = Grid.centred(size=grid.size, spacing=grid.spacing)
    return box, segments(box, cameras.moved(axes.T, -axes.T @ grid.centre))


def segments(box: Grid, cameras: Cameras) -> Cameras:
    """The same rays as segments from first to last point: a rig of extent "segment".

    Infinite rays are truncated outside the box. A detector behind a pinhole is replaced by its
    mirror image in front of it, and every detector is moved to the distance at which all pixels
    have the same size.

    Raises:
        ValueError: central cameras of extent "line", whose rays do not start at the source.
    """
    if cameras.extent == "segment":
        return cameras
    if cameras.extent == "line" and not cameras.parallel:
        raise ValueError(
            "Other libraries take rays that begin at their source, got central cameras of extent "
            "'line'"
        )
    margin = 2 * math.hypot(*box.spacing)  # outside the support of the kernel
    depth = cameras.depth_range(box).detach() + torch.tensor([-margin, margin]).to(cameras.source)
    w = depth / cameras.distance.detach()[:, None]
    low, high = w.clamp(*cameras.ray_extent).unbind(dim=-1)
    axis = cameras.origin - cameras.source
    if cameras.parallel:
        # a box on the excluded side leaves a ray of nearly zero length
        high = torch.maximum(high, low + 1e-6)
        source, origin = (cameras.source + end[:, None] * axis for end in (low, high))
        return replace(cameras, source=source, origin=origin, extent="segment")
    side = 1.0 if cameras.extent == "ahead" else -1.0
    pitch = cameras.u.detach().norm(dim=-1)
    reach = ((high if side > 0 else -low).clamp(min=1e-6) * pitch).max()
    k = (side * reach / pitch)[:, None]
    return replace(
        cameras,
        origin=cameras.source + k * axis,
        u=k * cameras.u,
        v=k * cameras.v,
        extent="segment",
    )


def chords(
    box: Grid, first: Float[Tensor, "*n 3"], last: Float[Tensor, "*n 3"], grown: float = 0.0
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Parameters at which lines enter and leave the box, extended by some voxels: 0 at `first`, 1
    at `last`.

    For a line that misses the box, the first is not less than the second.
    """
    half = first.new_tensor(box.spacing) * (first.new_tensor(box.shape[::-1]) / 2 + grown)
    way = last - first
    low, high = (((side * half - first) / way).nan_to_num(nan=side * torch.inf) for side in (-1, 1))
    return torch.minimum(low, high).amax(dim=-1), torch.maximum(low, high).amin(dim=-1)


def near(
    box: Grid, first: Float[Tensor, "*n 3"], last: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n 3"]]:
    """The same rays, truncated one voxel outside the box, since distant end points lose precision.

    A ray that stays farther away is replaced by one that misses the box. Differentiable in both end
    points.
    """
    enter, leave = (part[..., None] for part in chords(box, first.detach(), last.detach(), 1.5))
    start = torch.where(enter > 0, first + enter.clamp(0, 1) * (last - first), first)
    end = torch.where(leave < 1, first + leave.clamp(0, 1) * (last - first), last)
    met = (enter < leave) & (enter < 1) & (leave > 0)
    size = first.new_tensor(box.spacing) * (first.new_tensor(box.shape[::-1]) + 3)
    return torch.where(met, start, size), torch.where(
        met, end, size * size.new_tensor([1.0, 1.15, 1.3])
    )


def wants_gradient(cameras: Cameras) -> bool:
    """Whether the pose requires a gradient."""
    return any(getattr(cameras, name).requires_grad for name in VECTORS)


def require_between(box: Grid, rig: Cameras, who: str) -> None:
    """Check the box for a library whose rays are infinite.

    Raises:
        ValueError: the box is not entirely between the first and the last points of the rays.
    """
    near, far = (rig.depth_range(box).detach() / rig.distance.detach()[:, None]).unbind(dim=-1)
    if (near < -1e-9).any() or (far > 1 + 1e-9).any():
        worst = f"{near.min().item():.3g} to {far.max().item():.3g}"
        raise ValueError(
            f"{who} follows whole lines, so the box must lie between sources and detectors, got "
            f"it {worst} of the way"
        )


def plane_of_rows(box: Grid, rig: Cameras, who: str) -> list[tuple[int, int]]:
    """For a 2-D library: each detector row whose rays meet the box, and the slice whose central
    plane contains them.

    Raises:
        ValueError: rays that leave a slice's central plane, or rows whose pixels are not aligned
            along z.
    """
    # [rows, everything else]
    z = torch.stack([ends[..., 2] for ends in rig.rays()]).transpose(0, 2).flatten(1)
    index = z / box.spacing[2] + (box.shape[0] - 1) / 2
    slices = index.mean(dim=-1).round()
    off = (index - slices[:, None]).abs().max().item()
    if off > 1e-3:
        raise ValueError(
            f"{who} takes rays that stay in the middle of a slice of voxels, got rays {off:.3g} "
            f"slices off"
        )
    lean = rig.v[:, :2].norm(dim=-1).max().item() * (rig.shape[0] - 1)
    if lean > 1e-3 * min(box.spacing):
        raise ValueError(
            f"{who} takes rows one above the other, got a detector that leans by {lean:.3g} mm"
        )
    return [(row, int(s)) for row, s in enumerate(slices) if 0 <= s < box.shape[0]]
