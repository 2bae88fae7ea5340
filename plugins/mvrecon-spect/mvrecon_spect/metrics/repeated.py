"""Bias and standard deviation of a reconstruction, from repeated noise."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class Repeated(NamedTuple):
    """A reconstruction under repeated noise, in the unit of the volume.

    Args:
        draws: how many there were.
        mean: of the volumes.
        bias: the mean less the truth.
        deviation: standard deviation of each voxel over the draws.
    """

    draws: int
    mean: Float[Tensor, "*n"]
    bias: Float[Tensor, "*n"]
    deviation: Float[Tensor, "*n"]

    def within(self, mask: Bool[Tensor, "*n"]) -> "Relative":
        """Bias and deviation of a region's voxels, relative to its true mean.

        Raises:
            ValueError: a mask of another shape or without voxels, or a true mean that is not
                positive.
        """
        if mask.dtype != torch.bool or mask.shape != self.mean.shape or not mask.any():
            raise ValueError(
                f"Expected a mask of shape {tuple(self.mean.shape)} with a voxel, got {mask.dtype} "
                f"{tuple(mask.shape)} with {int(mask.sum())}"
            )
        level = (self.mean - self.bias)[mask].mean().item()
        if not level > 0:
            raise ValueError(f"Expected a positive true mean in the region, got {level}")
        variance = self.deviation[mask].square().mean().item()
        # the mean of n draws has a variance of its own
        square = self.bias[mask].square().mean().item() - variance / self.draws
        return Relative(
            self.bias[mask].mean().item() / level,
            max(0.0, square) ** 0.5 / level,
            variance**0.5 / level,
        )


class Relative(NamedTuple):
    """Figures of a region, relative to its true mean, without unit.

    Args:
        mean_bias: of the region's mean.
        bias: root mean square over its voxels, less what the number of draws leaves of the noise.
        deviation: root mean square over its voxels.
    """

    mean_bias: float
    bias: float
    deviation: float


def repeated(volumes: Iterable[Float[Tensor, "*n"]], truth: Float[Tensor, "*n"]) -> Repeated:
    """Bias and standard deviation of reconstructions of one object from noise drawn anew, in the
    unit of the volume.

    Volumes are taken one by one and not kept (Welford, Technometrics 4 (1962) 419).

    Args:
        volumes: one of each noise draw, at least two.
        truth: what a perfect reconstruction gives.

    Raises:
        ValueError: fewer than two volumes, or one of another shape or with values that are not
            finite.
    """
    mean, squares, count = torch.zeros_like(truth, dtype=torch.float64), 0.0, 0
    for count, volume in enumerate(volumes, 1):  # noqa: B007
        if volume.shape != truth.shape or not volume.isfinite().all():
            raise ValueError(
                f"Expected finite volumes of shape {tuple(truth.shape)}, got "
                f"{tuple(volume.shape)} as number {count}"
            )
        change = volume.double() - mean
        mean = mean + change / count
        squares = squares + change * (volume.double() - mean)
    if count < 2:
        raise ValueError(f"Expected two noise draws or more, got {count}")
    deviation = (torch.as_tensor(squares) / (count - 1)).sqrt()
    return Repeated(count, mean, mean - truth, deviation)
