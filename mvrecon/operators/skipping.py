"""Skipping of zeros: the support that is part of an operator, and the report of what a call
skipped.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.box import Box
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.occupancy import Occupancy

SKIPS = ("auto", "off", "box", "brick", "verify")


@dataclass(frozen=True)
class Skipped:
    """Voxels that one call of an operator skipped.

    Args:
        mode: "off", "box" or "brick".
        box: voxels outside it are zero, or outside the support, and were not read.
        why: the reason for the mode, as a sentence.
        fractions: "voxels": share of the volume in the box; "box" and "brick": share of the work
            that is left with each, counted on a few rays, absent if not counted.
    """

    mode: str
    box: Box
    why: str
    fractions: Mapping[str, float] = field(default_factory=dict)


def skip_report(code: Tensor | None, skip: str, shape: Sequence[int]) -> Skipped:
    """Report of a call by the code of its occupancy; None: nothing was skipped."""
    if code is None:
        return Skipped(
            "off",
            Box.whole(shape),
            "nothing was asked to be skipped, or the back end skips nothing",
        )
    occupancy = Occupancy.decoded(code)
    whole = occupancy.box == Box.whole(shape)
    mode = "brick" if occupancy.bricks is not None else "off" if whole else "box"
    fractions = {"voxels": occupancy.box.size / math.prod(shape)}
    fractions |= {
        name: share
        for name, share in zip(("box", "brick"), occupancy.shares, strict=True)
        if share == share
    }
    if "brick" in fractions:
        why = (
            f"on a few rays the box leaves {fractions['box']:.1%} of the work, bricks "
            f"{fractions['brick']:.1%}"
        )
        if mode != "brick" and fractions["brick"] < fractions["box"]:
            why += ", too little to gain by them"
    elif skip in ("box", "brick"):
        why = f"{skip!r} was asked for"
    else:
        why = (
            "it is small work, or the volume is full"
            if whole
            else "bricks are full, or too small work to count them"
        )
    return Skipped(mode, occupancy.box, why, fractions)


def check_support(support: Tensor | None, grid: Grid) -> Bool[Tensor, "d h w"] | None:
    """Check the shape and dtype of a support.

    Raises:
        ValueError: not a mask of the grid's shape.
    """
    if support is not None and (support.dtype != torch.bool or support.shape != grid.shape):
        raise ValueError(
            f"A support is a mask of bool with the grid's shape {grid.shape}, "
            f"got {str(support.dtype).removeprefix('torch.')} of {tuple(support.shape)}"
        )
    return support


def within(
    volumes: Float[Tensor, "n d h w"], support: Bool[Tensor, "d h w"]
) -> Float[Tensor, "n d h w"]:
    """Volumes set to zero outside a support, NaN and infinity included."""
    return torch.where(support, volumes, 0)


def verify(views: Tensor, dense: Tensor, skipped: Skipped) -> None:
    """Raise RuntimeError unless views are those without skipping, to the last bit."""
    same = (views == dense) | (views.isnan() & dense.isnan())
    if not same.all():
        raise RuntimeError(
            f"skip='verify': {int((~same).sum())} of {same.numel()} pixels differ from those "
            f"without skipping "
            f"({skipped.mode}, {skipped.why})"
        )
