"""What an operator leaves out: supports that are part of it, and what it tells of the zeros that it
passes by.
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
    """What a call left out.

    Args:
        mode: "off", "box" or "brick".
        box: the voxels that were looked at.
        why: in words.
        fractions: "voxels", of the volume, in the box; "box" and "brick", of the work on a few
            rays, that either leaves, where they were counted.
    """

    mode: str
    box: Box
    why: str
    fractions: Mapping[str, float] = field(default_factory=dict)


def told(code: Tensor | None, asked: str, shape: Sequence[int]) -> Skipped:
    """What the code of an occupancy says; none: nothing was left out."""
    if code is None:
        return Skipped(
            "off",
            Box.whole(shape),
            "nothing was asked to be skipped, or the back end skips nothing",
        )
    held = Occupancy.decoded(code)
    whole = held.box == Box.whole(shape)
    mode = "brick" if held.bricks is not None else "off" if whole else "box"
    fractions = {"voxels": held.box.size / math.prod(shape)}
    fractions |= {
        name: each for name, each in zip(("box", "brick"), held.shares, strict=True) if each == each
    }
    if "brick" in fractions:
        why = (
            f"on a few rays the box leaves {fractions['box']:.1%} of the work, bricks "
            f"{fractions['brick']:.1%}"
        )
    elif asked in ("box", "brick"):
        why = f"{asked!r} was asked for"
    else:
        why = (
            "it is small work, or the volume is full"
            if whole
            else "bricks are full, or too small work to count them"
        )
    return Skipped(mode, held.box, why, fractions)


def check_support(support: Tensor | None, grid: Grid) -> Bool[Tensor, "d h w"] | None:
    """The door for supports.

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
    """Volumes with nothing outside a support, whatever stood there."""
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
