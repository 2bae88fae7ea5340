"""Volumes of networks cut off at zero, without a way to get stuck there."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


class _NonNegative(torch.autograd.Function):
    """max(x, 0), and the gradient of a descent that stays where x >= 0."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp_min(0)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (x,), (gradient,) = ctx.saved_tensors, gradients
        return gradient.masked_fill((x <= 0) & (gradient > 0), 0)


def nonnegative(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Cut a volume off at zero, in its unit.

    A value below zero has a gradient where that leads upwards, and none where it leads further
    down: the projected gradient of a bound (Bertsekas, IEEE Trans. Autom. Control 21 (1976) 174).
    By torch's own derivative, zero on that side, a network whose step has brought every voxel below
    zero would never learn again.
    """
    return _NonNegative.apply(x)  # type: ignore[no-any-return]
