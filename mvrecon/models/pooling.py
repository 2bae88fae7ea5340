"""Statistics over cameras: mean and variance of M volumes, the same with one camera left out, and
the weighted mean.

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


def fuse(
    volumes: Float[Tensor, "b m 1 d h w"], logits: Float[Tensor, "b m 1 d h w"], visible: Tensor
) -> tuple[Float[Tensor, "b 1 d h w"], Float[Tensor, "b m 1 d h w"]]:
    """The weighted mean over the cameras that see a voxel, and its weights; zero where none does.

    Zero logits give the plain mean. The result is equivariant to a permutation of the cameras.
    """
    # Finite, not -inf: a voxel that no camera sees must not turn into NaN.
    weights = torch.where(visible, logits, torch.finfo(logits.dtype).min).softmax(dim=1) * visible
    return (weights * volumes).sum(dim=1), weights
