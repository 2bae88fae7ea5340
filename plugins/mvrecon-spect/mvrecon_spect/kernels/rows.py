"""Vectors of a few neighbouring pixels: a footprint's rows are added to a view, or a view's pixels
are summed under a footprint.

numba does not vectorise these loops, as it cannot know that its arrays do not overlap. LLVM splits
vectors that are wider than the processor's.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from mvrecon.kernels.compiling import FASTMATH, intrinsic

#: LLVM's flags of sums and products.
FLAGS = tuple(sorted(FASTMATH))


class _Footprint:
    """The pixels of a footprint in a view, and its shares along u and v, of the arguments of
    `add_rows`.
    """

    def __init__(self, context: Any, builder: Any, signature: Any, values: Any):
        kinds, self.builder = signature.args, builder
        self.pixels, across, self.down = (
            builder.gep(context.make_array(kinds[n])(context, builder, values[n]).data, [at])
            for n, at in ((1, values[2]), (5, values[6]), (7, values[8]))
        )
        self.stride, self.count, self.apart = values[3], values[4], values[9]
        real = context.get_value_type(kinds[1].dtype)
        self.kind = ir.VectorType(real, kinds[0].literal_value)
        self.bytes = context.get_abi_sizeof(real)
        self.across = self.load(across)

    def load(self, pointer: Any) -> Any:
        return self.builder.load(self._vector(pointer), align=self.bytes)

    def store(self, value: Any, pointer: Any) -> None:
        self.builder.store(value, self._vector(pointer), align=self.bytes)

    def _vector(self, pointer: Any) -> Any:
        return self.builder.bitcast(pointer, self.kind.as_pointer())

    def times(self, number: Any, vector: Any) -> Any:
        b, place = self.builder, ir.IntType(32)
        first = b.insert_element(ir.Constant(self.kind, ir.Undefined), number, place(0))
        same = ir.Constant(ir.VectorType(place, self.kind.count), [0] * self.kind.count)
        return b.fmul(b.shuffle_vector(first, first, same), vector, flags=FLAGS)

    @contextmanager
    def rows(self) -> Iterator[tuple[Any, Any]]:
        """Pointer to the first pixel of a row, and the row's share."""
        b = self.builder
        with cgutils.for_range(b, self.count) as loop:
            share = b.load(b.gep(self.down, [b.mul(loop.index, self.apart)]))
            yield b.gep(self.pixels, [b.mul(loop.index, self.stride)]), share


def _takes(result: Any, *more: Any) -> Any:
    """The signature of `add_rows` and `sum_rows` for types of arrays."""
    return lambda width, view, across, down: result(
        width, view, *[types.intp] * 3, across, types.intp, down, *[types.intp] * 2, *more
    )


@intrinsic(prefer_literal=True)
def add_rows(
    _, width, view, start, stride, count, across, own, down, lane, apart, value
) -> tuple[Any, Callable[..., Any]]:
    """Add a footprint times a value to a view.

    Args:
        width: pixels of a row, a constant.
        view: values of the pixels; the first is at `start`, rows are `stride` apart.
        count: rows.
        across: shares of the pixels of a row, from `own` on.
        down: shares of the rows, from `lane` on, `apart`.
    """

    def generate(context, builder, signature, values):
        prints = _Footprint(context, builder, signature, values)
        scaled = prints.times(values[10], prints.across)
        with prints.rows() as (pixels, share):
            sum_ = builder.fadd(prints.load(pixels), prints.times(share, scaled), flags=FLAGS)
            prints.store(sum_, pixels)
        return context.get_dummy_value()

    return _takes(types.void, view.dtype)(width, view, across, down), generate


@intrinsic(prefer_literal=True)
def sum_rows(
    _, width, view, start, stride, count, across, own, down, lane, apart
) -> tuple[Any, Callable[..., Any]]:
    """The sum of a view times a footprint, see `add_rows`."""

    def generate(context, builder, signature, values):
        prints = _Footprint(context, builder, signature, values)
        total = cgutils.alloca_once_value(builder, ir.Constant(prints.kind, None))
        with prints.rows() as (pixels, share):
            row = prints.times(share, prints.load(pixels))
            builder.store(builder.fadd(builder.load(total), row, flags=FLAGS), total)
        whole = builder.fmul(builder.load(total), prints.across, flags=FLAGS)
        real = prints.kind.element
        name = f"llvm.vector.reduce.fadd.v{prints.kind.count}{real.intrinsic_name}"
        kind = ir.FunctionType(real, [real, prints.kind])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [real(-0.0), whole], fastmath=FLAGS)

    return _takes(view.dtype)(width, view, across, down), generate
