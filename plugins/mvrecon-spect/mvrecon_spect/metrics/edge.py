"""The modulation transfer function from the edge of a ball or a plane, and balls in a volume."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.body import largest_part
from mvrecon.geometry.grid import Box, Grid, three, voxel_centres

#: Bins of the edge profile per voxel.
BINS = 4
#: Diameter of a ball in voxels, at least; relative difference of extent and diameter of a ball.
LEAST_VOXELS, ROUND = 8, 0.2
#: Step of an edge, at least, in standard deviations of its profile away from the edge.
LEAST_STEP = 5
#: Voxels this near to the border of a bin, in its width, or of a cone are on its far side, which
#: rounding would decide else.
ROUNDING = 1e-6


class Mtf(NamedTuple):
    """A modulation transfer function.

    Args:
        frequencies: frequencies in 1/mm, from zero to the Nyquist frequency.
        values: 1 at zero.
    """

    frequencies: Float[Tensor, " k"]
    values: Float[Tensor, " k"]

    def falls_to(self, level: float) -> float:
        """Lowest frequency in 1/mm at which the function has dropped to a level; infinite if it
        never does.
        """
        below = (self.values <= level).nonzero()
        if not len(below) or below[0] == 0:
            return math.inf
        n = int(below[0])
        (f0, f1), (v0, v1) = self.frequencies[n - 1 : n + 1], self.values[n - 1 : n + 1]
        return float(f0 + (f1 - f0) * (v0 - level) / (v0 - v1))


def ball_mtf(
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    centre: Sequence[float],
    diameter: float,
    axis: Sequence[float],
    cone_degrees: float = 30.0,
) -> Mtf:
    """Modulation transfer function along an axis from the edge of a uniform ball, dimensionless.

    The edge profile is the mean over voxels near the ball's surface within two cones about the
    axis, in bins of a quarter voxel by distance from the surface. Its derivative is the line spread
    function, whose Fourier transform is divided by its value at zero and by that of the bins; see
    Wu, Boone, Hernandez, Mahesh, Siewerdsen, Med. Phys. 47 (2020). The ball must be large compared
    with the resolution, and isolated within 1.5 radii.

    Args:
        volume: values on the grid.
        grid: grid of the volume.
        centre: centre of the ball, (x, y, z) in mm.
        diameter: diameter of the ball in mm.
        axis: direction (x, y, z) of the frequency.
        cone_degrees: half-angle of the cones; wider cones mix directions, narrower cones contain
            fewer voxels.

    Raises:
        ValueError: a volume whose shape is not that of the grid, a zero axis, a ball with a
            diameter below eight voxels or too close to the grid's boundary, a cone with too few
            voxels, or no edge above the noise.
    """
    radius = diameter / 2
    values, offset, direction, pitch = _about(volume, grid, centre, axis, 1.5 * radius)
    if diameter < LEAST_VOXELS * pitch:
        raise ValueError(
            f"Expected a ball of {LEAST_VOXELS} voxels or more, got {diameter / pitch:.1f}"
        )
    distance = offset.norm(dim=-1)
    within = (math.cos(math.radians(cone_degrees)) - ROUNDING) * distance
    near = (offset @ direction).abs() >= within
    profile = _profile(values[near], distance[near] - radius, pitch / BINS, radius / 2)
    return _transformed(profile, pitch / BINS, pitch)


def plane_mtf(
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    point: Sequence[float],
    normal: Sequence[float],
    reach: float,
) -> Mtf:
    """Modulation transfer function along the normal of a plane between two uniform parts, as
    `ball_mtf`; a plane along the voxels must be tilted by a few degrees, as in ISO 12233.

    Args:
        volume: values on the grid.
        grid: grid of the volume.
        point: a point of the plane, (x, y, z) in mm.
        normal: direction, (x, y, z).
        reach: mm from the point, along the plane and to both sides, that are uniform.

    Raises:
        ValueError: a volume whose shape is not that of the grid, a normal of zero length, a reach
            below four voxels, too few voxels, or no edge above the noise.
    """
    values, offset, direction, pitch = _about(volume, grid, point, normal, math.sqrt(2) * reach)
    if reach < LEAST_VOXELS / 2 * pitch:
        raise ValueError(
            f"Expected a reach of {LEAST_VOXELS // 2} voxels or more, got {reach / pitch:.1f}"
        )
    beyond = offset @ direction
    across = (offset - beyond[..., None] * direction).norm(dim=-1)
    near = across <= reach * (1 + ROUNDING)
    profile = _profile(values[near], beyond[near], pitch / BINS, reach)
    return _transformed(profile, pitch / BINS, pitch)


def _about(
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    centre: Sequence[float],
    axis: Sequence[float],
    reach: float,
) -> tuple[Float[Tensor, "e i j"], Float[Tensor, "e i j 3"], Float[Tensor, "3"], float]:
    """The voxels of a box that holds a sphere about a point, their values and offsets from it in
    mm, an axis of length one, and the step of the voxels along it in mm.
    """
    direction, point = (torch.tensor(list(v), dtype=torch.float64) for v in (axis, centre))
    if tuple(volume.shape) != grid.shape or not direction.norm() > 0:
        raise ValueError(
            f"Expected a volume of shape {grid.shape} and an axis, got {tuple(volume.shape)} and "
            f"{list(axis)}"
        )
    if not (direction.isfinite().all() and point.isfinite().all() and math.isfinite(reach)):
        raise ValueError(f"Expected finite mm, got {list(centre)}, {list(axis)} and {reach}")
    direction = direction / direction.norm()
    half = reach * torch.linalg.inv(grid.affine[:3, :3]).norm(dim=1)
    ends = (grid.to_index(point) - half).floor(), (grid.to_index(point) + half).ceil() + 1
    low, high = (
        [min(max(int(n), 0), size) for n, size in zip(end.tolist(), grid.size, strict=True)][::-1]
        for end in ends
    )
    box = Box(three(low), three(high))
    if not math.prod(box.shape):
        raise ValueError(f"Expected a place inside the grid, got {list(centre)} mm")
    offset = voxel_centres(grid.cropped(box)) - point
    pitch = float((direction.abs() * torch.tensor(grid.spacing)).sum())
    return volume[box.slices].double(), offset, direction, pitch


class Ball(NamedTuple):
    """A ball: its centre (x, y, z) and its diameter in mm."""

    centre: tuple[float, float, float]
    diameter: float


def balls(volume: Float[Tensor, "d h w"], grid: Grid) -> list[Ball]:
    """The hot balls of a volume that `ball_mtf` can measure, the largest first.

    A ball is a face-connected part above the mean of the median and the 99.9th percentile, at least
    eight voxels across, whose extents along the voxels differ by at most a fifth from the diameter
    of a ball of its volume.
    """
    values = volume.flatten()[:: 1 + volume.numel() // 2**22].double()
    limits = values.quantile(values.new_tensor([0.5, 0.999]))
    hot, found = volume > limits.mean(), []
    spacing, voxel = torch.tensor(grid.spacing), math.prod(grid.spacing)
    while hot.any():
        part = largest_part(hot)
        hot = hot & ~part
        diameter = (6 * int(part.sum()) * voxel / math.pi) ** (1 / 3)
        if diameter < LEAST_VOXELS * max(grid.spacing):
            break
        index = part.nonzero().flip(-1).double()
        extent = (1 + index.amax(dim=0) - index.amin(dim=0)) * spacing
        if ((extent / diameter - 1).abs() < ROUND).all():
            x, y, z = grid.to_world(index.mean(dim=0)).tolist()
            found.append(Ball((x, y, z), diameter))
    return found


def _profile(
    values: Float[Tensor, " n"], beyond: Float[Tensor, " n"], width: float, reach: float
) -> Float[Tensor, " k"]:
    """Mean of the values in bins of distance from the surface."""
    count = 2 * int(reach / width + ROUNDING)
    index = ((beyond / width + ROUNDING).floor() + count // 2).long()
    inside = (index >= 0) & (index < count)
    number = torch.bincount(index[inside], minlength=count)
    if not bool((number > 0).all()):
        raise ValueError(
            f"Expected voxels in each of {count} bins about the edge, got "
            f"{int((number == 0).sum())} empty ones; widen the cone, tilt the plane, or keep "
            f"inside the grid"
        )
    total = torch.zeros(count, dtype=torch.float64).index_add(0, index[inside], values[inside])
    return total / number


def _transformed(profile: Float[Tensor, " k"], width: float, pitch: float) -> Mtf:
    inside, outside = profile[: len(profile) // 4], profile[-(len(profile) // 4) :]
    step = (inside.mean() - outside.mean()).abs()
    noise = torch.stack([inside.std(), outside.std()]).amax()
    if not step > LEAST_STEP * noise:
        raise ValueError(
            f"Expected an edge between two uniform parts, got a step of {step:.3g}, less than "
            f"{LEAST_STEP} standard deviations of {noise:.3g} of its profile beside the edge"
        )
    spread = profile[:-1] - profile[1:]
    place = width * (torch.arange(len(spread), dtype=torch.float64) - (len(spread) - 1) / 2)
    frequencies = torch.linspace(0, 0.5 / pitch, 64, dtype=torch.float64)
    phase = 2 * math.pi * frequencies[:, None] * place
    size = torch.complex((phase.cos() * spread).sum(dim=1), (phase.sin() * spread).sum(dim=1)).abs()
    # averaging in bins and differences of bins each blur by a box of the bin width
    blur = torch.sinc(frequencies * width).square()
    return Mtf(frequencies, size / size[0] / blur)
