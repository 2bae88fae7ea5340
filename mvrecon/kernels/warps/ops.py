"""The compiled warps as torch operators: opaque to `torch.compile`, each one's derivative made of
the others.

Second derivatives in the values are made of the same operators; those in the maps are the
reference's.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mvrecon.kernels.derivatives import bent, curved, linear, transposed
from mvrecon.kernels.precision import arithmetic, wide
from mvrecon.kernels.warps import reference

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::warp", mutates_args=(), device_types="cpu")
def _warp(volumes: Tensor, maps: Tensor, shape: Sequence[int]) -> Tensor:
    """Volumes [n s c d h w] through maps [s k 5 2 3] as [n s k c d h w]; see
    `warp_reference.warp`.
    """
    from mvrecon.kernels.warps import cpu

    return cpu.warp(wide(volumes), maps, shape)


@torch.library.custom_op("mvrecon::warp_back", mutates_args=(), device_types="cpu")
def _warp_back(values: Tensor, maps: Tensor, shape: Sequence[int]) -> Tensor:
    """The exact transpose of `warp`: values [n s k c d h w] to volumes [n s c d h w]."""
    from mvrecon.kernels.warps import cpu

    return cpu.warp_back(wide(values), maps, shape)


@torch.library.custom_op("mvrecon::warp_vjp", mutates_args=(), device_types="cpu")
def _warp_vjp(volumes: Tensor, values: Tensor, maps: Tensor) -> Tensor:
    """The derivative of <values, warp(volumes, maps)> by the maps [s k 5 2 3]."""
    from mvrecon.kernels.warps import cpu

    return cpu.warp_vjp(wide(volumes), wide(values), maps)


@_warp.register_kernel("cuda")
def _(volumes, maps, shape):
    from mvrecon.kernels.warps import cuda

    return cuda.warp(volumes, maps, shape)


@_warp_back.register_kernel("cuda")
def _(values, maps, shape):
    from mvrecon.kernels.warps import cuda

    return cuda.warp_back(values, maps, shape)


@_warp_vjp.register_kernel("cuda")
def _(volumes, values, maps):
    from mvrecon.kernels.warps import cuda

    return cuda.warp_vjp(volumes, values, maps)


@_warp.register_fake
def _(volumes, maps, shape):
    size = *volumes.shape[:2], maps.shape[1], volumes.shape[2], *shape
    return volumes.new_empty(size, dtype=arithmetic(volumes.dtype))


@_warp_back.register_fake
def _(values, maps, shape):
    size = *values.shape[:2], values.shape[3], *shape
    return values.new_empty(size, dtype=arithmetic(values.dtype))


@_warp_vjp.register_fake
def _(volumes, values, maps):
    return maps.new_empty(maps.shape)


def _keep(ctx, inputs, output):
    first, maps, _ = inputs
    ctx.save_for_backward(first if ctx.needs_input_grad[1] else None, maps)
    ctx.shape = first.shape


def _by_volumes(ctx, values):
    volumes, maps = ctx.saved_tensors
    by_volumes = warp_back(values, maps, list(ctx.shape[3:])) if ctx.needs_input_grad[0] else None
    return by_volumes, warp_vjp(volumes, values, maps) if ctx.needs_input_grad[1] else None, None


def _by_values(ctx, volumes):
    values, maps = ctx.saved_tensors
    by_values = warp(volumes, maps, list(ctx.shape[4:])) if ctx.needs_input_grad[0] else None
    return by_values, warp_vjp(volumes, values, maps) if ctx.needs_input_grad[1] else None, None


def _in_torch(volumes, maps, shape):
    return lambda volumes, maps: reference.warp(wide(volumes), maps, shape)


def _back_in_torch(values, maps, shape):
    of = values.shape
    back = transposed(_in_torch(None, maps, of[4:]), (*of[:2], of[3], *shape))
    return lambda values, maps: back(wide(values), maps)


def _vjp_in_torch(volumes, values, maps):
    vjp = bent(_in_torch(volumes, maps, values.shape[4:]))
    return lambda volumes, values, maps: vjp(volumes, wide(values), maps)


warp = linear(_warp, _in_torch, _keep, _by_volumes)
warp_back = linear(_warp_back, _back_in_torch, _keep, _by_values)
warp_vjp = curved(_warp_vjp, _vjp_in_torch)
