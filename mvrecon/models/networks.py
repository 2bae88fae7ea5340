"""Networks on volumes: a small 3-D U-Net (Cicek et al., MICCAI 2016) with group normalisation and
additive skips, its convolution blocks, and the steps between its scales.

On the voxels of a mask alone, the same weights work on rows: `sparse`.
"""

from collections.abc import Sequence
from math import gcd
from typing import Any, cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.models import sparse
from mvrecon.models.normalisation import keeps_channels_last, normalised_silu
from mvrecon.models.sparse import Voxels, pyramid

#: Levels of a U-Net, and how many voxels along each axis its coarsest level joins into one: crops
#: that begin at such multiples keep the coarse voxels in place.
LEVELS = 3
MULTIPLE = 2 ** (LEVELS - 1)

#: Groups of channels in group normalisation; fewer where a width is no multiple of it.
GROUPS = 4

#: PyTorch leaves 3x3x3 convolutions of one CPU volume with at most so many (channels x depth x
#: rows) to a kernel that was measured to be 5 to 12 times slower than the one (oneDNN's) that it
#: takes for two.
ALONE = 20480


class UNet3d(nn.Module):
    """3-D U-Net with additive skips maps volumes of any size, and can keep to the voxels of a mask.

    Encoder and decoder over `levels` scales; an axis of one voxel stays one when halved.

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
    """

    takes_mask = True

    def __init__(self, inputs: int, outputs: int, width: int = 16, levels: int = LEVELS):
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
            x = F.interpolate(self.reduce[level](x), size=skip.shape[2:], mode="trilinear")
            x = self.up[level](x + skip)
        return self.last(x)

    def on(self, levels: Sequence[Voxels], x: Float[Tensor, "k i"]) -> Float[Tensor, "k o"]:
        """The answer at a mask's voxels from their features; `levels` are the mask's `pyramid`."""
        skips: list[Tensor] = []
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x = sparse.halved(x, levels[level - 1], levels[level])
            x = block(x, levels[level])
        for level in reversed(range(len(self.up))):
            x = sparse.doubled(_pointwise(self.reduce[level], x), levels[level + 1], levels[level])
            x = self.up[level](x + skips[level], levels[level])
        return _pointwise(self.last, x)


class ConvBlock(nn.Module):
    """Two 3x3x3 convolutions, each followed by group normalisation and SiLU, with a residual path
    around the second.

    On some voxels: features are their rows [k c], and all others are taken for zero.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        groups = gcd(GROUPS, outputs)
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
        return normalised_silu(norm, convolution(x, conv.weight))
    x = sparse.convolved(x, conv.weight, on)
    return F.silu(
        sparse.group_norm(x, on.counts, norm.num_groups, (norm.weight, norm.bias), norm.eps)
    )


def convolution(
    x: Float[Tensor, "n i d h w"], weight: Float[Tensor, "o i 3 3 3"], bias: Tensor | None = None
) -> Float[Tensor, "n o d h w"]:
    """A 3x3x3 convolution, zero beyond the volume; a small volume that is alone goes as two
    halves.
    """
    if keeps_channels_last(x):  # steps between scales give channels first
        x = x.contiguous(memory_format=torch.channels_last_3d)
    n, channels, d, h = x.shape[:4]
    quick = x.is_cuda or torch.is_autocast_enabled(x.device.type)  # bfloat16 is left to oneDNN
    if n > 1 or d < 2 or quick or channels * d * h > ALONE:
        return F.conv3d(x, weight, bias, padding=1)
    half = (d + 1) // 2
    padded = F.pad(x, (0, 0, 0, 0, 1, 1 + 2 * half - d))
    halves = torch.cat([padded[:, :, : half + 2], padded[:, :, half:]])
    front, back = F.conv3d(halves, weight, bias, padding=(0, 1, 1)).split(1)
    return torch.cat([front, back], dim=2)[:, :, :d]


def _pointwise(conv: nn.Module, x: Float[Tensor, "k i"]) -> Float[Tensor, "k o"]:
    """A 1x1x1 convolution of rows."""
    one = cast(nn.Conv3d, conv)
    return F.linear(x, one.weight.flatten(1), one.bias)


class _Halved(torch.autograd.Function):
    """torch's own derivative of `avg_pool3d` adds up in no fixed order on a GPU; this one, the same
    to the last bit, adds up nothing."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return F.avg_pool3d(x, [min(2, size) for size in x.shape[2:]], ceil_mode=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.shape = inputs[0].shape[2:]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        share = gradient / 8
        for axis, size in enumerate(ctx.shape, start=2):
            if size % 2:  # the last mean is of half as many
                share = torch.cat(
                    [share.narrow(axis, 0, size // 2), 2 * share.narrow(axis, size // 2, 1)],
                    dim=axis,
                )
        d, h, w = ctx.shape
        return F.interpolate(share, scale_factor=2.0, mode="nearest")[:, :, :d, :h, :w]


def halved(x: Float[Tensor, "n c d h w"]) -> Float[Tensor, "n c e i x"]:
    """Means of 2x2x2 voxels; at odd ends, of as many as there are. Its derivative has the same bits
    in every run.
    """
    return _Halved.apply(x)


def upsampled(
    x: Float[Tensor, "n c e i x"],
    mask: Float[Tensor, "n 1 e i x"],
    onto: Float[Tensor, "n 1 d h w"],
    size: Sequence[int],
) -> Float[Tensor, "n c d h w"]:
    """Trilinear interpolation between the voxels of a coarse mask, on those of a fine one.

    Args:
        x: coarse features; their values outside the mask do not matter.
        mask: the coarse one.
        onto: the fine one, in the coarse one's.
        size: of all coarse voxels on the fine lattice; what `onto` has not is cut off.
    """
    d, h, w = onto.shape[2:]
    values, shares = (
        F.interpolate(f, size=list(size), mode="trilinear")[:, :, :d, :h, :w]
        for f in (x * mask, mask)
    )
    return values * (onto / torch.where(shares > 0, shares, 1.0))
