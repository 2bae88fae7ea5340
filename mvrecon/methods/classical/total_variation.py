"""Isotropic total variation and its proximal map.

Convention: forward differences, zero behind the last voxel of an axis; an axis of one voxel has
none, so that a volume of one slice has the total variation of an image.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.differences import (
    Shrinkage,
    Stride,
    differences_for,
    gradient,
    gradient_adjoint,
)
from mvrecon.operators.operator import LinearOperator

__all__ = [
    "Shrinkage",
    "dual_rate",
    "gradient",
    "gradient_adjoint",
    "total_variation",
    "tv_proximal",
    "voxel_steps",
]


def voxel_steps(A: LinearOperator) -> tuple[float, float, float]:
    """Voxel size of an operator's grid along (z, y, x), in mm; 1 mm for an operator without a
    grid.
    """
    grid = getattr(A, "grid", None)
    if grid is None:
        return 1.0, 1.0, 1.0
    x, y, z = grid.spacing
    return z, y, x


def total_variation(
    volume: Float[Tensor, "b c d h w"], steps: Sequence[float]
) -> Float[Tensor, "b c"]:
    """The total variation of a volume, sum |D x| over its voxels, in its unit per mm.

    Rudin, Osher and Fatemi, Physica D 60, 1992.

    Args:
        volume: x.
        steps: voxel size along (z, y, x), in mm.
    """
    return torch.linalg.vector_norm(gradient(volume, steps), dim=0).flatten(2).sum(dim=2)


def tv_proximal(
    volume: Float[Tensor, "b c d h w"],
    shrinkage: Shrinkage,
    dual: Float[Tensor, "3 b c d h w"],
    iterations: int,
    rate: float | None = None,
) -> tuple[Float[Tensor, "b c d h w"], Float[Tensor, "3 b c d h w"]]:
    """The proximal map of the total variation, argmin |x - z|^2 / (2 strength) + |D x|, in the unit
    of the volume, and the dual field that it ends with.

    Fast gradient projection on the dual, which may start where the last call ended (Beck and
    Teboulle, IEEE Trans. Image Process. 18, 2009, algorithm 5.1, here in a diagonal metric).

    Args:
        volume: z.
        shrinkage: strength, voxel size and sign.
        dual: the field to begin with, vectors of length 1 at most; it is written over.
        iterations: gradient steps on the dual.
        rate: of `dual_rate`, where it is known already.
    """
    rate = dual_rate(shrinkage) if rate is None else rate
    if rate == 0:
        return (volume.clamp_min(0) if shrinkage.nonnegative else volume), dual
    kernels, last, t, momentum = differences_for(volume), torch.zeros_like(dual), 1.0, 0.0
    for _ in range(iterations):
        stride = Stride(rate, momentum)
        dual, last = kernels.proximal_step(volume, dual, last, stride, shrinkage), dual
        t, before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        momentum = (before - 1) / t
    return kernels.primal(volume, dual, shrinkage), dual


def dual_rate(shrinkage: Shrinkage) -> float:
    """The longest stable step on the dual field, in mm by the unit of the volume; 0 where nothing
    is shrunk. A GPU is waited for once.
    """
    strongest = shrinkage.strength.max().item()
    steepest = strongest * sum(4 / step**2 for step in shrinkage.steps)
    return 1 / steepest if steepest else 0.0
