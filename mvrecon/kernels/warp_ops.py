"""The compiled warps as torch operators: opaque to `torch.compile`, each one's derivative made of the others.

Second derivatives in the values are exact. A second derivative in the maps raises: the reference has it.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::warp", mutates_args=(), device_types="cpu")
def warp(volumes: Tensor, maps: Tensor, shape: Sequence[int]) -> Tensor:
    """Volumes [n s c d h w] through maps [s k 5 2 3] as [n s k c d h w]; see `warp_reference.warp`."""
    from mvrecon.kernels import warp_cpu

    return warp_cpu.warp(volumes, maps, shape)


@torch.library.custom_op("mvrecon::warp_back", mutates_args=(), device_types="cpu")
def warp_back(values: Tensor, maps: Tensor, shape: Sequence[int]) -> Tensor:
    """The exact transpose of `warp`: values [n s k c d h w] to volumes [n s c d h w]."""
    from mvrecon.kernels import warp_cpu

    return warp_cpu.warp_back(values, maps, shape)


@torch.library.custom_op("mvrecon::warp_vjp", mutates_args=(), device_types="cpu")
def warp_vjp(volumes: Tensor, values: Tensor, maps: Tensor) -> Tensor:
    """The derivative of <values, warp(volumes, maps)> by the maps [s k 5 2 3]."""
    from mvrecon.kernels import warp_cpu

    return warp_cpu.warp_vjp(volumes, values, maps)


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


def batched(operator: Callable[..., Tensor]) -> Callable[..., tuple[Tensor, int]]:
    """How `torch.func.vmap` maps operator(values, geometry, ..): values join its batch, geometries are looped over."""

    def mapped(info, in_dims, values, geometry, *rest):
        where, of_geometry = in_dims[:2]
        if of_geometry is None:
            moved = values.movedim(where, 0)
            return operator(moved.flatten(0, 1), geometry, *rest).unflatten(0, moved.shape[:2]), 0
        each = values.unbind(where) if where is not None else [values] * info.batch_size
        pairs = zip(each, geometry.unbind(of_geometry), strict=True)
        return torch.stack([operator(*pair, *rest) for pair in pairs]), 0

    return mapped


warp.register_vmap(batched(warp))
warp_back.register_vmap(batched(warp_back))


@warp_vjp.register_vmap
def _(info, in_dims, *tensors):
    each = [
        t.unbind(dim) if dim is not None else [t] * info.batch_size for t, dim in zip(tensors, in_dims, strict=True)
    ]
    return torch.stack([warp_vjp(*three) for three in zip(*each, strict=True)]), 0
