"""What a proximal map of the total variation may do, and how long its steps are."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Shrinkage(NamedTuple):
    """How far the proximal map of the total variation may shrink each voxel.

    Args:
        strength: weight times the step's metric, in the unit of the volume times mm; it broadcasts
            to volumes, and is zero where a voxel stays as it is.
        steps: voxel size along (z, y, x), in mm.
        nonnegative: clip at zero.
    """

    strength: Float[Tensor, "1 1 #d #h #w"]
    steps: Sequence[float]
    nonnegative: bool


class Stride(NamedTuple):
    """A step of the dual field.

    Args:
        rate: its length, in mm by the unit of the volume.
        momentum: how far it begins beyond the field, as a share of the way from the field before.
    """

    rate: float
    momentum: float = 0.0
