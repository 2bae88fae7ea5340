"""Steps of total variation: compiled on the CPU, else in plain torch on any device.

Convention: forward differences, zero at the last voxel of an axis and along an axis of one voxel,
so that one slice has the total variation of an image.
"""

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.operator import choose_backend


class Shrinkage(NamedTuple):
    """Strength of the total variation's proximal map in each voxel.

    Args:
        strength: weight times the step's metric, in the unit of the volume times mm; broadcasts to
            volumes; zero leaves a voxel unchanged.
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
        momentum: extrapolation beyond the field, relative to its last change.
    """

    rate: float
    momentum: float = 0.0


def gradient(
    volume: Float[Tensor, "b c d h w"],
    steps: Sequence[float],
    out: Float[Tensor, "3 b c d h w"] | None = None,
) -> Float[Tensor, "3 b c d h w"]:
    """The gradient D x of a volume by forward differences along (z, y, x), in its unit per mm.

    Args:
        volume: x.
        steps: voxel size along (z, y, x), in mm.
        out: array for the result.
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
        field: p; its values at the last voxel of an axis are ignored.
        steps: voxel size along (z, y, x), in mm.
    """
    total = torch.zeros_like(field[0])
    for axis, step in enumerate(steps):
        dim, n = axis + 2, field.shape[axis + 3] - 1
        inner = field[axis].narrow(dim, 0, n)
        total.narrow(dim, 0, n).sub_(inner, alpha=1 / step)
        total.narrow(dim, 1, n).add_(inner, alpha=1 / step)
    return total


def primal(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    shrinkage: Shrinkage,
) -> Float[Tensor, "b c d h w"]:
    """The volume of a dual field, z - strength D^T p, clipped, in the unit of the volume.

    Args:
        volume: z.
        dual: p, without unit.
        shrinkage: strength, voxel size and sign.
    """
    back = gradient_adjoint(dual, shrinkage.steps)
    x = torch.addcmul(volume, shrinkage.strength, back, value=-1)
    return x.clamp_min_(0) if shrinkage.nonnegative else x


def dual_step(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    rate: float,
    steps: Sequence[float],
) -> Float[Tensor, "3 b c d h w"]:
    """Step the dual field in place along the gradient of a volume, p + rate D x, and shorten
    vectors longer than 1 to 1.

    Args:
        volume: x.
        dual: p, without unit.
        rate: length of the step, in mm by the unit of the volume.
        steps: voxel size along (z, y, x), in mm.
    """
    dual.add_(gradient(volume, steps), alpha=rate)
    size = dual[0].square()
    size.addcmul_(dual[1], dual[1]).addcmul_(dual[2], dual[2])
    return dual.mul_(size.rsqrt_().clamp_max_(1))


def proximal_step(
    volume: Float[Tensor, "b c d h w"],
    dual: Float[Tensor, "3 b c d h w"],
    last: Float[Tensor, "3 b c d h w"],
    stride: Stride,
    shrinkage: Shrinkage,
) -> Float[Tensor, "3 b c d h w"]:
    """One step of fast gradient projection, written over the previous dual field q: from a = p +
    momentum (p - q) along the gradient of the volume of a.

    Args:
        volume: z, the argument of the proximal map.
        dual: p, without unit.
        last: q, overwritten by the result.
        stride: rate and momentum of the step.
        shrinkage: strength, voxel size and sign.
    """
    ahead = last.lerp_(dual, 1 + stride.momentum)
    return dual_step(primal(volume, ahead, shrinkage), ahead, stride.rate, shrinkage.steps)


def differences_for(tensor: Tensor) -> ModuleType:
    """The module of `primal`, `dual_step` and `proximal_step` for a tensor's device and type."""
    if (
        tensor.dtype not in (torch.float32, torch.float64)
        or choose_backend(tensor, "auto") != "cpu"
    ):
        return sys.modules[__name__]
    # imported here, as numba is heavy
    from mvrecon.kernels.differences import cpu

    return cpu
