"""The compiled kernels as torch operators: opaque to `torch.compile`, each one's derivative made of the others.

Second derivatives in volume and views are exact. A second derivative in the geometry raises: the reference has it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mvrecon.kernels.mapping import batched, looped

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::project", mutates_args=(), device_types="cpu")
def project(volume: Tensor, lines: Tensor, window: Sequence[float], detector: Sequence[int], method: str) -> Tensor:
    """Line integrals of volumes [n d h w] as views [n m v u]; see `reference.project`. Half volumes give float32."""
    from mvrecon.kernels.rays import cpu

    return cpu.project(volume, lines, window, detector, method)


@torch.library.custom_op("mvrecon::backproject", mutates_args=(), device_types="cpu")
def backproject(views: Tensor, lines: Tensor, window: Sequence[float], shape: Sequence[int], method: str) -> Tensor:
    """The exact transpose of `project`: views [n m v u] to volumes [n d h w]."""
    from mvrecon.kernels.rays import cpu

    return cpu.backproject(views, lines, window, shape, method)


@torch.library.custom_op("mvrecon::lines_vjp", mutates_args=(), device_types="cpu")
def lines_vjp(volume: Tensor, views: Tensor, lines: Tensor, window: Sequence[float], method: str) -> Tensor:
    """The derivative of <views, project(volume, lines)> by the lines [m 4 3 3]."""
    from mvrecon.kernels.rays import cpu

    return cpu.lines_vjp(volume, views, lines, window, method)


@project.register_kernel("cuda")
def _(volume, lines, window, detector, method):
    from mvrecon.kernels.rays import cuda

    return cuda.project(volume, lines, window, detector, method)


@backproject.register_kernel("cuda")
def _(views, lines, window, shape, method):
    from mvrecon.kernels.rays import cuda

    return cuda.backproject(views, lines, window, shape, method)


@lines_vjp.register_kernel("cuda")
def _(volume, views, lines, window, method):
    from mvrecon.kernels.rays import cuda

    return cuda.lines_vjp(volume, views, lines, window, method)


@project.register_fake
def _(volume, lines, window, detector, method):
    wide = torch.float64 if volume.dtype == torch.float64 else torch.float32
    return volume.new_empty(volume.shape[0], lines.shape[0], *detector, dtype=wide)


@backproject.register_fake
def _(views, lines, window, shape, method):
    return views.new_empty(views.shape[0], *shape)


@lines_vjp.register_fake
def _(volume, views, lines, window, method):
    return lines.new_empty(lines.shape)


def _keep(ctx, inputs, output):
    first, lines, ctx.window, ctx.size, ctx.method = inputs
    ctx.save_for_backward(first if ctx.needs_input_grad[1] else None, lines)
    ctx.shape, ctx.dtype = first.shape, first.dtype


def _project_back(ctx, views):
    volume, lines = ctx.saved_tensors
    needs_volume, needs_lines = ctx.needs_input_grad[:2]
    by_volume = None
    if needs_volume:
        by_volume = backproject(views, lines, ctx.window, list(ctx.shape[1:]), ctx.method).to(ctx.dtype)
    by_lines = lines_vjp(volume, views, lines, ctx.window, ctx.method) if needs_lines else None
    return by_volume, by_lines, None, None, None


def _backproject_back(ctx, volume):
    views, lines = ctx.saved_tensors
    needs_views, needs_lines = ctx.needs_input_grad[:2]
    by_views = project(volume, lines, ctx.window, list(ctx.shape[2:]), ctx.method) if needs_views else None
    by_lines = lines_vjp(volume, views, lines, ctx.window, ctx.method) if needs_lines else None
    return by_views, by_lines, None, None, None


def _no_second_order(ctx, grad):
    raise NotImplementedError("Second derivatives in the geometry need backend='reference'")


project.register_autograd(_project_back, setup_context=_keep)
backproject.register_autograd(_backproject_back, setup_context=_keep)
lines_vjp.register_autograd(_no_second_order)
project.register_vmap(batched(project))
backproject.register_vmap(batched(backproject))
lines_vjp.register_vmap(looped(lines_vjp, 3))
