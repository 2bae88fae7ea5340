"""Steps between the scales of whole volumes: halving, and interpolation on a part of them.

Masks are numbers 0 and 1 in the features' type. Networks that work on a mask's voxels alone:
`voxels`.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


class _Halved(torch.autograd.Function):
    """torch's own derivative of `avg_pool3d` adds up in no fixed order on a GPU; this one, the same
    to the last bit, adds up nothing."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return F.avg_pool3d(x, [min(2, size) for size in x.shape[2:]], ceil_mode=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.shape = inputs[0].shape[2:]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        share = gradient / 8
        for axis, size in enumerate(ctx.shape, start=2):
            if size % 2:  # the last mean is of half as many
                share = torch.cat(
                    [share.narrow(axis, 0, size // 2), 2 * share.narrow(axis, size // 2, 1)],
                    dim=axis,
                )
        d, h, w = ctx.shape
        return F.interpolate(share, scale_factor=2.0, mode="nearest")[:, :, :d, :h, :w]


def halved(x: Float[Tensor, "n c d h w"]) -> Float[Tensor, "n c e i x"]:
    """Means of 2x2x2 voxels; at odd ends, of as many as there are. Its derivative has the same bits
    in every run.
    """
    return _Halved.apply(x)


def upsampled(
    x: Float[Tensor, "n c e i x"],
    mask: Float[Tensor, "n 1 e i x"],
    onto: Float[Tensor, "n 1 d h w"],
    size: Sequence[int],
) -> Float[Tensor, "n c d h w"]:
    """Trilinear interpolation between the voxels of a coarse mask, on those of a fine one.

    Args:
        x: coarse features; their values outside the mask do not matter.
        mask: the coarse one.
        onto: the fine one, in the coarse one's.
        size: of all coarse voxels on the fine lattice; what `onto` has not is cut off.
    """
    d, h, w = onto.shape[2:]
    values, shares = (
        F.interpolate(f, size=list(size), mode="trilinear")[:, :, :d, :h, :w]
        for f in (x * mask, mask)
    )
    return values * (onto / torch.where(shares > 0, shares, 1.0))
