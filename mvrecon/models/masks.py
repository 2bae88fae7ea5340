"""A U-Net's steps between convolutions, defined on a part of the volume: nothing outside counts, nothing leaves it.

Normalisation, pooling and upsampling average over the mask alone. So their results do not depend on how much empty
space lies around the mask, as long as coarse voxels keep their places, and a mask of ones gives the plain steps.
Masks are numbers 0 and 1 in the features' type; features are zero outside them.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

Mask = Float[Tensor, "n 1 d h w"]


class _Halved(torch.autograd.Function):
    """torch's own derivative of `avg_pool3d` adds up in no fixed order on a GPU; this one, the same to the last bit,
    adds up nothing."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return F.avg_pool3d(x, 2, ceil_mode=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.shape = inputs[0].shape[2:]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        share = gradient / 8
        for axis, size in enumerate(ctx.shape, start=2):
            if size % 2:  # the last mean is of half as many
                share = torch.cat([share.narrow(axis, 0, size // 2), 2 * share.narrow(axis, size // 2, 1)], dim=axis)
        d, h, w = ctx.shape
        return F.interpolate(share, scale_factor=2.0, mode="nearest")[:, :, :d, :h, :w]


def halved(x: Float[Tensor, "n c d h w"]) -> Float[Tensor, "n c e i x"]:
    """Means of 2x2x2 voxels; at odd ends, of as many as there are. Its derivative has the same bits in every run."""
    return _Halved.apply(x)


def group_norm(
    x: Float[Tensor, "n c d h w"], mask: Mask, groups: int, affine: tuple[Tensor, Tensor], eps: float = 1e-5
) -> Float[Tensor, "n c d h w"]:
    """Group normalisation (Wu & He, ECCV 2018) by the statistics of the mask's voxels; zero outside.

    In two passes, mean first, so that an offset costs the variance no digits.

    Args:
        x: features; their values outside the mask do not matter.
        mask: which voxels count, of each sample.
        groups: of channels.
        affine: scale and shift of every channel.
        eps: added to the variance.
    """
    n, c = x.shape[:2]
    count = mask.flatten(1).sum(dim=1).clamp_min(1).reshape(n, 1, 1) * (c // groups)
    sums = (x * mask).sum(dim=(2, 3, 4)).reshape(n, groups, -1)
    mean = (sums.sum(dim=2, keepdim=True) / count).expand_as(sums).reshape(n, c, 1, 1, 1)
    about = (x - mean) * mask
    squares = about.square().sum(dim=(2, 3, 4)).reshape(n, groups, -1)
    variance = (squares.sum(dim=2, keepdim=True) / count).expand_as(squares).reshape(n, c)
    scale, shift = affine
    slope = (scale * (variance + eps).rsqrt())[..., None, None, None]
    return torch.addcmul(shift[:, None, None, None] * mask, about, slope)


def pooled(x: Float[Tensor, "n c d h w"], mask: Mask) -> tuple[Float[Tensor, "n c e i x"], Float[Tensor, "n 1 e i x"]]:
    """Means of 2x2x2 voxels over those in the mask, and the max-pooled mask."""
    share = halved(mask)
    some = (share > 0).to(x.dtype)
    return halved(x) / (share + (1 - some)), some


def upsampled(
    x: Float[Tensor, "n c e i x"], mask: Float[Tensor, "n 1 e i x"], onto: Mask, size: Sequence[int]
) -> Float[Tensor, "n c d h w"]:
    """Trilinear interpolation between the voxels of a coarse mask, on those of a fine one.

    Args:
        x: coarse features; their values outside the mask do not matter.
        mask: the coarse one.
        onto: the fine one, in the coarse one's.
        size: of all coarse voxels on the fine lattice; what `onto` has not is cut off.
    """
    d, h, w = onto.shape[2:]
    values, shares = (F.interpolate(f, size=list(size), mode="trilinear")[:, :, :d, :h, :w] for f in (x * mask, mask))
    return values * (onto / torch.where(shares > 0, shares, 1.0))
