"""Isotropic total variation: the discrete gradient, its transpose, and the proximal map.

Convention: forward differences, zero behind the last voxel of an axis; an axis of one voxel has
none, so that a volume of one slice has the total variation of an image.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.projectors.operator import LinearOperator


def voxel_steps(A: LinearOperator) -> tuple[float, float, float]:
    """Voxel size of an operator's grid along (z, y, x), in mm; 1 mm for an operator without a
    grid.
    """
    grid = getattr(A, "grid", None)
    if grid is None:
        return 1.0, 1.0, 1.0
    x, y, z = grid.spacing
    return z, y, x


def gradient(
    volume: Float[Tensor, "b c d h w"],
    steps: Sequence[float],
    out: Float[Tensor, "3 b c d h w"] | None = None,
) -> Float[Tensor, "3 b c d h w"]:
    """The gradient D x of a volume by forward differences along (z, y, x), in its unit per mm.

    Args:
        volume: x.
        steps: voxel size along (z, y, x), in mm.
        out: what to write into.
    """
    out = volume.new_empty(3, *volume.shape) if out is None else out
    for axis, step in enumerate(steps):
        dim, n = axis + 2, volume.shape[axis + 2] - 1
        inner = out[axis].narrow(dim, 0, n)
        torch.sub(volume.narrow(dim, 1, n), volume.narrow(dim, 0, n), out=inner)
        if step != 1:
            inner.mul_(1 / step)
        out[axis].narrow(dim, n, 1).zero_()
    return out


def gradient_adjoint(
    field: Float[Tensor, "3 b c d h w"], steps: Sequence[float]
) -> Float[Tensor, "b c d h w"]:
    """The transpose D^T p of `gradient`, minus the divergence, in the field's unit per mm.

    Args:
        field: p; its values behind the last voxel of an axis do not count.
        steps: voxel size along (z, y, x), in mm.
    """
    total = torch.zeros_like(field[0])
    for axis, step in enumerate(steps):
        dim, n = axis + 2, field.shape[axis + 3] - 1
        inner = field[axis].narrow(dim, 0, n)
        total.narrow(dim, 0, n).sub_(inner, alpha=1 / step)
        total.narrow(dim, 1, n).add_(inner, alpha=1 / step)
    return total


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


def into_unit_balls(field: Float[Tensor, "3 b c d h w"]) -> Float[Tensor, "3 b c d h w"]:
    """The field, in place, with vectors longer than 1 shortened to 1: the proximal map of the dual
    of |D x|.
    """
    size = field[0].square()
    size.addcmul_(field[1], field[1]).addcmul_(field[2], field[2])
    return field.mul_(size.rsqrt_().clamp_max_(1))


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

    def primal(
        self, volume: Float[Tensor, "b c d h w"], dual: Float[Tensor, "3 b c d h w"]
    ) -> Float[Tensor, "b c d h w"]:
        """The volume of a dual field p: z - strength D^T p, clipped."""
        x = torch.addcmul(volume, self.strength, gradient_adjoint(dual, self.steps), value=-1)
        return x.clamp_min_(0) if self.nonnegative else x


def tv_proximal(
    volume: Float[Tensor, "b c d h w"],
    shrinkage: Shrinkage,
    dual: Float[Tensor, "3 b c d h w"],
    iterations: int,
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
    """
    strongest = shrinkage.strength.max().item()
    if strongest == 0:
        return (volume.clamp_min(0) if shrinkage.nonnegative else volume), dual
    rate = 1 / (strongest * sum(4 / step**2 for step in shrinkage.steps))
    ahead, new, t = dual.clone(), torch.empty_like(dual), 1.0
    for _ in range(iterations):
        gradient(shrinkage.primal(volume, ahead), shrinkage.steps, out=new)
        into_unit_balls(torch.add(ahead, new, alpha=rate, out=new))
        t, before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        torch.lerp(dual, new, 1 + (before - 1) / t, out=ahead)
        dual, new = new, dual
    return shrinkage.primal(volume, dual), dual
