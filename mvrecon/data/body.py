"""Where the patient is in a CT volume."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.grid import Grid

#: Blocks along the longest edge in which connected parts are told apart, which bounds the time.
BLOCKS = 48


def body(mu: Float[Tensor, "d h w"], threshold: float) -> Bool[Tensor, "d h w"]:
    """Voxels above a threshold in the largest connected part: the patient without couch and wires.

    Parts closer to each other than a block of a 48th of the longest edge count as one.
    """
    mask = mu > threshold
    size = math.ceil(max(mask.shape) / BLOCKS)
    blocks = F.avg_pool3d(mask[None, None].float(), size, ceil_mode=True)[0, 0] >= 0.5
    near = _spread(largest_part(blocks if blocks.any() else blocks | True).float(), 3) > 0
    for axis, n in enumerate(mask.shape):
        near = near.repeat_interleave(size, dim=axis).narrow(axis, 0, n)
    return mask & near


def largest_part(mask: Bool[Tensor, "d h w"]) -> Bool[Tensor, "d h w"]:
    """The part with the most voxels among those that touch by faces; of equal ones, the last. Up to
    2^24 voxels.
    """
    labels = torch.arange(1, mask.numel() + 1, dtype=torch.float32).reshape(mask.shape) * mask
    while True:
        spread = labels
        for axis in range(3):
            kernel = [1, 1, 1]
            kernel[axis] = 3
            spread = _spread(spread, kernel) * mask
        if torch.equal(spread, labels):
            break
        labels = spread
    parts, counts = labels[mask].unique(return_counts=True)
    return labels == parts[counts == counts.max()][-1] if len(parts) else mask


def _spread(values: Float[Tensor, "d h w"], kernel: int | list[int]) -> Float[Tensor, "d h w"]:
    sizes = [kernel] * 3 if isinstance(kernel, int) else kernel
    return F.max_pool3d(values[None, None], sizes, stride=1, padding=[n // 2 for n in sizes])[0, 0]


def enclosed(mask: Bool[Tensor, "d h w"]) -> Bool[Tensor, "d h w"]:
    """Voxels with the mask on all four sides in their slice of equal z, and the mask itself: lungs,
    not room air.
    """
    filled = torch.ones_like(mask)
    for axis in (1, 2):
        before = mask.cummax(dim=axis).values
        after = mask.flip(axis).cummax(dim=axis).values.flip(axis)
        filled &= before & after
    return mask | filled


def centre(mask: Bool[Tensor, "d h w"], grid: Grid) -> Float[Tensor, "3"]:
    """World mm of the centre of the mask's box."""
    places = mask.nonzero().flip(1)
    return grid.to_world((places.amin(dim=0) + places.amax(dim=0)).double() / 2)
