"""The door of every network: what is let in, and in which type it is computed."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.views import check_finite
from mvrecon.projectors.checks import check_floating, check_measured


def admitted(views: Tensor, cameras: Cameras, weights: Tensor) -> Float[Tensor, "b 1 m v u"]:
    """Measured views in the type of a network's weights: whatever theirs is, that of the volume is
    the network's.

    Raises:
        ValueError: a wrong rank, size or device, more than one channel, no sample, values that are
            no floating point or, in main memory, not finite; weights of half precision, which the
            operators have not (`torch.autocast` is for that).
    """
    if weights.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"Expected a model of float32 or float64, got {weights.dtype}; for less use "
            f"torch.autocast"
        )
    check_measured(views, "views [b 1 m v u]", (len(cameras), *cameras.shape), weights.device)
    if views.shape[1] != 1:
        raise ValueError(f"Expected views [b 1 m v u] of one channel, got {tuple(views.shape)}")
    check_floating(views, "views")
    check_finite(views, on_gpu=False)  # see `consistency.anything`
    return views.to(weights.dtype)
