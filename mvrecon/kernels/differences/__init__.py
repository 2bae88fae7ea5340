"""The steps of the total variation, compiled in main memory, else in torch."""

from types import ModuleType

import torch
from torch import Tensor

from mvrecon.kernels.differences import reference
from mvrecon.kernels.operator import choose_backend


def differences_for(tensor: Tensor) -> ModuleType:
    """The module with `primal`, `dual_step` and `proximal_step` for a tensor's device and type."""
    if (
        tensor.dtype not in (torch.float32, torch.float64)
        or choose_backend(tensor, "auto") != "cpu"
    ):
        return reference
    # numba is heavy, so the kernels are imported where they are used
    from mvrecon.kernels.differences import cpu

    return cpu
