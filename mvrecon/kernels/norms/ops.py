"""Group normalisation and SiLU as a torch operator, opaque to `torch.compile`, with its derivative.

Derivatives of the derivative are those of torch's own operations.
"""

import torch
from torch import Tensor

from mvrecon.kernels.norms import reference
from mvrecon.kernels.operator import vjp_of
from mvrecon.kernels.precision import arithmetic


@torch.library.custom_op("mvrecon::normalised_silu", mutates_args=(), device_types="cpu")
def _normalised(
    x: Tensor, scale: Tensor, shift: Tensor, groups: int, eps: float
) -> tuple[Tensor, Tensor]:
    """The answer, and sums of features; see `reference.normalised`."""
    return reference.normalised(x, scale, shift, groups, eps)


@torch.library.custom_op("mvrecon::normalised_silu_back", mutates_args=(), device_types="cpu")
def _change(
    x: Tensor, answer: Tensor, scale: Tensor, shift: Tensor, sums: Tensor, groups: int, eps: float
) -> tuple[Tensor, Tensor]:
    """The change of features, and of an item's shift and scale; see `reference.change`."""
    return reference.change(x, answer, scale, shift, sums, groups, eps)


@_normalised.register_kernel("cuda")
def _(x, scale, shift, groups, eps):
    from mvrecon.kernels.norms import cuda

    return cuda.normalised(x, scale, shift, groups, eps)


@_change.register_kernel("cuda")
def _(x, answer, scale, shift, sums, groups, eps):
    from mvrecon.kernels.norms import cuda

    return cuda.change(x, answer, scale, shift, sums, groups, eps)


def _like(x: Tensor) -> tuple[Tensor, Tensor]:
    shape = len(x), *x.shape[2:], x.shape[1]
    rows = x.new_empty(shape, dtype=arithmetic(x.dtype))
    return rows.movedim(-1, 1), x.new_empty(len(x), 2, x.shape[1], dtype=torch.float64)


@_normalised.register_fake
def _(x, scale, shift, groups, eps):
    return _like(x)


@_change.register_fake
def _(x, answer, scale, shift, sums, groups, eps):
    return _like(x)


def _keep(ctx, inputs, output):
    *tensors, ctx.groups, ctx.eps = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors, output[1])


def _backwards(ctx, answer, _):
    if answer is None:
        return (None,) * 5
    x, scale, shift, sums = ctx.saved_tensors
    if torch.is_grad_enabled():  # a derivative of this one will be asked for

        def act(x, scale, shift):
            return reference.plain(x, scale, shift, ctx.groups, ctx.eps)

        return *vjp_of(act, x, scale, shift)(answer), None, None
    by_x, back = _change(x, answer, scale, shift, sums, ctx.groups, ctx.eps)
    by_shift, by_scale = back.sum(dim=0).to(scale.dtype)
    return by_x.to(x.dtype), by_scale, by_shift, None, None


_normalised.register_autograd(_backwards, setup_context=_keep)


def normalised_silu(x: Tensor, scale: Tensor, shift: Tensor, groups: int, eps: float) -> Tensor:
    """SiLU of group normalisation, with channels last in memory."""
    return _normalised(x, scale, shift, groups, eps)[0]
