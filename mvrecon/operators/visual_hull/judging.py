"""Which bricks stay, and the counts in each, all views at once: one launch on a GPU."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from mvrecon.geometry.box import bricks_along
from mvrecon.kernels.cuda.bricks import Prints, Rule
from mvrecon.operators.visual_hull.footprints import (
    Bricks,
    Footprints,
    footprint_sums,
    footprints_of,
)

#: Footprints at a time, which bounds the memory (500 bytes a footprint).
AT_ONCE = 2**15


def judged(
    tables: Int[Tensor, "b m v1 u1"], prints: Prints, rule: Rule, shape: Sequence[int]
) -> Bool[Tensor, "b z y x"]:
    """The bricks of a grid of `shape` that stay, from the views' summed-area tables of what is no
    background.
    """
    numbers, window, parallel = prints
    return _judge(tables, numbers, list(window), parallel, [*rule], list(shape))


def proofs(
    tables: Int[Tensor, "b m v1 u1"], prints: Footprints
) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """How many views prove a brick empty, and whether none shows it."""
    none = footprint_sums(tables, prints) == 0
    return (none & prints.whole).sum(dim=1, dtype=torch.int32), none.all(dim=1)


def counted(
    tables: Int[Tensor, "b m v1 u1"],
    prints: Prints,
    edge: int,
    reach: float,
    shape: Sequence[int],
    part: range,
) -> Int[Tensor, "b m n"]:
    """The counts in the footprints of some bricks of a grid of `shape`, from the views' summed-area
    tables; `part` of the bricks in the order z, y, x.
    """
    detector = [n - 1 for n in tables.shape[2:]]
    flat = torch.arange(part.start, part.stop, device=tables.device)
    _, rows, columns = bricks_along(shape, edge)
    place = torch.stack([flat // columns // rows, flat // columns % rows, flat % columns], dim=1)
    bricks = Bricks.at(place, edge, shape)
    return footprint_sums(tables, footprints_of(prints, detector, shape, bricks, reach))


def counted_at_once(
    tables: Int[Tensor, "b m v1 u1"],
    prints: Prints,
    edge: int,
    reach: float,
    shape: Sequence[int],
    part: range,
) -> Int[Tensor, "b m n"]:
    """`counted`, by the device's kernel."""
    numbers, window, parallel = prints
    rule, ends = [edge, reach], [part.start, part.stop]
    return _count(tables, numbers, list(window), parallel, rule, [*shape, *ends])


@torch.library.custom_op("mvrecon::judge", mutates_args=(), device_types="cpu")
def _judge(
    tables: Tensor,
    numbers: Tensor,
    window: Sequence[float],
    parallel: bool,
    rule: Sequence[float],
    shape: Sequence[int],
) -> Tensor:
    """The bricks that stay; see `judged`."""
    prints, (edge, reach, enough, keep_unseen) = Prints(numbers, window, parallel), rule
    detector = [n - 1 for n in tables.shape[2:]]
    counts = bricks_along(shape, int(edge))
    places = torch.ones(counts, dtype=torch.bool).nonzero()
    parts = []
    for part in places.split(max(1, AT_ONCE // max(1, tables.shape[0] * tables.shape[1]))):
        bricks = Bricks.at(part, int(edge), shape)
        empty, dark = proofs(tables, footprints_of(prints, detector, shape, bricks, reach))
        parts.append((empty < enough) & (~dark | bool(keep_unseen)))
    return torch.cat(parts, dim=1).unflatten(1, counts)


@_judge.register_kernel("cuda")
def _(tables, numbers, window, parallel, rule, shape):
    from mvrecon.kernels.cuda.bricks import judge

    edge, reach, enough, keep_unseen = rule
    kept = Rule(int(edge), reach, int(enough), bool(keep_unseen))
    return judge(tables, Prints(numbers, window, parallel), kept, shape)


@_judge.register_fake
def _(tables, numbers, window, parallel, rule, shape):
    counts = bricks_along(shape, int(rule[0]))
    return tables.new_empty([len(tables), *counts], dtype=torch.bool)


@torch.library.custom_op("mvrecon::count", mutates_args=(), device_types="cpu")
def _count(
    tables: Tensor,
    numbers: Tensor,
    window: Sequence[float],
    parallel: bool,
    rule: Sequence[float],
    sizes: Sequence[int],
) -> Tensor:
    """The counts in footprints; see `counted`. `sizes` are the grid's and the ends of the part."""
    (edge, reach), (*shape, first, last) = rule, sizes
    prints = Prints(numbers, window, parallel)
    return counted(tables, prints, int(edge), reach, shape, range(first, last))


@_count.register_kernel("cuda")
def _(tables, numbers, window, parallel, rule, sizes):
    from mvrecon.kernels.cuda.bricks import count

    (edge, reach), (*shape, first, last) = rule, sizes
    prints = Prints(numbers, window, parallel)
    return count(tables, prints, int(edge), reach, shape, range(first, last))


@_count.register_fake
def _(tables, numbers, window, parallel, rule, sizes):
    return tables.new_empty([*tables.shape[:2], sizes[-1] - sizes[-2]], dtype=torch.int64)
