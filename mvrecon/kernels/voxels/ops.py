"""Voxel-driven back-projection and its transpose as torch operators: each is the other's
derivative.

Both are differentiable to any order in their values; derivatives in the cameras are the
reference's.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mvrecon.kernels.derivatives import bent, curved, linear, transposed
from mvrecon.kernels.voxels import reference

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::look", mutates_args=(), device_types="cpu")
def _look(
    views: Tensor, maps: Tensor, window: Sequence[float], weighted: bool, shape: Sequence[int]
) -> Tensor:
    """What the voxels [n d h w] see in views [n m v u]; see `voxel_reference.look`."""
    from mvrecon.kernels.voxels import cpu

    return cpu.look(views, maps, window, weighted, shape)


@torch.library.custom_op("mvrecon::show", mutates_args=(), device_types="cpu")
def _show(
    volumes: Tensor, maps: Tensor, window: Sequence[float], weighted: bool, detector: Sequence[int]
) -> Tensor:
    """The exact transpose of `look`: volumes [n d h w] to views [n m v u]."""
    from mvrecon.kernels.voxels import cpu

    return cpu.show(volumes, maps, window, weighted, detector)


@_look.register_kernel("cuda")
def _(views, maps, window, weighted, shape):
    from mvrecon.kernels.voxels import cuda

    return cuda.look(views, maps, window, weighted, shape)


@_show.register_kernel("cuda")
def _(volumes, maps, window, weighted, detector):
    from mvrecon.kernels.voxels import cuda

    return cuda.show(volumes, maps, window, weighted, detector)


@_look.register_fake
def _(views, maps, window, weighted, shape):
    return views.new_empty(len(views), *shape)


@_show.register_fake
def _(volumes, maps, window, weighted, detector):
    return volumes.new_empty(len(volumes), len(maps), *detector)


def _in_torch(views, maps, window, weighted, shape):
    return lambda views, maps: reference.look(views, maps, window, weighted, shape)


def _back_in_torch(volumes, maps, window, weighted, detector):
    return transposed(
        _in_torch(None, maps, window, weighted, volumes.shape[1:]),
        (len(volumes), len(maps), *detector),
    )


def _vjp_in_torch(views, volumes, maps, window, weighted):
    return bent(_in_torch(views, maps, window, weighted, volumes.shape[1:]))


def _look_vjp(views, volumes, maps, window, weighted):
    return _vjp_in_torch(views, volumes, maps, window, weighted)(views, volumes, maps)


def _keep(ctx, inputs, output):
    values, maps, ctx.window, ctx.weighted, _ = inputs
    ctx.save_for_backward(values if ctx.needs_input_grad[1] else None, maps)
    ctx.shape = values.shape


def _look_back(ctx, volumes):
    views, maps = ctx.saved_tensors
    needs_views, needs_maps = ctx.needs_input_grad[:2]
    rest = ctx.window, ctx.weighted
    by_views = show(volumes, maps, *rest, list(ctx.shape[2:])) if needs_views else None
    by_maps = look_vjp(views, volumes, maps, *rest) if needs_maps else None
    return by_views, by_maps, None, None, None


def _show_back(ctx, views):
    volumes, maps = ctx.saved_tensors
    needs_volumes, needs_maps = ctx.needs_input_grad[:2]
    rest = ctx.window, ctx.weighted
    by_volumes = look(views, maps, *rest, list(ctx.shape[1:])) if needs_volumes else None
    by_maps = look_vjp(views, volumes, maps, *rest) if needs_maps else None
    return by_volumes, by_maps, None, None, None


look = linear(_look, _in_torch, _keep, _look_back)
look_vjp = curved(_look_vjp, _vjp_in_torch)
show = linear(_show, _back_in_torch, _keep, _show_back)
