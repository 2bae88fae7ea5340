"""Where group normalisation and SiLU are one kernel."""

from torch import Tensor

from mvrecon.kernels.backends import kernels_for
from mvrecon.kernels.norms.trial import differences


def fused_on(x: Tensor) -> bool:
    """Whether a tensor's device has the kernels, and they passed their check there."""
    return x.is_cuda and kernels_for(x, "auto", "norm", differences)[0] == "cuda"
