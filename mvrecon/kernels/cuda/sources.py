"""The text of these kernels in CUDA C++, for NVRTC or any C++ compiler."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch

from mvrecon.kernels.rays.cuda.sources import FOLDER as RAYS
from mvrecon.kernels.rays.cuda.sources import NAMES

FOLDER = Path(__file__).parent / "source"
#: Channels of a thread, as in `2_warp.cu`; voxels of a block along x, y and z, as in `4_look.cu`;
#: numbers of a map.
PLANES, TILE, MAP = 8, (16, 8, 8), 30
#: Names of the kernels, by what they are for.
KERNELS = {
    "warp": ("invert", "warp", "warp_back", "warp_vary"),
    "look": ("look", "show"),
    "hull": ("judge", "count"),
    "norm": ("sum_features", "normalise", "sum_changes", "change_features"),
}


class Part(NamedTuple):
    """What is compiled at once: the kernels for one purpose, in one type of arithmetic, and of what
    they read where that may be another (warps, normalisation).
    """

    purpose: str
    real: torch.dtype
    stored: torch.dtype | None = None

    def line(self, suffix: str) -> str:
        """The line that makes the kernels, whose names end so."""
        types = f"{NAMES[self.real]}, {NAMES[self.stored or self.real]}"
        return f"{self.purpose.upper()}_OF({suffix}, {types})\n"


@cache
def source() -> str:
    """The text without any kernel."""
    files = RAYS / "0_base.cu", *sorted(FOLDER.glob("*.cu"))
    return "".join(file.read_text() for file in files)


def text_of(parts: Mapping[str, Part]) -> str:
    """The text that makes the kernels of parts, by what their names end with."""
    return source() + "".join(part.line(suffix) for suffix, part in parts.items())
