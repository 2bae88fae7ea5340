"""Convolution blocks shared by the networks."""

from math import gcd
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.voxels import Voxels, convolved, group_norm

#: PyTorch leaves 3x3x3 convolutions of one CPU volume with at most so many (channels x depth x
#: rows) to a kernel that was measured to be 5 to 12 times slower than the one (oneDNN's) that it
#: takes for two.
ALONE = 20480


class ConvBlock(nn.Module):
    """Two 3x3x3 convolutions, each followed by group normalisation and SiLU, with a residual path
    around the second.

    On some voxels: features are their rows [k c], and all others are taken for zero.
    """

    def __init__(self, inputs: int, outputs: int, groups: int = 4):
        super().__init__()
        groups = gcd(groups, outputs)
        self.first = nn.Sequential(
            nn.Conv3d(inputs, outputs, 3, padding=1, bias=False),
            nn.GroupNorm(groups, outputs),
            nn.SiLU(),
        )
        self.second = nn.Sequential(
            nn.Conv3d(outputs, outputs, 3, padding=1, bias=False),
            nn.GroupNorm(groups, outputs),
            nn.SiLU(),
        )

    def forward(
        self, x: Float[Tensor, "n i *d"], on: Voxels | None = None
    ) -> Float[Tensor, "n o *d"]:
        x = _step(self.first, x, on)
        return x + _step(self.second, x, on)


def _step(steps: nn.Sequential, x: Tensor, on: Voxels | None) -> Tensor:
    conv, norm = cast(nn.Conv3d, steps[0]), cast(nn.GroupNorm, steps[1])
    if on is None:
        values = convolution(x, conv.weight)
        # not the module's own call: it refuses a group of one value, of which the shift is left
        return F.silu(torch.group_norm(values, norm.num_groups, norm.weight, norm.bias, norm.eps))
    x = convolved(x, conv.weight, on)
    return F.silu(group_norm(x, on.counts, norm.num_groups, (norm.weight, norm.bias), norm.eps))


def convolution(
    x: Float[Tensor, "n i d h w"], weight: Float[Tensor, "o i 3 3 3"]
) -> Float[Tensor, "n o d h w"]:
    """A 3x3x3 convolution without bias, zero beyond the volume; a small volume that is alone goes
    as two halves.
    """
    n, channels, d, h = x.shape[:4]
    if n > 1 or d < 2 or x.is_cuda or channels * d * h > ALONE:
        return F.conv3d(x, weight, padding=1)
    half = (d + 1) // 2
    padded = F.pad(x, (0, 0, 0, 0, 1, 1 + 2 * half - d))
    halves = torch.cat([padded[:, :, : half + 2], padded[:, :, half:]])
    front, back = F.conv3d(halves, weight, padding=(0, 1, 1)).split(1)
    return torch.cat([front, back], dim=2)[:, :, :d]
