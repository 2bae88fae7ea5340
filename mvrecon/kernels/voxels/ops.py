"""Voxel-driven back-projection and its transpose as torch operators: each is the other's
derivative.

Both are differentiable to any order in their values; a derivative in the cameras needs the
reference.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mvrecon.kernels.mapping import batched

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::look", mutates_args=(), device_types="cpu")
def look(
    views: Tensor, maps: Tensor, window: Sequence[float], weighted: bool, shape: Sequence[int]
) -> Tensor:
    """What the voxels [n d h w] see in views [n m v u]; see `voxel_reference.look`."""
    from mvrecon.kernels.voxels import cpu

    return cpu.look(views, maps, window, weighted, shape)


@torch.library.custom_op("mvrecon::show", mutates_args=(), device_types="cpu")
def show(
    volumes: Tensor, maps: Tensor, window: Sequence[float], weighted: bool, detector: Sequence[int]
) -> Tensor:
    """The exact transpose of `look`: volumes [n d h w] to views [n m v u]."""
    from mvrecon.kernels.voxels import cpu

    return cpu.show(volumes, maps, window, weighted, detector)


@look.register_fake
def _(views, maps, window, weighted, shape):
    return views.new_empty(len(views), *shape)


@show.register_fake
def _(volumes, maps, window, weighted, detector):
    return volumes.new_empty(len(volumes), len(maps), *detector)


def _keep(ctx, inputs, output):
    values, maps, ctx.window, ctx.weighted, _ = inputs
    if maps.requires_grad:
        raise NotImplementedError(
            "Derivatives of voxel-driven back-projection in the cameras need backend='reference'"
        )
    ctx.save_for_backward(maps)
    ctx.shape = values.shape


def _look_back(ctx, volumes):
    return (
        show(volumes, *ctx.saved_tensors, ctx.window, ctx.weighted, list(ctx.shape[2:])),
        None,
        None,
        None,
        None,
    )


def _show_back(ctx, views):
    return (
        look(views, *ctx.saved_tensors, ctx.window, ctx.weighted, list(ctx.shape[1:])),
        None,
        None,
        None,
        None,
    )


look.register_autograd(_look_back, setup_context=_keep)
show.register_autograd(_show_back, setup_context=_keep)
look.register_vmap(batched(look))
show.register_vmap(batched(show))
