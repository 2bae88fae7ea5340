"""A U-Net without normalisation, on images or volumes, which preserves densities; its convolutions,
and conversions between resolutions.
"""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from mvrecon.core.registry import check_choice

#: Scale of a block's residual branch.
BRANCH_SCALE = 0.5

#: Number format of convolutions: float32, or "auto": bfloat16 if the processor or GPU has
#: instructions for it, which on a CPU is 5 to 10 times as fast with AMX, twice as fast with
#: AVX-512, and many times slower without.
Precision = Literal["float32", "auto"]

#: For 3x3x3 convolutions of one CPU volume with at most so many (channels x depth x rows) PyTorch
#: uses a kernel 5 to 12 times slower (measured) than oneDNN's, which it uses for two.
MAX_SLOW_SIZE = 20480


class PlainUNet(nn.Module):
    """U-Net without normalisation, for images or volumes of any size.

    A first convolution of 3 pixels; at each scale, down and up, one block x + conv(silu(conv(x))) /
    2; convolutions of 2 pixels and their transposes between scales; additive skips; a last
    convolution of one pixel.

    Args:
        axes: 2 for images, 3 for volumes.
        inputs: channels in.
        outputs: channels out.
        widths: channels of each scale, the finest first.
        zero: number of first outputs that start at exactly zero, for corrections.
        precision: precision of the convolutions.

    Raises:
        ValueError: an unknown precision.
    """

    def __init__(
        self,
        axes: Literal[2, 3],
        inputs: int,
        outputs: int,
        widths: Sequence[int],
        zero: int = 0,
        precision: Precision = "float32",
    ):
        super().__init__()
        check_choice("precision", precision, get_args(Precision))
        kind = (nn.Conv2d, nn.Conv3d)[axes - 2]
        back = (nn.ConvTranspose2d, nn.ConvTranspose3d)[axes - 2]
        steps = list(zip(widths, widths[1:], strict=False))
        self.precision: Precision = precision
        self.multiple = 2 ** len(steps)
        self.first = kind(inputs, widths[0], 3, padding=1)
        self.down = nn.ModuleList(Block(kind, width) for width in widths)
        self.coarser = nn.ModuleList(kind(fine, coarse, 2, stride=2) for fine, coarse in steps)
        self.finer = nn.ModuleList(back(coarse, fine, 2, stride=2) for fine, coarse in steps)
        self.up = nn.ModuleList(Block(kind, fine) for fine, _ in steps)
        self.last = kind(widths[0], outputs, 1)
        nn.init.zeros_(self.last.weight[:zero])
        if self.last.bias is not None:
            nn.init.zeros_(self.last.bias)

    def forward(
        self, x: Float[Tensor, "n i *d"], coarse: Mapping[int, Tensor] | None = None
    ) -> Float[Tensor, "n o *d"]:
        """Apply the network; the size is that of x.

        Args:
            x: images or volumes.
            coarse: features to add on the way down, by scale (0 the finest): with its channels, and
                pixels or voxels 2^scale times as large as those of x.
        """
        coarse = {
            level: padded(part, self.multiple >> level) for level, part in (coarse or {}).items()
        }
        whole = padded(x, self.multiple)
        # takes three quarters of the time of the default memory order on a CPU
        order = torch.channels_last_3d if x.ndim == 5 else torch.channels_last
        whole = whole.contiguous(memory_format=order)
        with arithmetic(self.precision, x):
            answer = self._answer(whole, coarse)
        return trimmed(answer, x.shape[2:]).to(x.dtype)

    def _answer(self, x: Tensor, coarse: Mapping[int, Tensor]) -> Tensor:
        x, skips = spread(self.first, x), []
        for level, block in enumerate(self.down):
            if level:
                skips.append(x)
                x = self.coarser[level - 1](x)
            if level in coarse:
                x = x + coarse[level].to(x.dtype)
            x = block(x)
        for level in reversed(range(len(self.up))):
            x = self.up[level](self.finer[level](x) + skips[level])
        # not in half precision, whose rounding would stay in the prediction
        with torch.autocast(x.device.type, enabled=False):
            return pointwise(self.last, x.to(self.last.weight.dtype))


class Block(nn.Module):
    """Residual block x + conv(silu(conv(x))) / 2 of a network without normalisation."""

    def __init__(self, kind: type[nn.Conv2d | nn.Conv3d], width: int):
        super().__init__()
        self.first, self.second = (kind(width, width, 3, padding=1) for _ in range(2))
        for conv in (self.first, self.second):
            nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
            if conv.bias is not None:
                nn.init.zeros_(conv.bias)

    def forward(self, x: Float[Tensor, "n c *d"]) -> Float[Tensor, "n c *d"]:
        return torch.add(x, spread(self.second, F.silu(spread(self.first, x))), alpha=BRANCH_SCALE)


def spread(conv: nn.Module, x: Float[Tensor, "n i *d"]) -> Float[Tensor, "n o *d"]:
    """A convolution of 3 pixels; of volumes, by `convolution`."""
    return convolution(x, conv.weight, conv.bias) if isinstance(conv, nn.Conv3d) else conv(x)


