"""Division where the divisor may be zero."""

import torch
from jaxtyping import Float
from torch import Tensor


def divided(
    dividend: Float[Tensor, "*#n"] | float, divisor: Float[Tensor, "*#n"], otherwise: float = 0.0
) -> Float[Tensor, "*n"]:
    """Ratio of two tensors where the divisor is positive, elsewhere a number; its gradient is
    finite in both.
    """
    positive = divisor > 0
    return torch.where(positive, dividend / torch.where(positive, divisor, 1), otherwise)
