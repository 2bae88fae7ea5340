"""A small 3-D U-Net (Cicek et al., MICCAI 2016) with group normalisation and additive skips."""

from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.models import voxels
from mvrecon.models.blocks import ConvBlock
from mvrecon.models.masks import halved
from mvrecon.models.voxels import Voxels, pyramid


class UNet3d(nn.Module):
    """Encoder and decoder over `levels` scales; any spatial size, since an axis of one voxel stays
    one when halved.

    With a mask the network is another one, of the same weights: after every convolution the
    features are zero outside the mask (max-pooled on coarser levels), and normalisation, pooling
    and upsampling look at its voxels alone. What it gives does not depend on the empty space around
    the mask, if voxels keep their places modulo 2^(levels - 1). A mask of ones gives what no mask
    gives, up to rounding, for sizes that are multiples of 2^(levels - 1).

    Args:
        inputs: channels in.
        outputs: channels out; a last 1x1x1 convolution without bias makes them.
        width: channels of the finest level; each coarser level has twice as many.
        levels: scales, the finest included.
        zero: start with an output of exactly zero, for a network that corrects something.
    """

    def __init__(
        self, inputs: int, outputs: int, width: int = 16, levels: int = 3, zero: bool = False
    ):
        super().__init__()
        widths = [width * 2**level for level in range(levels)]
        self.down = nn.ModuleList(
            ConvBlock(a, b) for a, b in zip([inputs, *widths], widths, strict=False)
        )
        self.reduce = nn.ModuleList(
            nn.Conv3d(b, a, 1) for a, b in zip(widths, widths[1:], strict=False)
        )
        self.up = nn.ModuleList(ConvBlock(a, a) for a in widths[:-1])
        self.last = nn.Conv3d(width, outputs, 1, bias=False)
        if zero:
            nn.init.zeros_(self.last.weight)

    def forward(
        self, x: Float[Tensor, "n i d h w"], mask: Bool[Tensor, "n 1 d h w"] | None = None
    ) -> Float[Tensor, "n o d h w"]:
        """The answer; with a mask, zero outside it."""
        if mask is not None:
            levels = pyramid(mask, len(self.down))
            return levels[0].put(self.on(levels, levels[0].pick(x)))
        x = x.contiguous(memory_format=torch.channels_last_3d)
        skips: list[Tensor] = []
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x = halved(x)
            x = block(x)
        for level in reversed(range(len(self.up))):
            skip = skips[level]
            x = nn.functional.interpolate(
                self.reduce[level](x), size=skip.shape[2:], mode="trilinear"
            )
            x = self.up[level](x + skip)
        return self.last(x)

    def on(self, levels: Sequence[Voxels], x: Float[Tensor, "k i"]) -> Float[Tensor, "k o"]:
        """The answer at a mask's voxels from their features; `levels` are the mask's `pyramid`."""
        skips: list[Tensor] = []
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x = voxels.halved(x, levels[level - 1], levels[level])
            x = block(x, levels[level])
        for level in reversed(range(len(self.up))):
            x = voxels.doubled(_pointwise(self.reduce[level], x), levels[level + 1], levels[level])
            x = self.up[level](x + skips[level], levels[level])
        return _pointwise(self.last, x)


def _pointwise(conv: nn.Module, x: Float[Tensor, "k i"]) -> Float[Tensor, "k o"]:
    """A 1x1x1 convolution of rows."""
    one = cast(nn.Conv3d, conv)
    return nn.functional.linear(x, one.weight.flatten(1), one.bias)
