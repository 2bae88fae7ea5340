"""Bias and standard deviation of a reconstruction over noise realisations."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class Repeated(NamedTuple):
    """Statistics of a reconstruction over noise realisations, in the unit of the volume.

    Args:
        draws: number of noise realisations.
        mean: mean of the volumes.
        bias: mean minus truth.
        deviation: standard deviation of each voxel over the realisations.
    """

    draws: int
    mean: Float[Tensor, "*n"]
    bias: Float[Tensor, "*n"]
    deviation: Float[Tensor, "*n"]

    def within(self, mask: Bool[Tensor, "*n"]) -> "Relative":
        """Bias and standard deviation of a region's voxels, relative to its true mean.

        Raises:
            ValueError: a mask of the wrong shape or without voxels, or a non-positive true mean.
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
        # subtract the variance of the mean of n realisations
        square = self.bias[mask].square().mean().item() - variance / self.draws
        return Relative(
            self.bias[mask].mean().item() / level,
            max(0.0, square) ** 0.5 / level,
            variance**0.5 / level,
        )


class Relative(NamedTuple):
    """Results for a region, relative to its true mean, dimensionless.

    Args:
        mean_bias: bias of the region's mean.
        bias: root mean square over its voxels, corrected for the residual noise of the finite
            number of realisations.
        deviation: root mean square over its voxels.
    """

    mean_bias: float
    bias: float
    deviation: float


def repeated(volumes: Iterable[Float[Tensor, "*n"]], truth: Float[Tensor, "*n"]) -> Repeated:
    """Bias and standard deviation of reconstructions of one object from independent noise
    realisations, in the unit of the volume.

    Volumes are processed one by one and not stored (Welford, Technometrics 4 (1962) 419).

    Args:
        volumes: one per noise realisation, at least two.
        truth: ideal reconstruction.

    Raises:
        ValueError: fewer than two volumes, or a volume of the wrong shape or with values that are
            not finite.
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
