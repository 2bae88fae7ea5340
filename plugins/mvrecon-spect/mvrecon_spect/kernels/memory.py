"""Reads and writes of arrays that do not overlap, so that loops with both are vectorised."""

from collections.abc import Callable
from typing import Any

from numba.core import types

from mvrecon.kernels.compiling import intrinsic


def _address(context: Any, builder: Any, signature: Any, values: Any) -> tuple[Any, Any]:
    """The pointer to an element of an array, and LLVM's name of all memory that is read."""
    data = context.make_array(signature.args[0])(context, builder, values[0]).data
    add = builder.module.add_metadata
    scope = add(["what is read", add(["mvrecon"])])
    return builder.gep(data, [values[1]]), add([scope])


@intrinsic
def read(_, array, place) -> tuple[Any, Callable[..., Any]]:
    """The element of a one-dimensional array at a place, zero or more, that `write` does not change
    meanwhile.
    """

    def generate(context, builder, signature, values):
        pointer, scope = _address(context, builder, signature, values)
        element = builder.load(pointer)
        element.set_metadata("alias.scope", scope)
        return element

    return array.dtype(array, place), generate


@intrinsic
def write(_, array, place, value) -> tuple[Any, Callable[..., Any]]:
    """Set the element of a one-dimensional array at a place, zero or more."""

    def generate(context, builder, signature, values):
        pointer, scope = _address(context, builder, signature, values)
        builder.store(values[2], pointer).set_metadata("noalias", scope)
        return context.get_dummy_value()

    return types.void(array, place, array.dtype), generate
