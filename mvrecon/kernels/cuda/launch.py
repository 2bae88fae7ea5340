"""CUDA C++ sources, kernels and argument structures, and launches on torch's current stream,
without synchronisation.
"""

from collections.abc import Mapping
from ctypes import c_double, c_int, c_void_p
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from mvrecon.kernels.cuda import driver, nvrtc
from mvrecon.kernels.cuda.driver import BLOCK, Packed

#: Maximum number of voxels of a volume in a kernel.
MOST = 2**31 - 1
#: Types of numbers as the source names them.
NAMES = {
    torch.float32: "float",
    torch.float64: "double",
    torch.float16: "Half",
    torch.bfloat16: "Brain",
}


class Scene(Packed):
    """A call along rays, as in `rays/cuda/source/1_scene.cu`; a source may append fields."""

    _fields_ = [
        *((name, c_void_p) for name in ("lines", "volumes", "stores", "views", "rays", "axes")),
        *((name, c_void_p) for name in ("values", "frames", "flags", "results", "occupied")),
        ("window", c_double * 2),
        *((name, c_int * 3) for name in ("sizes", "corner", "part")),
        *((name, c_int) for name in ("n_views", "rows", "columns", "maps", "n_volumes")),
        *((name, c_int) for name in ("samples", "first_view", "views_here", "blocks_a_view")),
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


@dataclass(frozen=True, eq=False)
class Source:
    """CUDA C++ source of the kernels for one purpose.

    A plugin's kernels are a source of their own: the files of `BASE`, or of `RAYS`, followed
    by its own, which end with a macro.

    Args:
        macro: defines the kernels, given (their suffix, type of arithmetic, stored type, volumes
            that share a ray's index work, method of rays).
        names: names of the kernels.
        packed: their argument structure.
        files: the source files, in order.
    """

    macro: str
    names: tuple[str, ...]
    packed: type[Packed]
    files: tuple[Path, ...]

    @cached_property
    def text(self) -> str:
        """The source without any variant."""
        return "".join(file.read_text() for file in self.files)


_ALONG_RAYS = Path(__file__).parents[1] / "rays" / "cuda" / "source"
_OF_FIELDS = sorted((Path(__file__).parent / "source").glob("*.cu"))
#: What the source of any kernels begins with.
BASE = (_ALONG_RAYS / "0_base.cu", _OF_FIELDS[0])
_FIELDS = (*BASE, *_OF_FIELDS[1:])
#: Kernels along rays.
RAYS = Source(
    "VARIANT",
    ("survey", "store", "project", "record", "gather", "scatter", "vary", "occupy", "bound"),
    Scene,
    tuple(sorted(_ALONG_RAYS.glob("*.cu"))),
)
#: Kernels of a thread a voxel, sample or brick: warps, voxel-driven back-projection, visual hull.
WARPS = Source("WARP_OF", ("invert", "warp", "warp_back", "warp_vary"), Field, _FIELDS)
VOXELS = Source("VOXELS_OF", ("voxel_backproject", "voxel_project"), Field, _FIELDS)
HULL = Source("HULL_OF", ("kept_bricks",), Field, _FIELDS)


class Variant(NamedTuple):
    """A unit of compilation.

    Args:
        source: source of the kernels.
        real: the type of arithmetic.
        stored: the stored type, if different.
        together: volumes that share a ray's index work.
        method: method of rays.
    """

    source: Source
    real: torch.dtype
    stored: torch.dtype | None = None
    together: int = 1
    method: str = "joseph"

    def line(self, suffix: str) -> str:
        """The line of source that defines the kernels with this suffix."""
        types = f"{NAMES[self.real]}, {NAMES[self.stored or self.real]}"
        return f"{self.source.macro}({suffix}, {types}, {self.together}, {self.method.upper()})\n"


def text_of(variants: Mapping[str, Variant]) -> str:
    """The source text, for NVRTC or any C++ compiler, of variants of one source by suffix."""
    lines = [variant.line(suffix) for suffix, variant in variants.items()]
    return next(iter(variants.values())).source.text + "".join(lines)


@cache
def kernels_of(variant: Variant, device: torch.device) -> dict[str, c_void_p]:
    """Return the kernels by name, compiled at the first call for the device's architecture.

    Raises:
        OSError: no driver, no compiler.
        RuntimeError: the compiler or the driver rejects it.
    """
    text = text_of({"": variant})
    architecture = nvrtc.target(driver.capability_of(device), nvrtc.capabilities())
    code = nvrtc.built(text, architecture, str(driver.version()))
    return driver.load(code, variant.source.names, device)


def start(
    variant: Variant, name: str, packed: Packed, like: Tensor, across: int, down: int = 1
) -> None:
    """Launch a kernel on `across` x `down` blocks, on the device of a tensor."""
    driver.launch(kernels_of(variant, like.device)[name], packed, across, down, like.device)


def blocks(threads: int) -> int:
    """Return the number of blocks for so many threads.

    Raises:
        ValueError: as `check_count`.
    """
    check_count(threads)
    return -(-threads // BLOCK)


def check_count(threads: int) -> None:
    """Check that a kernel can count so many voxels, samples or pixels.

    Raises:
        ValueError: too many.
    """
    if threads > MOST:
        raise ValueError(
            f"Expected at most {MOST} voxels, samples or pixels on a GPU, got {threads}; "
            f"backend 'reference' takes more"
        )


def numbers_of(maps: Tensor) -> Tensor:
    """Maps in the kernels' format; keep them until the launch."""
    return maps.detach().double().contiguous()
