"""A small 3-D U-Net (Cicek et al., MICCAI 2016) with group normalisation and additive skips."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.blocks import ConvBlock


class UNet3d(nn.Module):
    """Encoder and decoder over `levels` scales; any spatial size of at least 2^(levels - 1).

    Args:
        inputs: channels in.
        outputs: channels out; a last 1x1x1 convolution without bias makes them.
        width: channels of the finest level; each coarser level has twice as many.
        levels: scales, the finest included.
        zero: start with an output of exactly zero, for a network that corrects something.
    """

    def __init__(self, inputs: int, outputs: int, width: int = 16, levels: int = 3, zero: bool = False):
        super().__init__()
        widths = [width * 2**level for level in range(levels)]
        self.down = nn.ModuleList(ConvBlock(a, b) for a, b in zip([inputs, *widths], widths, strict=False))
        self.reduce = nn.ModuleList(nn.Conv3d(b, a, 1) for a, b in zip(widths, widths[1:], strict=False))
        self.up = nn.ModuleList(ConvBlock(a, a) for a in widths[:-1])
        self.last = nn.Conv3d(width, outputs, 1, bias=False)
        if zero:
            nn.init.zeros_(self.last.weight)

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        skips: list[Tensor] = []
        x = x.contiguous(memory_format=torch.channels_last_3d)
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x = nn.functional.avg_pool3d(x, 2, ceil_mode=True)
            x = block(x)
        for level in reversed(range(len(self.up))):
            skip = skips[level]
            x = nn.functional.interpolate(self.reduce[level](x), size=skip.shape[2:], mode="trilinear")
            x = self.up[level](x + skip)
        return self.last(x)
