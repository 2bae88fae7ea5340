"""The visual hull on CUDA devices: every brick is judged by itself."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from mvrecon.geometry.box import bricks_along
from mvrecon.kernels.cuda.field import Field
from mvrecon.kernels.cuda.launching import blocks, numbers_of, start
from mvrecon.kernels.cuda.sources import Part
from mvrecon.kernels.footprints import Prints, Rule


def judge(
    tables: Int[Tensor, "b m v1 u1"], prints: Prints, rule: Rule, shape: Sequence[int]
) -> Bool[Tensor, "b z y x"]:
    """The bricks of a grid of `shape` that may be other than empty, from the summed-area tables of
    the pixels that are no background; one launch.
    """
    items, views, rows, columns = tables.shape
    counts = bricks_along(shape, rule.edge)
    kept = torch.empty(items, *counts, dtype=torch.bool, device=tables.device)
    sums, numbers = tables.to(torch.int32).contiguous(), numbers_of(prints.numbers)
    field = Field().put(
        maps=numbers,
        origin=sums,
        result=kept,
        window=(float(prints.window[0]), float(prints.window[1])),
        parallel=prints.parallel,
        source=(columns - 1, rows - 1, 1),
        kinds=views,
        shape=tuple(reversed(counts)),
        voxels=tuple(map(int, reversed(shape))),
        **rule._asdict(),
    )
    part = Part("hull", torch.float64)
    start(part, "judge", field, tables, blocks(math.prod(counts)), items)
    return kept
