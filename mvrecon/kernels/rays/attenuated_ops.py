"""Attenuated projections as torch operators: opaque to `torch.compile`, with derivatives in
emission and attenuation.

CPU and CUDA devices have kernels for a single attenuation and rays without a gradient; all else is
the reference's.
"""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from mvrecon.kernels.derivatives import bent, curved, linear, transposed
from mvrecon.kernels.rays import attenuated_reference as reference
from mvrecon.kernels.rays.occupancy import DENSE

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::project_attenuated", mutates_args=(), device_types="cpu")
def _project(
    volume: Tensor,
    mu: Tensor,
    lines: Tensor,
    layers: Tensor,
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
) -> Tensor:
    """Attenuated integrals of volumes [n d h w] as views [n m v u k]."""
    from mvrecon.kernels.rays.cpu import attenuated as cpu

    return cpu.project(volume, mu, lines, layers, window, detector, method)


@torch.library.custom_op("mvrecon::backproject_attenuated", mutates_args=(), device_types="cpu")
def _backproject(
    views: Tensor, mu: Tensor, lines: Tensor, layers: Tensor, window: Sequence[float], method: str
) -> Tensor:
    """The exact transpose of `project` in the emission: views [n m v u k] to volumes [n d h w]."""
    from mvrecon.kernels.rays.cpu import attenuated as cpu

    return cpu.backproject(views, mu, lines, layers, window, method)


@torch.library.custom_op("mvrecon::attenuation_vjp", mutates_args=(), device_types="cpu")
def _mu_vjp(
    volume: Tensor,
    views: Tensor,
    mu: Tensor,
    lines: Tensor,
    layers: Tensor,
    window: Sequence[float],
    method: str,
) -> Tensor:
    """The derivative of <views, project(volume, mu)> by the attenuation mu [d h w]."""
    from mvrecon.kernels.rays.cpu import attenuated as cpu

    return cpu.mu_vjp(volume, views, mu, lines, layers, window, method).to(mu.dtype)


@_project.register_kernel("cuda")
def _(volume, mu, lines, layers, window, detector, method):
    from mvrecon.kernels.rays.cuda import attenuated as cuda

    return cuda.project(volume, mu, lines, layers, window, detector, method.removesuffix(DENSE))


@_backproject.register_kernel("cuda")
def _(views, mu, lines, layers, window, method):
    from mvrecon.kernels.rays.cuda import attenuated as cuda

    return cuda.backproject(views, mu, lines, layers, window, method.removesuffix(DENSE))


@_mu_vjp.register_kernel("cuda")
def _(volume, views, mu, lines, layers, window, method):
    from mvrecon.kernels.rays.cuda import attenuated as cuda

    method = method.removesuffix(DENSE)
    return cuda.mu_vjp(volume, views, mu, lines, layers, window, method).to(mu.dtype)


@_project.register_fake
def _(volume, mu, lines, layers, window, detector, method):
    wide = torch.float64 if volume.dtype == torch.float64 else torch.float32
    return volume.new_empty(volume.shape[0], lines.shape[0], *detector, layers.shape[1], dtype=wide)


@_backproject.register_fake
def _(views, mu, lines, layers, window, method):
    return views.new_empty(views.shape[0], *mu.shape)


@_mu_vjp.register_fake
def _(volume, views, mu, lines, layers, window, method):
    return mu.new_empty(mu.shape)


def _keep(ctx, inputs, output):
    *rest, ctx.method = inputs
    _remember(ctx, *rest)


def _keep_project(ctx, inputs, output):
    *rest, _, ctx.method = inputs
    _remember(ctx, *rest)


def _remember(ctx, first, mu, lines, layers, window):
    ctx.window, ctx.dtype, ctx.detector = window, first.dtype, list(first.shape[2:4])
    ctx.save_for_backward(first if ctx.needs_input_grad[1] else None, mu, lines, layers)


def _project_back(ctx, views):
    volume, mu, lines, layers = ctx.saved_tensors
    by_volume = by_mu = None
    if ctx.needs_input_grad[0]:
        by_volume = backproject(views, mu, lines, layers, ctx.window, ctx.method).to(ctx.dtype)
    if ctx.needs_input_grad[1]:
        by_mu = mu_vjp(volume, views, mu, lines, layers, ctx.window, ctx.method)
    return by_volume, by_mu, *[None] * 5


def _backproject_back(ctx, volume):
    views, mu, lines, layers = ctx.saved_tensors
    by_views = by_mu = None
    if ctx.needs_input_grad[0]:
        by_views = project(volume, mu, lines, layers, ctx.window, ctx.detector, ctx.method)
    if ctx.needs_input_grad[1]:
        by_mu = mu_vjp(volume, views, mu, lines, layers, ctx.window, ctx.method)
    return by_views, by_mu, None, None, None, None


def _in_torch(volume, mu, lines, layers, window, detector, method):
    rays = {
        "lines": lines,
        "layers": layers,
        "window": window,
        "detector": detector,
        "method": method.removesuffix(DENSE),
    }
    return partial(_act, **rays)


def _act(volume, mu, **rays):
    return reference.project(
        volume.to(torch.promote_types(volume.dtype, torch.float32)), mu, **rays
    )


def _back_in_torch(views, mu, lines, layers, window, method):
    act = _in_torch(None, mu, lines, layers, window, views.shape[2:4], method)
    return transposed(act, (len(views), *mu.shape))


def _vjp_in_torch(volume, views, mu, lines, layers, window, method):
    return bent(_in_torch(volume, mu, lines, layers, window, views.shape[2:4], method))


_projected = linear(_project, _in_torch, _keep_project, _project_back)
backproject = linear(_backproject, _back_in_torch, _keep, _backproject_back)
mu_vjp = curved(_mu_vjp, _vjp_in_torch)


def project(
    volume: Tensor,
    mu: Tensor,
    lines: Tensor,
    layers: Tensor,
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
) -> Tensor:
    """Attenuated line integrals; see `attenuated_reference.project`. Emission that is zero is left
    out, which changes no bit, but for a method with the suffix `DENSE`.
    """
    return _projected(volume, mu, lines, layers, window, detector, method)
