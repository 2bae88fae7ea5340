"""Where group normalisation and SiLU are one kernel."""

from torch import Tensor

from mvrecon.kernels.norms.trial import differences
from mvrecon.kernels.operator import choose_backend


def fused_on(x: Tensor) -> bool:
    """Whether a tensor's device has the kernels, and they passed their check there."""
    return x.is_cuda and choose_backend(x, "auto", "norm", differences) == "cuda"
