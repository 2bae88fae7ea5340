"""The precision of arithmetic, where storage may have less."""

import torch
from torch import Tensor


def arithmetic(dtype: torch.dtype) -> torch.dtype:
    """The type of arithmetic with stored numbers: float64 with such, else float32."""
    return torch.float64 if dtype == torch.float64 else torch.float32


def wide(tensor: Tensor) -> Tensor:
    """The tensor in the precision of arithmetic: float64 as such, all else as float32."""
    return tensor.to(arithmetic(tensor.dtype))
