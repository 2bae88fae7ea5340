"""A small 3-D U-Net (Cicek et al., MICCAI 2016) with group normalisation and additive skips."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.geometry.box import Box, placed
from mvrecon.models.blocks import ConvBlock
from mvrecon.models.bricks import active_bricks
from mvrecon.models.masks import halved, pooled, upsampled


class UNet3d(nn.Module):
    """Encoder and decoder over `levels` scales; any spatial size of at least 2^(levels - 1).

    With a mask the network is another one, of the same weights: after every convolution the features are zero outside
    the mask (max-pooled on coarser levels), and normalisation, pooling and upsampling look at its voxels alone. What it
    gives does not depend on the empty space around the mask, if voxels keep their places modulo 2^(levels - 1). A mask
    of ones gives what no mask gives, up to rounding, for sizes that are multiples of 2^(levels - 1).

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

    def forward(
        self, x: Float[Tensor, "n i d h w"], mask: Bool[Tensor, "n 1 d h w"] | None = None, bricks: str = "never"
    ) -> Float[Tensor, "n o d h w"]:
        """The answer; with a mask, zero outside it, and by `bricks` ("auto", "always", "never") where that pays."""
        x = x.contiguous(memory_format=torch.channels_last_3d)
        if mask is not None:
            return self._masked(x, mask.to(x.dtype), bricks)
        skips: list[Tensor] = []
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x = halved(x)
            x = block(x)
        for level in reversed(range(len(self.up))):
            skip = skips[level]
            x = nn.functional.interpolate(self.reduce[level](x), size=skip.shape[2:], mode="trilinear")
            x = self.up[level](x + skip)
        return self.last(x)

    def _masked(self, x: Tensor, mask: Tensor, bricks: str) -> Tensor:
        masks, active, skips = [mask], [active_bricks(mask, bricks)], []
        x = x * mask
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x, mask = pooled(x, mask)
                masks.append(mask)
                active.append(active_bricks(mask, bricks))
            x = block(x, mask, active[level])
        for level in reversed(range(len(self.up))):
            whole = [2 * n for n in x.shape[2:]]
            x = upsampled(self.reduce[level](x), masks[level + 1], masks[level], whole)
            x = self.up[level](x + skips[level], masks[level], active[level])
        return self.last(x)


def on_its_box(
    net: UNet3d, x: Float[Tensor, "n i d h w"], mask: Bool[Tensor, "n 1 d h w"], bricks: str = "never"
) -> Float[Tensor, "n o d h w"]:
    """A masked network's answer, worked out on the least box around the mask that keeps coarse voxels in place."""
    shape = x.shape[2:]
    box = Box.around(mask).aligned(2 ** len(net.up), shape)
    if not box.size:
        return x.new_zeros(len(x), net.last.out_channels, *shape)
    part = net(x[..., *box.slices], mask[..., *box.slices], bricks)
    return placed(part, box, shape)
