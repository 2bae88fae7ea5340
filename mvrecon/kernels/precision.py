"""The precision of arithmetic, where storage may have less."""

import torch
from torch import Tensor


def wide(tensor: Tensor) -> Tensor:
    """The tensor in the precision of arithmetic: float64 as such, all else as float32."""
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()
