"""A 2-D U-Net on the slices of volumes, or on the sinograms of detector rows."""

from collections.abc import Callable
from math import gcd

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

#: Groups of channels in group normalisation; fewer if they do not divide the width.
GROUPS = 4


class UNet2d(nn.Module):
    """2-D U-Net that maps the slices of volumes one by one.

    Ronneberger and others (MICCAI 2015) with group normalisation, SiLU, mean pooling, bilinear
    upsampling and additive skips. Supports any size.

    Args:
        inputs: number of input channels.
        outputs: number of output channels, by a final 1x1 convolution without bias.
        width: channels of the finest level; each coarser level has twice as many.
        levels: number of scales, including the finest.
        zero: number of leading output channels that are initially exactly zero.

    Raises:
        ValueError: no channel, or no level.
    """

    def __init__(self, inputs: int, outputs: int, width: int = 32, levels: int = 4, zero: int = 0):
        super().__init__()
        check_sizes(width, levels)
        widths = [width * 2**level for level in range(levels)]
        pairs = list(zip(widths, widths[1:], strict=False))
        self.down = nn.ModuleList(
            ConvBlock2d(a, b) for a, b in zip([inputs, *widths], widths, strict=False)
        )
        self.reduce = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairs)
        self.up = nn.ModuleList(ConvBlock2d(a, a) for a, _ in pairs)
        self.last = nn.Conv2d(width, outputs, 1, bias=False)
        nn.init.zeros_(self.last.weight[:zero])

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        return by_slices(self._slices, x)

    def _slices(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h w"]:
        skips: list[Tensor] = []
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x = F.avg_pool2d(x, 2, ceil_mode=True)
            x = block(x)
        for level in reversed(range(len(self.up))):
            skip = skips[level]
            x = F.interpolate(self.reduce[level](x), size=skip.shape[2:], mode="bilinear")
            x = self.up[level](x + skip)
        return self.last(x)


def check_sizes(width: int, levels: int) -> None:
    """Check the sizes of a U-Net.

    Raises:
        ValueError: no channel, or no level.
    """
    if min(width, levels) < 1:
        raise ValueError(
            f"A U-Net needs at least one channel and one level, got width={width}, levels={levels}"
        )


class ConvBlock2d(nn.Module):
    """Two 3x3 convolutions, each followed by group normalisation and SiLU, with a residual path
    around the second.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        groups = gcd(GROUPS, outputs)
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.first_norm = nn.GroupNorm(groups, outputs)
        self.second_norm = nn.GroupNorm(groups, outputs)

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h w"]:
        x = normalised_silu(self.first_norm, self.first(x))
        return x + normalised_silu(self.second_norm, self.second(x))


def normalised_silu(norm: nn.GroupNorm, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    """SiLU of group normalisation; the layer's own `forward` raises an error for groups of one
    value.
    """
    return F.silu(torch.group_norm(x, norm.num_groups, norm.weight, norm.bias, norm.eps))


def by_slices(
    network: Callable[[Tensor], Tensor], x: Float[Tensor, "n i d h w"]
) -> Float[Tensor, "n o d h w"]:
    """Apply a 2-D network to the slices of volumes."""
    slices = x.transpose(1, 2).flatten(0, 1).contiguous(memory_format=torch.channels_last)
    return network(slices).unflatten(0, (len(x), x.shape[2])).transpose(1, 2)
