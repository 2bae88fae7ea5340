"""Division where the divisor may be zero, and means of what is positive."""

import math

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


def positive_mean(values: Float[Tensor, "*n"], otherwise: float) -> float:
    """Mean of the positive values of a tensor, in their unit, or a number where there are none; a
    GPU is waited for once.
    """
    positive = values > 0
    mean = (torch.where(positive, values, 0).sum() / positive.sum()).item()
    return otherwise if math.isnan(mean) else mean
