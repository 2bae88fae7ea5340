"""What the other cameras say: pooled statistics of M volumes in the world, and the same with one
camera left out.

Every statistic is a sum over cameras, so it does not depend on their order, costs 2M warps instead
of M(M-1), and leaving one camera out is a subtraction.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def pooled(
    volumes: Float[Tensor, "b m c d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b 1 c d h w"], Float[Tensor, "b 1 c d h w"]]:
    """Mean and variance over the cameras that see a voxel; zero where none does.

    Args:
        volumes: one volume for each camera.
        visible: which voxels each camera sees, [m 1 d h w].
    """
    seen = visible.to(volumes.dtype)
    count = seen.sum(dim=0, keepdim=True).clamp_min(1)
    mean = (volumes * seen).sum(dim=1, keepdim=True) / count
    variance = ((volumes - mean).square() * seen).sum(dim=1, keepdim=True) / count
    return mean, variance


def leave_one_out(
    volumes: Float[Tensor, "b m c d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b m c d h w"], Float[Tensor, "b m c d h w"], Float[Tensor, "m 1 d h w"]]:
    """For each camera the mean, the variance and the count of the others that see the voxel.

    Sums are formed about the mean over all cameras, so that the subtraction cancels no digits.
    """
    seen = visible.to(volumes.dtype)
    centre, _ = pooled(volumes, visible)
    about = (volumes - centre) * seen
    count = seen.sum(dim=0, keepdim=True) - seen
    others = count.clamp_min(1)
    first = (about.sum(dim=1, keepdim=True) - about) / others
    second = (about.square().sum(dim=1, keepdim=True) - about.square()) / others
    some = count > 0
    variance = (second - first.square()).clamp_min(0)
    return torch.where(some, first + centre, 0.0), torch.where(some, variance, 0.0), count
