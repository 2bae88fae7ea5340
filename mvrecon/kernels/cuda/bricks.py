"""Footprints of bricks on CUDA devices: which bricks are empty."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mvrecon.geometry.grid import bricks_along
from mvrecon.kernels.cuda.launch import HULL, Field, Variant, blocks, numbers_of, start

VARIANT = Variant(HULL, torch.float64)


class Prints(NamedTuple):
    """The views' footprints.

    Args:
        numbers: for each view, the map [3 4] from voxels about the grid's centre to (u w, v w, w),
            of parallel beams (u, v, w); margin in pixels (u, v) of a footprint around its brick's
            image; its share of the ray; further growth in pixels (u, v). float64.
        window: valid range of a ray.
        parallel: whether beams are parallel.
    """

    numbers: Float[Tensor, "m 17"]
    window: Sequence[float]
    parallel: bool


class Rule(NamedTuple):
    """Criterion of an empty brick.

    Args:
        edge: edge of a brick, in voxels.
        reach: voxels by which interpolation extends a value beyond the faces of its voxel.
        enough: number of views that must prove it empty.
        keep_unseen: whether bricks stay that no view sees whole or with foreground.
    """

    edge: int
    reach: float
    enough: int
    keep_unseen: bool


def kept_bricks(
    tables: Int[Tensor, "b m v1 u1"], prints: Prints, rule: Rule, shape: Sequence[int]
) -> Bool[Tensor, "b z y x"]:
    """The bricks of a grid of `shape` that may be non-empty, from the summed-area tables of
    foreground pixels; one launch.
    """
    counts = bricks_along(shape, rule.edge)
    kept = torch.empty(len(tables), *counts, dtype=torch.bool, device=tables.device)
    # the tensors must live until the launch
    sums, numbers = tables.to(torch.int32).contiguous(), numbers_of(prints.numbers)
    views, rows, columns = sums.shape[1:]
    field = Field().put(
        maps=numbers,
        origin=sums,
        window=(float(prints.window[0]), float(prints.window[1])),
        parallel=prints.parallel,
        source=(columns - 1, rows - 1, 1),
        kinds=views,
        shape=tuple(reversed(counts)),
        voxels=tuple(map(int, reversed(shape))),
        result=kept,
        **rule._asdict(),
    )
    start(VARIANT, "kept_bricks", field, tables, blocks(math.prod(counts)), len(tables))
    return kept
