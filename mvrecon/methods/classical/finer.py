"""Reconstruction on a finer grid, for a volume on the coarse one."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool3d

from mvrecon.core.parts import METHODS
from mvrecon.core.quantities import PositiveInt
from mvrecon.geometry.grid import subdivided
from mvrecon.operators.operator import LinearOperator

#: The method where none is given.
SIRT = {"name": "sirt", "iterations": 25, "momentum": True}


class Fine(NamedTuple):
    """A reconstruction on a finer grid.

    Args:
        A: the operator of that grid.
        volume: its voxels, in the unit of the volume.
    """

    A: LinearOperator
    volume: Float[Tensor, "b c e i x"]


def finer(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    fine: PositiveInt = 2,
    method: Mapping[str, Any] | None = None,
    support: Bool[Tensor, "d h w"] | None = None,
) -> Float[Tensor, "b c d h w"]:
    """Reconstruct by another method on a finer grid, with rays as much closer, and average its
    voxels to those of the grid, in the unit of the volume.

    Under a grid of few voxels the truth itself misses its views by some percent: what a coarse grid
    and one thin ray a pixel cannot hold. Time and memory grow with fine^3.

    Args:
        A: the operator, with the capability "refine".
        views: in the operator's unit.
        fine: voxels along each axis in one of the grid's, and rays each way in one of a pixel's.
        method: name and options of the method; None: 25 iterations of SIRT with momentum.
        support: the voxels of the grid that may be anything but zero.

    Raises:
        ValueError: an operator that is not known on another grid, less than one voxel in a voxel,
            and what the method refuses.
        LookupError, TypeError: an unknown method, or an option that it does not have.
    """
    check_factor("fine", fine)
    return avg_pool3d(on_finer_grid(A, views, fine, method or SIRT, support).volume, fine)


def on_finer_grid(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    fine: int,
    method: Mapping[str, Any],
    support: Bool[Tensor, "d h w"] | None = None,
) -> Fine:
    """Reconstruct by a method on a grid `fine` times finer, in the unit of the volume; see
    `finer`.
    """
    mask = {} if support is None else {"support": subdivided(support, fine)}
    B = A.refined(fine)
    return Fine(B, METHODS.from_config(method, B, views, **mask))


def check_factor(name: str, factor: Any) -> None:
    """Check by how many times a grid is to be finer.

    Raises:
        ValueError: no whole number above 0.
    """
    if not isinstance(factor, int) or factor < 1:
        raise ValueError(f"Expected {name}, a whole number of at least 1, got {factor!r}")
