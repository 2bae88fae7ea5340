"""Statistics over cameras: mean and variance of M volumes in the world, and the same with one
camera left out.

Every statistic is a sum over cameras, so it does not depend on their order, costs 2M warps instead
of M(M-1), and leaving one camera out is a subtraction.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool3d

from mvrecon.models.networks import MULTIPLE

#: Edge in voxels of the bricks that are refined or not; crops keep them in place.
BRICK = MULTIPLE


def pooled(
    volumes: Float[Tensor, "b m c d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b 1 c d h w"], Float[Tensor, "b 1 c d h w"]]:
    """Mean and variance over the cameras that see a voxel; zero where none does.

    Args:
        volumes: one volume for each camera.
        visible: which voxels each camera sees, [m 1 d h w].
    """
    visibility = visible.to(volumes.dtype)
    count = visibility.sum(dim=0, keepdim=True).clamp_min(1)
    mean = (volumes * visibility).sum(dim=1, keepdim=True) / count
    variance = ((volumes - mean).square() * visibility).sum(dim=1, keepdim=True) / count
    return mean, variance


def leave_one_out(
    volumes: Float[Tensor, "b m c d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b m c d h w"], Float[Tensor, "b m c d h w"], Float[Tensor, "m 1 d h w"]]:
    """For each camera the mean, the variance and the count of the others that see the voxel.

    Sums are formed about the mean over all cameras, so that the subtraction cancels no digits.
    """
    visibility = visible.to(volumes.dtype)
    centre, _ = pooled(volumes, visible)
    about = (volumes - centre) * visibility
    count = visibility.sum(dim=0, keepdim=True) - visibility
    others = count.clamp_min(1)
    first = (about.sum(dim=1, keepdim=True) - about) / others
    second = (about.square().sum(dim=1, keepdim=True) - about.square()) / others
    counted = count > 0
    variance = (second - first.square()).clamp_min(0)
    return torch.where(counted, first + centre, 0.0), torch.where(counted, variance, 0.0), count


def deviation(variance: Tensor) -> Tensor:
    """The standard deviation, with a finite slope at zero."""
    return (variance + 1e-6).sqrt()


def disagreement(spread: Float[Tensor, "b 1 d h w"], tolerance: float) -> Bool[Tensor, "b 1 d h w"]:
    """Bricks of 4 voxels in which the opinions' standard deviation passes a tolerance somewhere,
    and the bricks around them.
    """
    with torch.no_grad():
        bricks = (max_pool3d(spread, BRICK, ceil_mode=True) > tolerance).to(spread.dtype)
        near = max_pool3d(bricks, 3, stride=1, padding=1) > 0
    for axis, size in enumerate(spread.shape[2:], start=2):
        near = near.repeat_interleave(BRICK, dim=axis).narrow(axis, 0, size)
    return near
