"""Which steps of the total variation serve a tensor: compiled in main memory, else torch."""

from types import ModuleType

import torch
from torch import Tensor

from mvrecon.kernels.backends import kernels_for
from mvrecon.kernels.differences import reference


def differences_for(tensor: Tensor) -> ModuleType:
    """The module with `primal`, `dual_step` and `proximal_step` for a tensor's device and type."""
    if (
        tensor.dtype not in (torch.float32, torch.float64)
        or kernels_for(tensor, "auto")[0] != "cpu"
    ):
        return reference
    # numba is heavy, so the kernels are imported where they are used
    from mvrecon.kernels.differences import cpu

    return cpu
