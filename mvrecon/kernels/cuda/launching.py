"""Starting these kernels: on torch's current stream, without a wait."""

from ctypes import c_void_p
from functools import cache

import torch
from torch import Tensor

from mvrecon.kernels.cuda.sources import KERNELS, Part, text_of
from mvrecon.kernels.rays.cuda import driver
from mvrecon.kernels.rays.cuda.kernels import loaded
from mvrecon.kernels.rays.cuda.scene import Packed
from mvrecon.kernels.rays.cuda.sources import BLOCK

#: Voxels of a volume that a kernel counts.
MOST = 2**31 - 1


@cache
def kernels_of(part: Part, device: torch.device) -> dict[str, c_void_p]:
    """The kernels by name; compiled at the first call, raises as those along rays."""
    return loaded(text_of({"": part}), KERNELS[part.purpose], device)


def start(part: Part, name: str, field: Packed, like: Tensor, across: int, down: int = 1) -> None:
    """Launch a kernel on `across` x `down` blocks, on the device of a tensor."""
    driver.launch(kernels_of(part, like.device)[name], field, across, down, like.device)


def blocks(threads: int) -> int:
    """Blocks for so many threads.

    Raises:
        ValueError: as `check_count`.
    """
    check_count(threads)
    return -(-threads // BLOCK)


def check_count(threads: int) -> None:
    """Refuse more voxels, samples or pixels than a kernel counts.

    Raises:
        ValueError: there are more.
    """
    if threads > MOST:
        raise ValueError(
            f"Expected at most {MOST} voxels, samples or pixels on a GPU, got {threads}; "
            f"backend 'reference' takes more"
        )


def numbers_of(maps: Tensor) -> Tensor:
    """Maps as the kernels read them; to be kept until they are launched."""
    return maps.detach().double().contiguous()