def pointwise(conv: nn.Conv2d | nn.Conv3d, x: Float[Tensor, "n i *d"]) -> Float[Tensor, "n o *d"]:
    """A convolution of one pixel as a matrix product: less than half the time on a CPU with few
    channels.
    """
    return F.linear(x.movedim(1, -1), conv.weight.flatten(1), conv.bias).movedim(-1, 1)


#: CPU features of native bfloat16 multiplication, by torch's names.
BFLOAT16_FEATURES = ("amx_bf16", "avx512_bf16")


@cache
def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 natively: AMX or AVX-512."""
    # torch 2.10 does not report it: assume none
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in BFLOAT16_FEATURES)


#: First NVIDIA compute capability with bfloat16 tensor cores: Ampere.
AMPERE = (8, 0)


@cache
def gpu_has_bfloat16(device: torch.device) -> bool:
    """Whether a GPU multiplies bfloat16 natively."""
    return torch.cuda.is_available() and torch.cuda.get_device_capability(device) >= AMPERE


def arithmetic(precision: Precision, x: Tensor) -> AbstractContextManager[object]:
    """Context in which convolutions of tensors like x use the given number format."""
    if precision != "auto" or x.dtype != torch.float32:
        return nullcontext()
    narrow = has_bfloat16() if x.is_cpu else x.is_cuda and gpu_has_bfloat16(x.device)
    return torch.autocast(x.device.type, torch.bfloat16) if narrow else nullcontext()


def convolution(
    x: Float[Tensor, "n i d h w"], weight: Float[Tensor, "o i 3 3 3"], bias: Tensor | None = None
) -> Float[Tensor, "n o d h w"]:
    """A 3x3x3 convolution with zero padding; a single small volume is split in two halves."""
    n, channels, d, h = x.shape[:4]
    if d == 2 and x.is_cpu and torch.is_autocast_enabled("cpu"):
        # oneDNN's derivative in the weights of two slices in bfloat16 is arbitrary (torch 2.13)
        return F.conv3d(F.pad(x, (0, 0, 0, 0, 0, 1)), weight, bias, padding=1)[:, :, :2]
    quick = x.is_cuda or torch.is_autocast_enabled(x.device.type)  # bfloat16 is left to oneDNN
    if n > 1 or d < 2 or quick or channels * d * h > MAX_SLOW_SIZE:
        return F.conv3d(x, weight, bias, padding=1)
    half = (d + 1) // 2
    padded = F.pad(x, (0, 0, 0, 0, 1, 1 + 2 * half - d))
    halves = torch.cat([padded[:, :, : half + 2], padded[:, :, half:]])
    front, back = F.conv3d(halves, weight, bias, padding=(0, 1, 1)).split(1)
    return torch.cat([front, back], dim=2)[:, :, :d]


class _Halved(torch.autograd.Function):
    """`avg_pool3d` with a deterministic derivative; torch's own is not on a GPU."""

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
    """Means of 2x2x2 voxels, of fewer at odd ends. The derivative is deterministic."""
    return _Halved.apply(x)


def to_cells(x: Shaped[Tensor, "n c *d"], edge: int) -> Shaped[Tensor, "n k *e"]:
    """Rearrange cells of `edge` pixels along each axis into channels (space to depth).

    Args:
        x: values on axes whose sizes `edge` divides.
        edge: edge of a cell, in pixels or voxels.
    """
    if edge == 1:
        return x
    n, c, *sizes = x.shape
    axes = len(sizes)
    split = x.reshape(n, c, *(part for size in sizes for part in (size // edge, edge)))
    outer, inner = range(2, 2 + 2 * axes, 2), range(3, 3 + 2 * axes, 2)
    return split.permute(0, 1, *inner, *outer).flatten(1, 1 + axes)


def from_cells(x: Shaped[Tensor, "n k *e"], edge: int) -> Shaped[Tensor, "n c *d"]:
    """Invert `to_cells`."""
    if edge == 1:
        return x
    n, k, *sizes = x.shape
    axes = len(sizes)
    split = x.reshape(n, k // edge**axes, *[edge] * axes, *sizes)
    order = [axis for i in range(axes) for axis in (2 + axes + i, 2 + i)]
    return split.permute(0, 1, *order).reshape(n, -1, *(size * edge for size in sizes))


def padded(x: Shaped[Tensor, "n c *d"], multiple: int) -> Shaped[Tensor, "n c *e"]:
    """Pad with zeros at the end to sizes that `multiple` divides."""
    behind = [-size % multiple for size in reversed(x.shape[2:])]
    return F.pad(x, [amount for axis in behind for amount in (0, axis)]) if any(behind) else x


def trimmed(x: Shaped[Tensor, "n c *e"], sizes: Sequence[int]) -> Shaped[Tensor, "n c *d"]:
    """Crop each axis to its first pixels or voxels; undoes `padded`."""
    for axis, size in enumerate(sizes, start=2):
        if x.shape[axis] > size:
            x = x.narrow(axis, 0, size)
    return x
