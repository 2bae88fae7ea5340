"""A U-Net without normalisation, on images or volumes: densities keep their values."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.cross_view.cells import padded, trimmed
from mvrecon.models.networks import convolution

#: Of what a block adds to its input.
GAIN = 0.5

#: In which numbers networks convolve: float32, or "auto": bfloat16 where the processor or the GPU
#: has instructions for it, which on a CPU is 5 to 10 times as fast with AMX, twice as fast with
#: AVX-512's, and many times slower elsewhere.
Precision = Literal["float32", "auto"]


class PlainUNet(nn.Module):
    """U-Net without normalisation maps images or volumes of any size.

    A first convolution of 3 pixels; at each scale, on the way down and on the way up, one block x +
    conv(silu(conv(x))) / 2; steps between scales by convolutions of 2 pixels and their transposes;
    additive skips; a last convolution of one pixel.

    Args:
        axes: 2 for images, 3 for volumes.
        inputs: channels in.
        outputs: channels out.
        widths: channels of each scale, the finest first.
        zero: so many of the first outputs start at exactly zero, as what only corrects does.
        precision: of the convolutions.
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
        """Images or volumes of the size of x.

        Args:
            x: images or volumes.
            coarse: features to add on the way down, by the scale that they belong to, 0 the finest:
                of its channels, and of pixels or voxels 2^scale times as large as those of x.
        """
        coarse = {
            level: padded(part, self.multiple >> level) for level, part in (coarse or {}).items()
        }
        whole = padded(x, self.multiple)
        # three quarters of the time of the default order, on a CPU
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
        # sums of few products: not half precision, whose rounding would stay in what it predicts
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
        return torch.add(x, spread(self.second, F.silu(spread(self.first, x))), alpha=GAIN)


def spread(conv: nn.Module, x: Float[Tensor, "n i *d"]) -> Float[Tensor, "n o *d"]:
    """A convolution of 3 pixels; of volumes, by the quicker way of `convolution`."""
    return convolution(x, conv.weight, conv.bias) if isinstance(conv, nn.Conv3d) else conv(x)


def pointwise(conv: nn.Conv2d | nn.Conv3d, x: Float[Tensor, "n i *d"]) -> Float[Tensor, "n o *d"]:
    """A convolution of one pixel as a product of matrices: less than half the time on a CPU where
    channels are few.
    """
    return F.linear(x.movedim(1, -1), conv.weight.flatten(1), conv.bias).movedim(-1, 1)


#: Of a processor that multiplies bfloat16 by itself, as torch calls them.
INSTRUCTIONS = ("amx_bf16", "avx512_bf16")


@cache
def has_bfloat16() -> bool:
    """Whether the processor has instructions that multiply bfloat16: AMX, or those of AVX-512."""
    # torch 2.10 does not tell: then as if there were none
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in INSTRUCTIONS)


#: The first compute capability of NVIDIA's whose tensor cores multiply bfloat16: Ampere's.
AMPERE = (8, 0)


@cache
def gpu_has_bfloat16(device: torch.device) -> bool:
    """Whether a GPU has instructions that multiply bfloat16."""
    return torch.cuda.is_available() and torch.cuda.get_device_capability(device) >= AMPERE


def arithmetic(precision: Precision, x: Tensor) -> AbstractContextManager[object]:
    """Context in which convolutions of tensors like x are computed in the numbers asked for."""
    if precision != "auto" or x.dtype != torch.float32:
        return nullcontext()
    narrow = has_bfloat16() if x.is_cpu else x.is_cuda and gpu_has_bfloat16(x.device)
    return torch.autocast(x.device.type, torch.bfloat16) if narrow else nullcontext()
