"""A learned number kept within bounds, without a way to get stuck there."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


class _WithinOne(torch.autograd.Function):
    """x within 0 and 1, and the gradient of a descent that stays there."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (x,), (gradient,) = ctx.saved_tensors, gradients
        outwards = ((x <= 0) & (gradient > 0)) | ((x >= 1) & (gradient < 0))
        return gradient.masked_fill(outwards, 0)


def within_one(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Cut a learned number off at 0 and 1.

    Beyond a bound it has a gradient where that leads back, and none where it leads further out: the
    projected gradient (Bertsekas, IEEE Trans. Autom. Control 21 (1976) 174). By torch's own
    derivative, zero there, a number that has once passed a bound would stay.
    """
    return _WithinOne.apply(x)  # type: ignore[no-any-return]
