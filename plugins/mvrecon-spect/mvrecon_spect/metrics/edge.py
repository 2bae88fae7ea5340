"""The modulation transfer function from the edge of a ball."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid, voxel_centres

#: Bins of the edge profile per voxel.
BINS = 4


class Mtf(NamedTuple):
    """A modulation transfer function.

    Args:
        frequencies: in 1/mm, from zero to the Nyquist frequency.
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
            diameter below eight voxels or too close to the grid's boundary, or a cone with too few
            voxels.
    """
    direction = torch.tensor(list(axis), dtype=torch.float64)
    if tuple(volume.shape) != grid.shape or not direction.norm() > 0:
        raise ValueError(
            f"Expected a volume of shape {grid.shape} and an axis, got {tuple(volume.shape)} and "
            f"{list(axis)}"
        )
    direction, radius = direction / direction.norm(), diameter / 2
    pitch = float((direction.abs() * torch.tensor(grid.spacing)).sum())
    if diameter < 8 * pitch:
        raise ValueError(f"Expected a ball of 8 voxels or more, got {diameter / pitch:.1f}")
    offset = voxel_centres(grid) - torch.tensor(list(centre), dtype=torch.float64)
    distance = offset.norm(dim=-1)
    near = (distance - radius).abs() < radius / 2
    near &= (offset @ direction).abs() >= math.cos(math.radians(cone_degrees)) * distance
    profile = _profile(volume[near].double(), distance[near] - radius, pitch / BINS, radius / 2)
    return _transformed(profile, pitch / BINS, pitch)


def _profile(
    values: Float[Tensor, " n"], beyond: Float[Tensor, " n"], width: float, reach: float
) -> Float[Tensor, " k"]:
    """Mean of the values in bins of distance from the surface."""
    count = 2 * int(reach / width)
    index = ((beyond / width).floor() + count // 2).long()
    inside = (index >= 0) & (index < count)
    number = torch.bincount(index[inside], minlength=count)
    if not bool((number > 0).all()):
        raise ValueError(
            f"Expected voxels in each of {count} bins about the ball's edge, got "
            f"{int((number == 0).sum())} empty ones; widen the cone, or take a ball inside the grid"
        )
    total = torch.zeros(count, dtype=torch.float64).index_add(0, index[inside], values[inside])
    return total / number


def _transformed(profile: Float[Tensor, " k"], width: float, pitch: float) -> Mtf:
    spread = profile[:-1] - profile[1:]
    place = width * (torch.arange(len(spread), dtype=torch.float64) - (len(spread) - 1) / 2)
    frequencies = torch.linspace(0, 0.5 / pitch, 64, dtype=torch.float64)
    phase = 2 * math.pi * frequencies[:, None] * place
    size = torch.complex((phase.cos() * spread).sum(dim=1), (phase.sin() * spread).sum(dim=1)).abs()
    # averaging in bins and differences of bins each blur by a box of the bin width
    blur = torch.sinc(frequencies * width).square()
    return Mtf(frequencies, size / size[0] / blur)
