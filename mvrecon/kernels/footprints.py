"""What footprints of bricks are told from, and when a brick is empty."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Prints(NamedTuple):
    """The views' footprints.

    Args:
        numbers: of each view the map [3 4] from voxels about the grid's centre to (u w, v w, w), of
            parallel beams (u, v, w); by how many pixels (u, v) a footprint is wider than its
            brick's image; the part of a ray that this takes; by how many pixels (u, v) more it is
            grown. float64.
        window: which part of a ray counts.
        parallel: whether the beams are.
    """

    numbers: Float[Tensor, "m 17"]
    window: Sequence[float]
    parallel: bool


class Rule(NamedTuple):
    """When a brick is empty.

    Args:
        edge: of a brick in voxels.
        reach: voxels by which interpolation carries a value beyond the faces of its voxel.
        enough: views that must agree.
        keep_unseen: whether bricks stay that no view sees whole and none shows.
    """

    edge: int
    reach: float
    enough: int
    keep_unseen: bool
