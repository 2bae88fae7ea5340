"""Which CUDA kernels there are, the structures that they are launched with, and their launch: on
torch's current stream, without a wait.
"""

from collections.abc import Mapping
from ctypes import c_double, c_int, c_void_p
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from mvrecon.kernels.cuda import driver, nvrtc
from mvrecon.kernels.cuda.code_cache import cached
from mvrecon.kernels.cuda.driver import BLOCK, Packed

FOLDER = Path(__file__).parent / "source"
RAYS = Path(__file__).parents[1] / "rays" / "cuda" / "source"
#: Voxels of a volume that a kernel counts.
MOST = 2**31 - 1
#: Names of the kernels, by what they are for.
KERNELS = {
    "rays": (
        *("survey", "store", "project", "record", "gather", "scatter", "vary"),
        *("occupy", "bound"),
    ),
    "attenuated": ("survey", "store", "weaken", "receive", "bend"),
    "warp": ("invert", "warp", "warp_back", "warp_vary"),
    "look": ("look", "show"),
    "hull": ("judge", "count"),
}
#: Types of numbers as the source names them.
NAMES = {
    torch.float32: "float",
    torch.float64: "double",
    torch.float16: "Half",
    torch.bfloat16: "Brain",
}


class Scene(Packed):
    """A call along rays, as in `rays/cuda/source/1_scene.cu`."""

    _fields_ = [
        *((name, c_void_p) for name in ("lines", "volumes", "stores", "views", "rays", "axes")),
        *((name, c_void_p) for name in ("values", "frames", "flags", "results", "occupied")),
        ("layers", c_void_p),
        ("fixed", c_double),
        ("window", c_double * 2),
        *((name, c_int * 3) for name in ("sizes", "corner", "part")),
        *((name, c_int) for name in ("n_views", "rows", "columns", "maps", "n_volumes")),
        *((name, c_int) for name in ("samples", "first_view", "views_here", "blocks_a_view")),
        ("n_layers", c_int),
    ]


class Field(Packed):
    """A call for warps, voxel-driven back-projection or the hull, as in `source/1_field.cu`."""

    _fields_ = [
        *((name, c_void_p) for name in ("maps", "inverse", "origin", "by", "result")),
        ("window", c_double * 2),
        *((name, c_int * 3) for name in ("source", "shape")),
        *((name, c_int) for name in ("sources", "kinds", "items", "channels")),
        *((name, c_int) for name in ("blocks", "weighted")),
        ("voxels", c_int * 3),
        *((name, c_int) for name in ("edge", "enough", "keep_unseen", "parallel")),
        ("reach", c_double),
    ]


class Variant(NamedTuple):
    """What is compiled at once.

    Args:
        purpose: a name in `KERNELS`.
        real: the type of arithmetic.
        stored: the type of what is read, where that may be another.
        together: volumes that share a ray's index work.
        method: of rays.
    """

    purpose: str
    real: torch.dtype
    stored: torch.dtype | None = None
    together: int = 1
    method: str = "joseph"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the kernels."""
        return KERNELS[self.purpose]

    @property
    def packed(self) -> type[Packed]:
        """The structure that they are launched with."""
        return Scene if self.purpose in ("rays", "attenuated") else Field

    def line(self, suffix: str) -> str:
        """The line of source that makes the kernels, whose names end so."""
        types = NAMES[self.real], NAMES[self.stored or self.real]
        method = self.method.upper()
        if self.purpose == "rays":
            return f"VARIANT({suffix}, {types[0]}, {types[1]}, {self.together}, {method})\n"
        if self.purpose == "attenuated":
            return f"ATTENUATED({suffix}, {types[0]}, {method})\n"
        return f"{self.purpose.upper()}_OF({suffix}, {types[0]}, {types[1]})\n"


@cache
def source(packed: type[Packed]) -> str:
    """The CUDA C++ of the kernels with a structure, without any variant."""
    own = [RAYS / "0_base.cu", *sorted(FOLDER.glob("*.cu"))]
    files = sorted(RAYS.glob("*.cu")) if packed is Scene else own
    return "".join(file.read_text() for file in files)


def text_of(variants: Mapping[str, Variant]) -> str:
    """The text, for NVRTC or any C++ compiler, that makes the kernels of variants with the same
    structure, by what their names end with.
    """
    lines = [variant.line(suffix) for suffix, variant in variants.items()]
    return source(next(iter(variants.values())).packed) + "".join(lines)


@cache
def kernels_of(variant: Variant, device: torch.device) -> dict[str, c_void_p]:
    """The kernels by name; compiled at the first call, for the device's architecture.

    Raises:
        OSError: no driver, no compiler.
        RuntimeError: the compiler or the driver refuses it.
    """
    text = text_of({"": variant})
    architecture = nvrtc.target(driver.capability_of(device), nvrtc.capabilities())
    made_of = (text, architecture, *nvrtc.OPTIONS, nvrtc.version(), str(driver.version()))
    name = sha256("\n".join(made_of).encode()).hexdigest()
    code = cached(name, lambda: nvrtc.build(text, architecture))
    return driver.load(code, variant.names, device)


def start(
    variant: Variant, name: str, packed: Packed, like: Tensor, across: int, down: int = 1
) -> None:
    """Launch a kernel on `across` x `down` blocks, on the device of a tensor."""
    driver.launch(kernels_of(variant, like.device)[name], packed, across, down, like.device)


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
