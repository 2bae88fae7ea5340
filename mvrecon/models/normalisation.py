"""Group normalisation and SiLU as one step, in which channels stay last in memory."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.kernels.norms import ops
from mvrecon.kernels.norms.norm import fused_on

#: Values from which on a GPU without the kernels normalises with channels last, 16 channels of
#: 102^3 voxels: by counts, not by a clock. It saves five transpositions, of 0.03 ms for each 2^23
#: values at 4 TB/s, and starts some 35 small kernels more, of 0.005 ms.
LARGE = 2**24


def keeps_channels_last(x: Tensor) -> bool:
    """Whether steps on a tensor leave channels last in memory."""
    return fused_on(x) or (x.is_cuda and x.numel() >= LARGE)


def normalised_silu(norm: nn.GroupNorm, x: Float[Tensor, "n c *d"]) -> Float[Tensor, "n c *d"]:
    """SiLU of group normalisation (Wu & He, ECCV 2018) by a layer's groups, scale and shift.

    Not the layer's own call, which refuses a group of one value, of which the shift is left.
    torch's kernel for a GPU takes channels first alone: it transposes what a convolution gives with
    channels last, twice more on the way back, and leaves the next convolution channels first. So a
    GPU has kernels of its own, which give float32 for half precision, as under autocast.
    """
    if fused_on(x):
        y = ops.normalised_silu(x, norm.weight, norm.bias, norm.num_groups, norm.eps)
        return y.to(torch.promote_types(x.dtype, norm.weight.dtype))
    if keeps_channels_last(x):
        return F.silu(in_any_order(norm, x))
    return F.silu(torch.group_norm(x, norm.num_groups, norm.weight, norm.bias, norm.eps))


def in_any_order(norm: nn.GroupNorm, x: Float[Tensor, "n c *d"]) -> Float[Tensor, "n c *d"]:
    """Group normalisation whose result, and derivative, lie in memory as x does; in float32 at
    least, as under autocast.
    """
    x = x.to(torch.promote_types(x.dtype, norm.weight.dtype))
    ones = [1] * (x.ndim - 2)
    groups = x.unflatten(1, (norm.num_groups, -1))
    axes = list(range(2, groups.ndim))
    variance, mean = torch.var_mean(groups, dim=axes, correction=0, keepdim=True)
    spread = (variance + norm.eps).rsqrt().reshape(len(x), -1, 1)
    scale = (norm.weight.view(norm.num_groups, -1) * spread).flatten(1)
    middle = mean.reshape(len(x), -1, 1).expand_as(scale.view(len(x), norm.num_groups, -1))
    shift = norm.bias - middle.flatten(1) * scale
    return torch.addcmul(shift.view(*shift.shape, *ones), x, scale.view(*scale.shape, *ones))
