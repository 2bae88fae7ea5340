"""The compiled warps as torch operators: opaque to `torch.compile`, each one's derivative made of
the others.

Second derivatives in the values are exact. A second derivative in the maps raises: the reference
has it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mvrecon.kernels.mapping import batched, looped

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::warp", mutates_args=(), device_types="cpu")
def warp(volumes: Tensor, maps: Tensor, shape: Sequence[int]) -> Tensor:
    """Volumes [n s c d h w] through maps [s k 5 2 3] as [n s k c d h w]; see
    `warp_reference.warp`.
    """
    from mvrecon.kernels.warps import cpu

    return cpu.warp(volumes, maps, shape)


@torch.library.custom_op("mvrecon::warp_back", mutates_args=(), device_types="cpu")
def warp_back(values: Tensor, maps: Tensor, shape: Sequence[int]) -> Tensor:
    """The exact transpose of `warp`: values [n s k c d h w] to volumes [n s c d h w]."""
    from mvrecon.kernels.warps import cpu

    return cpu.warp_back(values, maps, shape)


@torch.library.custom_op("mvrecon::warp_vjp", mutates_args=(), device_types="cpu")
def warp_vjp(volumes: Tensor, values: Tensor, maps: Tensor) -> Tensor:
    """The derivative of <values, warp(volumes, maps)> by the maps [s k 5 2 3]."""
    from mvrecon.kernels.warps import cpu

    return cpu.warp_vjp(volumes, values, maps)


@warp.register_fake
def _(volumes, maps, shape):
    return volumes.new_empty(*volumes.shape[:2], maps.shape[1], volumes.shape[2], *shape)


@warp_back.register_fake
def _(values, maps, shape):
    return values.new_empty(*values.shape[:2], values.shape[3], *shape)


@warp_vjp.register_fake
def _(volumes, values, maps):
    return maps.new_empty(maps.shape)


def _keep(ctx, inputs, output):
    first, maps, _ = inputs
    ctx.save_for_backward(first if ctx.needs_input_grad[1] else None, maps)
    ctx.shape = first.shape


def _warp_back(ctx, values):
    volumes, maps = ctx.saved_tensors
    by_volumes = warp_back(values, maps, list(ctx.shape[3:])) if ctx.needs_input_grad[0] else None
    return by_volumes, warp_vjp(volumes, values, maps) if ctx.needs_input_grad[1] else None, None


def _warp_back_back(ctx, volumes):
    values, maps = ctx.saved_tensors
    by_values = warp(volumes, maps, list(ctx.shape[4:])) if ctx.needs_input_grad[0] else None
    return by_values, warp_vjp(volumes, values, maps) if ctx.needs_input_grad[1] else None, None


def _no_second_order(ctx, grad):
    raise NotImplementedError("Second derivatives in a warp's maps need backend='reference'")


warp.register_autograd(_warp_back, setup_context=_keep)
warp_back.register_autograd(_warp_back_back, setup_context=_keep)
warp_vjp.register_autograd(_no_second_order)


warp.register_vmap(batched(warp))
warp_back.register_vmap(batched(warp_back))
warp_vjp.register_vmap(looped(warp_vjp, 3))
