"""OSEM by the operators of version 8c87dee2, where it is installed: distance-driven pixels with a
blur in layers, and the same on finer pixels, summed.

python experiments/28_montecarlo/earlier.py COUNTS RUN_FOLDER PART...

A part is a factor of the pixels, or "wide", which needs the views of `wide_pixels.py`.
"""

import sys
from pathlib import Path

from derenzo import BACKGROUND, GRID, HOLE, PIXELS, SEEDS, SUBSETS, run
from torch import Tensor
from wide import GRID as WIDE_GRID, rig as wide_rig, rows as wide_rows

import mvrecon as mv
from mvrecon.core.files.runs import read_rows, write_rows
from mvrecon.core.parts import PROJECTORS
from mvrecon.operators.operator import Derived, LinearOperator
from mvrecon.operators.selection import ViewSelection

VERSION = "8c87dee2"
RESPONSES = {
    "plain": {},
    "hole": {"blur": True},
    "hole, intrinsic 1.5 mm": {"blur": True, "intrinsic_mm": 1.5},
}


class Summed(Derived):
    """The sums of views over squares of pixels."""

    def __init__(self, A: LinearOperator, factor: int):
        self.A, self.factor = A, factor
        views, rows, columns = A.range_shape
        self.domain_shape = A.domain_shape
        self.range_shape = views, rows // factor, columns // factor
        self.capabilities = A.capabilities & {"subset"}

    def forward(self, x: Tensor) -> Tensor:
        parts = self.A(x).unflatten(4, (-1, self.factor)).unflatten(3, (-1, self.factor))
        return parts.sum(dim=(4, 6))

    def adjoint(self, y: Tensor) -> Tensor:
        wide = y.repeat_interleave(self.factor, dim=3).repeat_interleave(self.factor, dim=4)
        return self.A.T(wide)

    def subset(self, selection: LinearOperator) -> LinearOperator:
        views = getattr(selection, "views", range(self.range_shape[0]))
        return Summed(self.A.subset(ViewSelection(self.A.range_shape, views)), self.factor)


def osem(A: LinearOperator, y: Tensor, monitor) -> Tensor:
    common = {"background": BACKGROUND, "skip_zero_bins": False, "monitor": monitor}
    return mv.osem(A, y, 20, SUBSETS, **common)


def finer(counts: Path, folder: Path, factor: int) -> None:
    """GATE's counts by all responses on the detector's pixels, or by the hole's on finer ones."""
    for response in RESPONSES if factor == 1 else ("hole",):
        name = response if factor == 1 else f"{response}, {PIXELS * factor}^2 pixels summed"
        rig = mv.dcspect80(pixels=PIXELS * factor)
        options = {"grid": GRID, "cameras": rig, "diameter_mm": HOLE, **RESPONSES[response]}
        A = Summed(PROJECTORS.build("spect", **options), factor)
        names = {"version": VERSION, "method": "osem", "operator": name}
        run(folder / f"{VERSION}, {name}.pt", names, A, osem, counts, SEEDS + 1)


def balls(folder: Path) -> None:
    """Rows of `wide_pixels.py`, from its views, beside today's."""

    def build(intrinsic: float) -> LinearOperator:
        options = {"grid": WIDE_GRID, "cameras": wide_rig(), "diameter_mm": HOLE, "blur": True}
        return PROJECTORS.build("spect", intrinsic_mm=intrinsic, **options)

    today = [row for row in read_rows(folder / "wide.csv") if not row["version"]]
    write_rows(folder / "wide.csv", today + wide_rows(VERSION, build, folder))


if __name__ == "__main__":
    for part in sys.argv[3:]:
        if part == "wide":
            balls(Path(sys.argv[2]))
        else:
            finer(Path(sys.argv[1]), Path(sys.argv[2]), int(part))
