"""3-D U-Nets of the literature with published default sizes: the U-Net of Cicek and others, and the
residual U-Net of Lee and others as implemented in pytorch-3dunet.
"""

from itertools import count
from math import gcd
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.registry import check_choice
from mvrecon.methods.learned.unet import trimmed
from mvrecon_baselines.unet2d import check_sizes

Norm = Literal["batch", "group", "none"]
Padding = Literal["valid", "same"]

#: Groups of channels in group normalisation, as in pytorch-3dunet; fewer if they do not divide the
#: width.
GROUPS = 8


class CicekUNet3d(nn.Module):
    """The 3-D U-Net of Cicek and others.

    Two 3x3x3 convolutions, normalisation and ReLU at every level; channels double before each
    max-pooling; 2x2x2 up-convolutions without bias; skips are concatenated. With default options, 3
    input channels and 3 labels it is the published network: it maps 132 x 132 x 116 voxels to 44 x
    44 x 28, with 19 069 955 parameters besides those of the normalisation.

    Source: O. Cicek, A. Abdulkadir, S. Lienkamp, T. Brox, O. Ronneberger, "3D U-Net: learning dense
    volumetric segmentation from sparse annotation", MICCAI 2016.

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        width: channels of the first convolution.
        levels: number of scales, including the finest.
        norm: "batch" as published, "group" for small batches, or "none".
        padding: "valid" as published, whose output lacks a border, or "same" for an output of the
            input's size, which may be any.

    Raises:
        ValueError: an unknown norm or padding, or no level; in `forward` with "valid" padding, a
            size that is too small or odd before a pooling.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        width: int = 32,
        levels: int = 4,
        norm: Norm = "batch",
        padding: Padding = "valid",
    ):
        super().__init__()
        check_sizes(width, levels)
        check_choice("norm", norm, get_args(Norm))
        check_choice("padding", padding, get_args(Padding))
        self.padding: Padding = padding
        first = [inputs, *(width * 2**level for level in range(1, levels))]
        last = [width * 2 ** (level + 1) for level in range(levels)]

        def pair(before: int, between: int, after: int) -> nn.Sequential:
            return nn.Sequential(
                *self._step(before, between, norm), *self._step(between, after, norm)
            )

        self.down = nn.ModuleList(
            pair(before, after // 2, after) for before, after in zip(first, last, strict=True)
        )
        self.expand = nn.ModuleList(
            nn.ConvTranspose3d(c, c, 2, stride=2, bias=False) for c in last[1:]
        )
        self.up = nn.ModuleList(
            pair(coarse + fine, fine, fine) for fine, coarse in zip(last, last[1:], strict=False)
        )
        self.last = nn.Conv3d(last[0], outputs, 1)

    def _step(self, before: int, after: int, norm: Norm) -> list[nn.Module]:
        """A convolution, its normalisation and ReLU."""
        return [
            nn.Conv3d(before, after, 3, padding=self.padding),
            normalisation(norm, after),
            nn.ReLU(inplace=True),
        ]

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o e j x"]:
        if self.padding == "valid":
            for size in x.shape[2:]:
                valid_size(size, len(self.down))
        *skips, x = descended(self.down, x)
        for level in reversed(range(len(skips))):
            x = self.expand[level](x)
            if self.padding == "same":
                x = trimmed(x, skips[level].shape[2:])
            x = self.up[level](torch.cat([middle(skips[level], x.shape[2:]), x], dim=1))
        return self.last(x)


class ResidualUNet3d(nn.Module):
    """The residual 3-D U-Net of Lee and others.

    One residual block at every level, after a 1x1x1 convolution to the level's channels;
    max-pooling between; 3x3x3 up-convolutions, whose outputs are added to the skips. Layers and
    their order follow pytorch-3dunet's `ResidualUNet3D`: normalisation, convolution, ReLU, with the
    last ReLU after the sum. Supports any spatial size: up-convolutions return the size of their
    skip, where pytorch-3dunet uses nearest-neighbour interpolation.

    Source: K. Lee, J. Zung, P. Li, V. Jain, H. S. Seung, "Superhuman accuracy on the SNEMI3D
    connectomics challenge", arXiv 1706.00120; A. Wolny and others, eLife 9:e57613 (2020).

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        width: channels of the finest level; each coarser level has twice as many.
        levels: number of scales, including the finest.
        norm: "group", "batch" or "none".

    Raises:
        ValueError: an unknown norm, or no level.
    """

    def __init__(
        self, inputs: int, outputs: int, width: int = 64, levels: int = 5, norm: Norm = "group"
    ):
        super().__init__()
        check_sizes(width, levels)
        check_choice("norm", norm, get_args(Norm))
        widths = [width * 2**level for level in range(levels)]
        self.down = nn.ModuleList(
            ResidualBlock(a, b, norm) for a, b in zip([inputs, *widths], widths, strict=False)
        )
        self.expand = nn.ModuleList(
            nn.ConvTranspose3d(b, a, 3, stride=2, padding=1, bias=False)
            for a, b in zip(widths, widths[1:], strict=False)
        )
        self.up = nn.ModuleList(ResidualBlock(a, a, norm) for a in widths[:-1])
        self.last = nn.Conv3d(width, outputs, 1)

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        *skips, x = descended(self.down, x)
        for level in reversed(range(len(skips))):
            size = list(skips[level].shape[2:])
            x = self.up[level](self.expand[level](x, output_size=size) + skips[level])
        return self.last(x)


class ResidualBlock(nn.Module):
    """Two normalised 3x3x3 convolutions with a residual path around them."""

    def __init__(self, inputs: int, outputs: int, norm: Norm):
        super().__init__()
        bias = norm == "none"
        self.widen = nn.Identity() if inputs == outputs else nn.Conv3d(inputs, outputs, 1)
        self.change = nn.Sequential(
            normalisation(norm, outputs),
            nn.Conv3d(outputs, outputs, 3, padding=1, bias=bias),
            nn.ReLU(inplace=True),
            normalisation(norm, outputs),
            nn.Conv3d(outputs, outputs, 3, padding=1, bias=bias),
        )

    def forward(self, x: Float[Tensor, "n i d h w"]) -> Float[Tensor, "n o d h w"]:
        x = self.widen(x)
        return F.relu(x + self.change(x))


def normalisation(norm: Norm, channels: int) -> nn.Module:
    """A normalisation layer."""
    if norm == "batch":
        return nn.BatchNorm3d(channels)
    return nn.GroupNorm(gcd(GROUPS, channels), channels) if norm == "group" else nn.Identity()


def descended(blocks: nn.ModuleList, x: Float[Tensor, "n c d h w"]) -> list[Tensor]:
    """The outputs of the blocks of each level, the finest first, with max-pooling over 2x2x2 voxels
    between levels and smaller windows at odd ends.
    """
    outputs: list[Tensor] = []
    for block in blocks:
        outputs.append(block(F.max_pool3d(outputs[-1], 2, ceil_mode=True) if outputs else x))
    return outputs


def middle(x: Float[Tensor, "n c d h w"], size: torch.Size) -> Float[Tensor, "n c e i x"]:
    """Crop volumes to their central part of the given size along (z, y, x)."""
    for axis, (whole, part) in enumerate(zip(x.shape[2:], size, strict=True), start=2):
        x = x.narrow(axis, (whole - part) // 2, part)
    return x


def valid_size(size: int, levels: int) -> int:
    """Output size along an axis in voxels, for convolutions without padding.

    Args:
        size: size of the input, in voxels.
        levels: scales of a U-Net with two 3x3x3 convolutions per scale.

    Raises:
        ValueError: a size is odd before a pooling, or the output is empty; the message contains the
            next larger valid size.
    """
    answer = _answer_size(size, levels)
    if answer is None:
        larger = next(n for n in count(size + 1) if _answer_size(n, levels) is not None)
        raise ValueError(
            f"A U-Net of {levels} levels with padding 'valid' expected an even size before each "
            f"pooling, along every axis, and more than its border; got {size} voxels, the next "
            f"larger size that fits is {larger}; padding 'same' takes any"
        )
    return answer


def _answer_size(size: int, levels: int) -> int | None:
    for _ in range(levels - 1):
        size -= 4
        if size < 2 or size % 2:
            return None
        size //= 2
    answer = (size - 4) * 2 ** (levels - 1) - 4 * (2 ** (levels - 1) - 1)
    return answer if min(size - 4, answer) > 0 else None
