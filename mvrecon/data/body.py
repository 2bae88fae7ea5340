"""Segmentation of the patient in a CT volume: the body mask and its bounding box."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mvrecon.data.resample import Slabs, ends
from mvrecon.geometry.grid import Box, three

#: Blocks along the longest edge for connected components, which bounds the time.
MAX_BLOCKS = 48


def body(mu: Float[Tensor, "d h w"], threshold: float) -> Bool[Tensor, "d h w"]:
    """Return the voxels above a threshold in the largest connected part: the patient without couch
    and wires.

    Parts closer than a block, a 48th of the longest edge, are merged.
    """
    mask = mu > threshold
    size = _block(mask.shape)
    near = _near(F.avg_pool3d(mask[None, None].float(), size, ceil_mode=True)[0, 0] >= 0.5)
    return mask & _spread_out(near, size, mask.shape, range(3))


def body_box(mu: Slabs, threshold: float) -> Box:
    """Return the bounding box of the whole volume's `body`; empty if that is.

    Memory: a slab, and for every block the number of voxels above the threshold along each axis.
    """
    size, k = _block(mu.shape), mu.axis
    shape = [
        mu.shape[k],
        *(n for axis, n in enumerate(mu.shape) if axis != k),
    ]  # the slabs' axis first
    blocks = [-(-n // size) for n in shape]
    inside = torch.zeros(blocks, dtype=torch.int32)
    along = [
        torch.zeros(*blocks[:i], shape[i], *blocks[i + 1 :], dtype=torch.int32) for i in range(3)
    ]
    for first, slab in mu:
        mask = (slab > threshold).movedim(k, 0)
        at = (first + torch.arange(len(mask))) // size
        rows, columns = _counted(mask, size, 1), _counted(mask, size, 2)
        cells = _counted(rows, size, 2)
        along[0][first : first + len(mask)] = cells
        for total, part in ((inside, cells), (along[1], columns), (along[2], rows)):
            total.index_add_(0, at, part)
    near = _near(2 * inside.movedim(0, k) >= _voxels(mu.shape, size)).movedim(k, 0)
    masks = [(along[i] > 0) & _spread_out(near, size, shape, [i]) for i in range(3)]
    limits = [ends(mask.movedim(i, 0).flatten(1).any(dim=1)) for i, mask in enumerate(masks)]
    limits.insert(k, limits.pop(0))
    return Box(three([low for low, _ in limits]), three([high for _, high in limits]))


def _block(shape: Sequence[int]) -> int:
    return math.ceil(max(shape) / MAX_BLOCKS)


def _near(blocks: Bool[Tensor, "e i j"]) -> Bool[Tensor, "e i j"]:
    """The largest part of blocks that are half full, and all adjacent blocks."""
    largest = largest_part(blocks if blocks.any() else blocks | True).float()
    return F.max_pool3d(largest[None, None], 3, stride=1, padding=1)[0, 0] > 0


def _spread_out(
    blocks: Bool[Tensor, "e i j"], size: int, shape: Sequence[int], axes: Iterable[int]
) -> Bool[Tensor, "d h w"]:
    """Expand values of blocks to voxels along some axes."""
    for axis in axes:
        blocks = blocks.repeat_interleave(size, dim=axis).narrow(axis, 0, shape[axis])
    return blocks


def _counted(values: Tensor, size: int, axis: int) -> Int[Tensor, "d h w"]:
    """Sums over blocks along an axis, the last of which may be smaller."""
    rest = [0, 0] * (2 - axis) + [0, -values.shape[axis] % size]
    return F.pad(values, rest).unflatten(axis, (-1, size)).sum(dim=axis + 1, dtype=torch.int32)


def _voxels(shape: Sequence[int], size: int) -> Int[Tensor, "e i j"]:
    """The number of voxels in every block."""
    z, y, x = (_counted(torch.ones(n, 1, 1, dtype=torch.bool), size, 0).flatten() for n in shape)
    return z[:, None, None] * y[:, None] * x


def largest_part(mask: Bool[Tensor, "d h w"]) -> Bool[Tensor, "d h w"]:
    """Return the largest face-connected part; among equal ones, the last."""
    within = mask.numpy()
    above = mask.numel() + 1  # all labels
    dtype = np.int32 if above * (max(mask.shape) + 1) < 2**31 else np.int64
    # along an axis, the labels of a run of the mask exceed all of the run before
    runs = [(~within).cumsum(axis, dtype=dtype) * above for axis in range(3)]
    back = [np.flip(run.max(axis, keepdims=True) - run, axis) for axis, run in enumerate(runs)]
    labels = np.arange(1, above, dtype=dtype).reshape(mask.shape) * within
    while True:
        spread = labels
        for axis in range(3):
            spread = np.maximum.accumulate(spread + runs[axis], axis) - runs[axis]
            spread = np.flip(spread * within, axis) + back[axis]
            spread = np.flip(np.maximum.accumulate(spread, axis) - back[axis], axis) * within
        if np.array_equal(spread, labels):
            break
        labels = spread
    parts, counts = np.unique(labels[within], return_counts=True)
    if not len(parts):
        return mask
    return torch.from_numpy(labels == parts[counts == counts.max()][-1])


def enclosed(mask: Bool[Tensor, "d h w"]) -> Bool[Tensor, "d h w"]:
    """Return the mask and all voxels with the mask on all four sides in their slice of equal z:
    lungs, not room air.
    """
    within = mask.numpy()
    filled = np.ones_like(within)
    for axis in (1, 2):
        filled &= np.maximum.accumulate(within, axis)
        filled &= np.flip(np.maximum.accumulate(np.flip(within, axis), axis), axis)
    return mask | torch.from_numpy(filled)
