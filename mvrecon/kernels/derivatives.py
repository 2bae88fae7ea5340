"""The compiled operators' derivatives: for `torch.compile`, for `torch.func` to any depth, and by
the reference.

Kernels compute what is linear in its values, its transpose, and its first derivative in the
geometry. What is beyond is made from the reference, in its time and memory: `act_of(*inputs)` is
the operator, of its tensors, in plain torch.
"""

import logging
from collections.abc import Callable, Sequence
from functools import cache, partial
from inspect import signature
from typing import Any

import torch
from torch import Tensor
from torch._library.custom_ops import CustomOpDef
from torch.autograd import Function, forward_ad

from mvrecon.kernels.mapping import batched, looped

logger = logging.getLogger(__name__)
Act = Callable[..., Any]


def linear(
    operator: Any, act_of: Act, keep: Act, backwards: Act, lasting: int | None = None
) -> Callable[..., Tensor]:
    """A custom operator (values, geometry, ..) that is linear in its values, with its derivatives
    and maps.

    Args:
        operator: from `torch.library.custom_op`.
        act_of: see above; of (values, geometry).
        keep: (ctx, inputs, output), which stores what `backwards` needs.
        backwards: (ctx, change of the output), the derivatives by the inputs.
        lasting: how many of the inputs hold for other values too; None: all.
    """

    def forwards(inputs: list[Any], changes: tuple[Tensor | None, ...]) -> Tensor | int:
        change, bend = changes[:2]
        straight = 0 if change is None else call(change, *inputs[1:lasting])
        return (
            straight
            if bend is None
            else straight + pushed(act_of(*inputs), inputs[:2], (None, bend))
        )

    call = derivable(operator, keep, backwards, forwards, batched)
    return call


def curved(operator: Any, act_of: Act) -> Callable[..., Tensor]:
    """A custom operator, or function, (values, changes, geometry, ..): a derivative by the
    geometry, with its own.
    """

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.constants = inputs[3:]
        ctx.save_for_backward(*inputs[:3])

    def backwards(ctx: Any, change: Tensor) -> tuple[Tensor | None, ...]:
        tell()
        pull = pull_of(act_of(*ctx.saved_tensors, *ctx.constants), *ctx.saved_tensors)
        return *pull(change), *[None] * len(ctx.constants)

    def forwards(inputs: list[Any], changes: tuple[Tensor | None, ...]) -> Tensor:
        return pushed(act_of(*inputs), inputs[:3], changes[:3])

    return derivable(operator, keep, backwards, forwards, partial(looped, tensors=3))


def derivable(
    operator: Any, keep: Act, backwards: Act, forwards: Act, mapped: Act
) -> Callable[..., Tensor]:
    """An operator with its derivatives, `forwards` of (inputs, their changes or None), and one of
    the maps.
    """

    def call(*inputs: Any) -> Tensor:
        # torch.func refuses the derivatives of operators, and torch.compile takes functions apart
        return operator(*inputs) if torch.compiler.is_compiling() else Derivable.apply(*inputs)

    def setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        keep(ctx, inputs, output)
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(*(one for one in inputs if isinstance(one, Tensor)))
        ctx.others = [None if isinstance(one, Tensor) else (one,) for one in inputs]

    def back(ctx: Any, change: Tensor | None) -> Any:
        return (None,) * len(ctx.others) if change is None else backwards(ctx, change)

    def along(ctx: Any, *changes: Tensor | None) -> Tensor:
        # torch stops all derivatives forwards here, those of other levels among them
        with forward_ad._set_fwd_grad_enabled(True):
            tensors = (forward_ad.unpack_dual(tensor).primal for tensor in ctx.saved_tensors)
            return forwards(
                [next(tensors) if one is None else one[0] for one in ctx.others], changes
            )

    # torch asks for it in every call, and looking for it takes nine times as long
    operator.__signature__ = signature(operator)
    rule = mapped(call)
    acts = {
        "forward": operator,
        "setup_context": setup,
        "backward": back,
        "jvp": along,
        "vmap": rule,
    }
    Derivable: Any = type(
        "Derivable", (Function,), {name: staticmethod(act) for name, act in acts.items()}
    )
    if isinstance(operator, CustomOpDef):
        operator.register_autograd(backwards, setup_context=keep)
        operator.register_vmap(rule)
    return call


def transposed(act: Act, shape: Sequence[int]) -> Act:
    """The transpose of act(values, geometry), linear in values of a shape: of (changes,
    geometry).
    """

    def of(changes: Tensor, geometry: Tensor) -> Tensor:
        return pull_of(lambda values: act(values, geometry), changes.new_zeros(shape))(changes)[0]

    return of


def bent(act: Act) -> Act:
    """The derivative of <changes, act(values, geometry)> by the geometry: of (values, changes,
    geometry).
    """

    def of(values: Tensor, changes: Tensor, geometry: Tensor) -> Tensor:
        return pull_of(lambda geometry: act(values, geometry), geometry)(changes)[0]

    return of


def pushed(act: Act, inputs: Sequence[Tensor], changes: Sequence[Tensor | None]) -> Tensor:
    """The derivative of act(inputs) along changes of the inputs; None: fixed.

    By the derivative backwards, which is linear in what it pulls back, and its own: interpolation
    has none forwards.
    """
    tell()
    moving = [i for i, change in enumerate(changes) if change is not None]

    def moved(*some: Tensor) -> Tensor:
        every = dict(enumerate(inputs)) | dict(zip(moving, some, strict=True))
        return act(*every.values())

    value, pull = torch.func.vjp(moved, *(inputs[i] for i in moving))[:2]
    return pull_of(pull, torch.zeros_like(value))(tuple(changes[i] for i in moving))[0]


def pull_of(act: Act, *inputs: Tensor) -> Act:
    """The derivatives of <changes, act(inputs)> by the inputs, of the changes."""
    return torch.func.vjp(act, *inputs)[1]


@cache
def tell() -> None:
    """Says once that the reference computes what was asked for."""
    logger.warning(
        "The reference computes second, and forward, derivatives in the geometry: the kernels "
        "have none"
    )
