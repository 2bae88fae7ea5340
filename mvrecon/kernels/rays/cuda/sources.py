"""The text of the kernels in CUDA C++, for NVRTC or any C++ compiler: the files of `source/`, and a
line for each variant.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch

from mvrecon.kernels.rays.trace import JOSEPH, METHODS, SIDDON, TRILINEAR

FOLDER = Path(__file__).parent / "source"
#: Threads of a block and of a warp, volumes that share a ray, as in `1_scene.cu`; cells that a
#: thread copies, as in `4_project.cu`.
BLOCK, WARP, TOGETHER, RUN = 128, 32, 4, 8
#: Fours of numbers that are recorded of a ray, by method, as in `5_backproject.cu`.
QUADS = {JOSEPH: 2, SIDDON: 3, TRILINEAR: 2}
#: Names of the kernels.
KERNELS = (
    *("survey", "store", "project", "record", "gather", "scatter", "vary"),
    *("occupy", "bound"),
)
#: Of attenuated rays.
ATTENUATED = ("survey", "store", "weaken", "receive", "bend")
#: Types of numbers as the source names them.
NAMES = {
    torch.float32: "float",
    torch.float64: "double",
    torch.float16: "Half",
    torch.bfloat16: "Brain",
}


class Variant(NamedTuple):
    """What a kernel is compiled for: the type of arithmetic, the type that volumes are stored in,
    how many of them share a ray's index work, the method's number, and whether rays are attenuated
    (of one volume each, in the type of arithmetic).
    """

    real: torch.dtype
    stored: torch.dtype
    together: int
    method: int
    attenuated: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its kernels."""
        return ATTENUATED if self.attenuated else KERNELS

    def line(self, suffix: str) -> str:
        """The line that makes the kernels of a variant, whose names end so."""
        method = next(name for name, number in METHODS.items() if number == self.method).upper()
        real = NAMES[self.real]
        if self.attenuated:
            return f"ATTENUATED({suffix}, {real}, {method})\n"
        return f"VARIANT({suffix}, {real}, {NAMES[self.stored]}, {self.together}, {method})\n"


@cache
def source() -> str:
    """The text without any variant."""
    return "".join(file.read_text() for file in sorted(FOLDER.glob("*.cu")))


def text_of(variants: Mapping[str, Variant]) -> str:
    """The text that makes the kernels of variants, by what their names end with."""
    return source() + "".join(variant.line(suffix) for suffix, variant in variants.items())
