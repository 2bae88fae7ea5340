"""Operators of torch, each declared once: a schema, compiled back ends, the reference in plain
torch, and shapes. Derivatives, `torch.func` rules and the self-test follow.

An operator is linear in its values. It has a transpose and the derivative of <cotangent,
forward(values, geometry)> by the geometry:

    forward(values, geometry, ..)
    transpose(cotangent, geometry, ..)
    vjp(values, cotangent, geometry, ..)

Each is opaque to `torch.compile`. Derivatives are composed of the three, so those in values and
cotangents are exact to any order; second, and forward, derivatives in the geometry use the
reference, in its time and memory.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from inspect import signature
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.autograd import Function, forward_ad

from mvrecon.kernels import self_test

logger = logging.getLogger(__name__)

Rule = Callable[..., Any]
BACKENDS = ("auto", "cpu", "cuda", "reference")
COMPILED = find_spec("numba") is not None


def accumulation_dtype(dtype: torch.dtype) -> torch.dtype:
    """The type in which numbers are accumulated: float64 for float64, else float32."""
    return torch.float64 if dtype == torch.float64 else torch.float32


def to_accumulation_dtype(tensor: Tensor) -> Tensor:
    """Cast a tensor to the type of accumulation."""
    return tensor.to(accumulation_dtype(tensor.dtype))


def define(schema: str, modules: Mapping[str, str], shape: Rule, prefix: str = "") -> OpOverload:
    """Define an operator `torch.ops.mvrecon.<prefix><name>`.

    Args:
        schema: name and arguments as in PyTorch's `native_functions.yaml`, "name(Tensor x, ..) ->
            Tensor".
        modules: for each device type, the module with the function of this name and arguments;
            imported at the first call, as numba is heavy.
        shape: maps the arguments to an empty tensor like the result.
        prefix: what the operator's name begins with, but not the functions'.
    """
    name = schema.partition("(")[0]
    whole = f"mvrecon::{prefix}{name}"

    def compiled(module: str) -> Rule:
        return lambda *inputs: getattr(import_module(module), name)(*inputs)

    # not `custom_op`, whose call is eight Python functions deeper
    torch.library.define(whole, schema.removeprefix(name), tags=(torch.Tag.pt2_compliant_tag,))
    for device, module in modules.items():
        torch.library.impl(whole, device, compiled(module))
    torch.library.register_fake(whole, shape)
    return getattr(torch.ops.mvrecon, prefix + name).default


class LinearKernel:
    """An operator that is linear in its values, with its transpose and vjp: their declaration and
    implementation.

    Args:
        forward, transpose, vjp: schemas, see `define`. A given size of the result is the one
            argument of type SymInt[]; the vjp has none, and without a schema is the reference's.
        modules, prefix: see `define`.
        reference: `forward` in plain torch, for accumulation types.
        shapes: functions of the arguments of forward and of transpose that return the shape of the
            result.
        sizes: slices of the shapes of values and of cotangents that hold the other's size.
    """

    def __init__(
        self,
        forward: str,
        transpose: str,
        vjp: str | None,
        modules: Mapping[str, str],
        reference: Rule,
        shapes: tuple[Rule, Rule],
        sizes: tuple[slice, slice],
        prefix: str = "",
    ):
        self.modules, self.reference, self.shapes, self.sizes = modules, reference, shapes, sizes
        schemas = [forward, transpose] + ([vjp] if vjp else [])
        self.names = [schema.partition("(")[0] for schema in schemas]
        arguments = [schema.split(", ") for schema in schemas[:2]]
        places = [[i for i, one in enumerate(of) if one.startswith("SymInt[]")] for of in arguments]
        #: Position of the size behind values and geometry; whether the transpose has one; number of
        #: remaining arguments that other values share.
        self.place, self.sized = places[0][0] - 2, bool(places[1])
        self.shared = len(arguments[1]) - 2 + (not self.sized)
        operators = [
            define(schema, modules, self._like(shape), prefix)
            for schema, shape in zip(schemas, (*shapes, None), strict=False)
        ]
        self.forward = differentiable(operators[0], self.apply, self._backward, self.shared)
        self.transpose = differentiable(
            operators[1], self.apply_transpose, self._transpose_backward, self.shared
        )
        by_reference = lambda *inputs: self.apply_vjp(*inputs)  # noqa: E731
        self.vjp = differentiable(operators[2] if vjp else by_reference, self.apply_vjp)

    @staticmethod
    def _like(shape: Rule | None) -> Rule:
        if shape is None:
            return lambda values, cotangent, geometry, *rest: torch.empty_like(geometry)
        return lambda values, *rest: values.new_empty(
            shape(values, *rest), dtype=accumulation_dtype(values.dtype)
        )

    # arguments behind values and geometry: of the transpose by those of forward, and so on

    def _of_transpose(self, rest: Sequence[Any], shape: Sequence[int]) -> list[Any]:
        size = [list(shape[self.sizes[0]])] if self.sized else []
        return [*rest[: self.place], *size, *rest[self.place + 1 : self.shared]]

    def _of_forward(self, rest: Sequence[Any], shape: Sequence[int], sized: bool) -> list[Any]:
        size = list(shape[self.sizes[1]])
        return [*rest[: self.place], size, *rest[self.place + sized :]]

    def _of_vjp(self, rest: Sequence[Any], sized: bool) -> list[Any]:
        return [*rest[: self.place], *rest[self.place + sized :]]

    # the same three in plain torch

    def apply(self, values: Tensor, geometry: Tensor, *rest: Any) -> Tensor:
        """`forward` by the reference."""
        return self.reference(to_accumulation_dtype(values), geometry, *rest)

    def apply_transpose(self, cotangent: Tensor, geometry: Tensor, *rest: Any) -> Tensor:
        """`transpose` by the reference."""
        y, whole = (
            to_accumulation_dtype(cotangent),
            self._of_forward(rest, cotangent.shape, self.sized),
        )
        zeros = y.new_zeros(self.shapes[1](cotangent, geometry, *rest))
        return vjp_of(lambda values: self.apply(values, geometry, *whole), zeros)(y)[0]

    def apply_vjp(self, values: Tensor, cotangent: Tensor, geometry: Tensor, *rest: Any) -> Tensor:
        """`vjp` by the reference."""
        whole = self._of_forward(rest, cotangent.shape, False)
        return vjp_of(lambda geometry: self.apply(values, geometry, *whole), geometry)(
            to_accumulation_dtype(cotangent)
        )[0]

    # derivatives

    def _backward(self, ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        values, geometry, *rest = saved_inputs(ctx)
        by_values = by_geometry = None
        if ctx.needs_input_grad[0]:
            of = self._of_transpose(rest, ctx.shape)
            by_values = self.transpose(cotangent, geometry, *of).to(ctx.dtype)
        if ctx.needs_input_grad[1]:
            by_geometry = self.vjp(values, cotangent, geometry, *self._of_vjp(rest, True))
        return by_values, by_geometry, *[None] * len(rest)

    def _transpose_backward(self, ctx: Any, values: Tensor) -> tuple[Tensor | None, ...]:
        cotangent, geometry, *rest = saved_inputs(ctx)
        by_cotangent = by_geometry = None
        if ctx.needs_input_grad[0]:
            of = self._of_forward(rest, ctx.shape, self.sized)
            by_cotangent = self.forward(values, geometry, *of).to(ctx.dtype)
        if ctx.needs_input_grad[1]:
            by_geometry = self.vjp(values, cotangent, geometry, *self._of_vjp(rest, self.sized))
        return by_cotangent, by_geometry, *[None] * len(rest)

    def self_test(self, values: Tensor, geometry: Tensor, *rest: Any) -> self_test.Errors:
        """Names of the CUDA functions, with their greatest differences to the reference relative to
        its greatest value; on the device of the values.
        """
        x, moving = (
            one.detach().clone().requires_grad_()
            for one in (to_accumulation_dtype(values), geometry)
        )
        with torch.enable_grad():
            expected = self.apply(x, moving, *rest)
            y = torch.rand(expected.shape, generator=torch.Generator().manual_seed(1)).to(values)
            derivatives = torch.autograd.grad(
                (expected * to_accumulation_dtype(y)).sum(), (x, moving)
            )
        inputs = (
            (values, geometry, *rest),
            (y, geometry, *self._of_transpose(rest, values.shape)),
            (values, y, geometry, *self._of_vjp(rest, True)),
        )
        cuda = import_module(self.modules["cuda"])
        for name, of, result in zip(self.names, inputs, (expected, *derivatives), strict=False):
            yield name, self_test.error_of(getattr(cuda, name)(*of), result)


def differentiable(
    operator: Any, apply: Rule, backward: Rule | None = None, shared: int | None = None
) -> Callable[..., Tensor]:
    """Add derivatives for torch, `torch.func` and `torch.compile` to an operator or function.

    Args:
        operator: function of (values, geometry, ..) if linear, else of (values, cotangent,
            geometry, ..).
        apply: the same in plain torch, the source of derivatives that are not given.
        backward: function of (ctx, cotangent), see `saved_inputs`; implies that the operator is
            linear in the first input.
        shared: number of arguments behind the geometry that other values share.
    """
    linear, count = backward is not None, 3 if backward is None else 2

    def call(*inputs: Any) -> Tensor:
        # torch.func rejects derivatives of operators, and torch.compile inlines functions
        return operator(*inputs) if torch.compiler.is_compiling() else Differentiable.apply(*inputs)

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.shape, ctx.dtype = inputs[0].shape, inputs[0].dtype
        ctx.others = [None if isinstance(one, Tensor) else (one,) for one in inputs]
        tensors: list[Any] = [one for one in inputs if isinstance(one, Tensor)]
        if linear and not ctx.needs_input_grad[1]:
            tensors[0] = None
        ctx.save_for_backward(*tensors)

    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        keep(ctx, inputs, output)
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(*(one for one in inputs if isinstance(one, Tensor)))

    def back(ctx: Any, cotangent: Tensor | None) -> Any:
        return (None,) * len(ctx.others) if cotangent is None else rule(ctx, cotangent)

    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor | int:
        # torch disables all forward derivatives here, also those of other levels
        with forward_ad._set_fwd_grad_enabled(True):
            primals = (forward_ad.unpack_dual(tensor).primal for tensor in ctx.saved_tensors)
            inputs = [next(primals) if one is None else one[0] for one in ctx.others]
            of, rest, moving = inputs[:count], inputs[count:], tangents[:count]
            if not linear:
                return jvp_of(lambda *of: apply(*of, *rest), of, moving)
            straight = 0 if moving[0] is None else call(moving[0], of[1], *rest[:shared])
            if moving[1] is None:
                return straight
            return straight + jvp_of(lambda *of: apply(*of, *rest), of, (None, moving[1]))

    def forward(*inputs: Any) -> Tensor:
        # below autograd an operator needs a derivative of its own, for compiled graphs
        with torch._C._AutoDispatchBelowAutograd():
            return operator(*inputs)

    rule = backward or partial(_pull_back, apply, count)
    forward = forward if isinstance(operator, OpOverload) else operator
    # torch asks for it in every call, and searching takes nine times as long
    forward.__signature__ = signature(forward)  # pyrefly: ignore[missing-attribute]
    vmap = batched(call) if linear else looped(call, tensors=count)
    rules = {
        "forward": forward,
        "setup_context": setup_context,
        "backward": back,
        "jvp": jvp,
        "vmap": vmap,
    }
    Differentiable: Any = type(
        "Differentiable", (Function,), {name: staticmethod(act) for name, act in rules.items()}
    )
    if isinstance(operator, OpOverload):
        torch.library.register_autograd(operator.name(), rule, setup_context=keep)
        torch.library.register_vmap(operator.name(), vmap)
    return call


def _pull_back(apply: Rule, count: int, ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
    """The derivatives by the first inputs, by the reference."""
    warn_of_reference()
    inputs = saved_inputs(ctx)
    of, rest = inputs[:count], inputs[count:]
    derivatives = vjp_of(lambda *of: apply(*of, *rest), *of)(cotangent)
    return *derivatives, *[None] * len(rest)


def saved_inputs(ctx: Any) -> list[Any]:
    """The inputs of a differentiated call; None for values that no derivative needs."""
    tensors = iter(ctx.saved_tensors)
    return [next(tensors) if one is None else one[0] for one in ctx.others]


def vjp_of(act: Rule, *inputs: Tensor) -> Rule:
    """The derivatives of <cotangent, act(inputs)> by the inputs, as a function of the cotangent."""
    return torch.func.vjp(act, *inputs)[1]


def jvp_of(act: Rule, inputs: Sequence[Tensor], tangents: Sequence[Tensor | None]) -> Tensor:
    """The derivative of act(inputs) along tangents of the inputs; None: fixed.

    By double backward, as interpolation has no forward derivative.
    """
    warn_of_reference()
    moving = [i for i, tangent in enumerate(tangents) if tangent is not None]

    def moved(*some: Tensor) -> Tensor:
        every = dict(enumerate(inputs)) | dict(zip(moving, some, strict=True))
        return act(*every.values())

    value, pull = torch.func.vjp(moved, *(inputs[i] for i in moving))[:2]
    return vjp_of(pull, torch.zeros_like(value))(tuple(tangents[i] for i in moving))[0]


@cache
def warn_of_reference() -> None:
    """Warn once that the reference computes these derivatives."""
    logger.warning(
        "The reference computes second, and forward, derivatives in the geometry: the kernels "
        "have none"
    )


def batched(operator: Callable[..., Tensor]) -> Rule:
    """The `torch.func.vmap` rule of operator(values, geometry, ..): values join the batch,
    geometries are looped over.
    """

    def mapped(info, in_dims, values, geometry, *rest):
        where, of_geometry = in_dims[:2]
        if of_geometry is None:
            moved = values.movedim(where, 0)
            return operator(moved.flatten(0, 1), geometry, *rest).unflatten(0, moved.shape[:2]), 0
        copies = values.unbind(where) if where is not None else [values] * info.batch_size
        pairs = zip(copies, geometry.unbind(of_geometry), strict=True)
        return torch.stack([operator(*pair, *rest) for pair in pairs]), 0

    return mapped


def looped(operator: Callable[..., Tensor], tensors: int) -> Rule:
    """The `torch.func.vmap` rule of an operator that sums over the batch: one call each."""

    def mapped(info, in_dims, *inputs):
        copies = [
            tensor.unbind(dim) if dim is not None else [tensor] * info.batch_size
            for tensor, dim in zip(inputs[:tensors], in_dims, strict=False)
        ]
        return torch.stack(
            [operator(*one, *inputs[tensors:]) for one in zip(*copies, strict=True)]
        ), 0

    return mapped


def joined(operator: Callable[..., Tensor]) -> Callable[..., tuple[Tensor, None]]:
    """The `torch.func.vmap` rule of a query about all volumes at once, for the first geometry."""

    def mapped(info, in_dims, values, geometry, *rest):
        where, of_geometry = in_dims[:2]
        every = values if where is None else values.movedim(where, 0).flatten(0, 1)
        first = geometry if of_geometry is None else geometry.select(of_geometry, 0)
        return operator(every, first, *rest), None

    return mapped


def choose_backend(
    tensor: Tensor,
    backend: str,
    purpose: str | None = None,
    tests: self_test.Tests | None = None,
) -> str:
    """Choose the back end of a tensor: "cpu", "cuda" or "reference".

    Args:
        tensor: argument of the call: volumes or views [b c ..].
        backend: "auto" selects the compiled one of the tensor's device if available, else the
            reference.
        purpose, tests: purpose of the kernels, and their self-test on a GPU, see
            `self_test.failure`; without it a GPU has only the reference.

    Raises:
        ValueError: an unknown back end, or a compiled one of another device.
        RuntimeError: "cuda" is not available, with the reason.
    """
    if backend not in BACKENDS:
        raise ValueError(f"Unknown backend {backend!r}. Known: {', '.join(BACKENDS)}")
    device = tensor.device.type
    if backend in ("cpu", "cuda") and device != backend:
        memory = "main memory" if backend == "cpu" else "a GPU's memory"
        raise ValueError(
            f"backend {backend!r} needs tensors in {memory}, got {tensor.device}; use 'auto' or "
            f"'reference'"
        )
    if backend == "reference" or not COMPILED:
        return "reference"
    if device == "cuda":
        why = "there are no such kernels"
        if purpose and tests:
            why = self_test.failure(tensor.device, purpose, tensor.dtype, tests)
        if why and backend == "cuda":
            raise RuntimeError(f"backend 'cuda' cannot be used on {tensor.device}: {why}")
        return "reference" if why else "cuda"
    return "cpu" if device == "cpu" else "reference"
