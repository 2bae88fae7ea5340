"""Common parts of iterative methods: a method yields its iterates, and `solve` consumes them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import wraps
from inspect import signature
from itertools import islice
from numbers import Integral
from typing import Literal, NamedTuple, ParamSpec, Self, TypedDict

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.registry import hint
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.operators.checks import check, check_finite, check_measured
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.selection import check_support

P = ParamSpec("P")
#: The kind of a method's views: line integrals, counts, or those a network was trained on.
DataKind = Literal["integrals", "counts", "trained"]


class Iterate(NamedTuple):
    """An iterate x_n as passed to a monitor; its tensors must not be modified.

    Args:
        number: n, from 1.
        volume: x_n, in the unit of the volume.
        residual: y - A x_n, in the unit of the views.
        gap: upper bound of the objective's excess over its minimum, relative to the objective; None
            where not computed.
        objective: value of the objective for each sample; None for methods that do not compute it.
    """

    number: int
    volume: Float[Tensor, "b c d h w"]
    residual: Float[Tensor, "b c m v u"]
    gap: Float[Tensor, "b c"] | None = None
    objective: Float[Tensor, " b"] | None = None


#: Called with every iterate; the method stops when it returns true. A mask [b] stops single
#: samples: each keeps its iterate, and the method continues until all have stopped.
Monitor = Callable[[Iterate], bool | Bool[Tensor, " b"] | None]
#: The objective of each sample [b], from a volume and its residual views.
Objective = Callable[[Tensor, Tensor], Tensor]


class Common(TypedDict, total=False):
    """Options of every iterative method.

    Args:
        start: the initial volume [b c d h w], in the unit of the volume; zero by default.
        support: mask [d h w] of the voxels that may differ from zero.
        monitor: called after every iteration; the method stops when it returns true.
    """

    start: Float[Tensor, "b c d h w"] | None
    support: Bool[Tensor, "d h w"] | None
    monitor: Monitor | None


def declares(
    data_kind: DataKind = "integrals",
    iterates: bool = False,
    differentiable: bool = True,
    streamed: Callable[..., Tensor] | None = None,
) -> Callable[[Callable[P, Tensor]], Callable[P, Tensor]]:
    """Decorator that declares properties of a classical method f(A, views, **options).

    `data_kind`, `iterates` and `streamed` become attributes of the function.

    Args:
        data_kind: line integrals, or counts.
        iterates: whether it passes its iterates to a monitor, as stopping rules, progress bars and
            the choice of iterations need.
        differentiable: whether gradients flow from the volume to the views; otherwise the method
            rejects tensors that require a gradient, and runs under `torch.no_grad`.
        streamed: the same method for views larger than memory, f(read, cameras, grid, **options) ->
            volume [1 1 d h w], where `read(first, last)` returns the views first to last - 1 as
            [m v u]; None: the method needs all views at once.

    Raises:
        TypeError: (decorated function) an unknown option; the message gives the nearest name and
            all names.
        ValueError: (decorated function) a tensor that requires a gradient while gradients are
            recorded, if the method is not differentiable.
    """

    def declared(method: Callable[P, Tensor]) -> Callable[P, Tensor]:
        name, parameters = getattr(method, "__name__", "method"), signature(method).parameters
        known = set(parameters) - {"common"}
        if "common" in parameters:
            known |= set(Common.__annotations__)

        @wraps(method)
        def checked(*args: P.args, **options: P.kwargs) -> Tensor:
            for option in set(options) - known:
                raise TypeError(f"{name} has no option {option!r}{hint(option, known)}")
            if differentiable:
                return method(*args, **options)
            check_no_gradient(name, *args, *options.values())
            with torch.no_grad():
                return method(*args, **options)

        setattr(checked, "data_kind", data_kind)  # noqa: B010 - no such attribute by type
        setattr(checked, "iterates", iterates)  # noqa: B010
        setattr(checked, "streamed", streamed)  # noqa: B010
        return checked

    return declared


def check_no_gradient(name: str, *inputs: object) -> None:
    """Check that no input of a method that is not differentiable requires a gradient.

    Raises:
        ValueError: a tensor that requires one, while gradients are recorded.
    """
    moving = any(isinstance(one, Tensor) and one.requires_grad for one in inputs)
    if moving and torch.is_grad_enabled():
        raise ValueError(
            f"Expected tensors without gradient for {name}, which is not differentiable, got one "
            f"that requires it; use tikhonov, sirt, fbp or fdk, which are, or views.detach()"
        )


@dataclass(frozen=True, eq=False)
class InverseProblem:
    """y = A x + r, solved for x: the checked arguments of a method.

    Args:
        A: the operator, restricted to the support.
        views: y.
        start: the initial volume, zero outside the support; None: zero.
        iterations: maximum number of iterations.
        support: the voxels that may differ from zero; None: all.
        monitor: called with every iterate.
        background: r, expected counts of other origin.
    """

    A: LinearOperator
    views: Float[Tensor, "b c m v u"]
    start: Float[Tensor, "b c d h w"] | None
    iterations: int
    support: Bool[Tensor, "d h w"] | None = None
    monitor: Monitor | None = None
    background: float | Float[Tensor, "b c m v u"] = 0.0  # a number is zero

    @classmethod
    def of(
        cls,
        A: LinearOperator,
        views: Float[Tensor, "b c m v u"],
        iterations: int,
        options: Common,
        background: float | Float[Tensor, "b c m v u"] | None = None,
    ) -> Self:
        """Check a method's arguments and convert its tensors to float32 or float64.

        Args:
            A, views, iterations: the method's arguments.
            options: those that all methods share.
            background: expected background of counts, whose values `PoissonLikelihood` checks;
                None: the views are line integrals.

        Raises:
            ValueError: views or a start of another shape or device than the operator's, or with
                non-finite values; an empty batch; a support that is not a mask of the volume's
                shape; iterations that are not a whole number of at least 0.
        """
        if not isinstance(iterations, Integral) or iterations < 0:
            raise ValueError(
                f"Expected iterations, a whole number of at least 0, got {iterations!r}"
            )
        support, start = options.get("support"), options.get("start")
        if support is not None:
            check_support(support, tuple(A.domain_shape))
            A = A.with_support(support)
            support = support.to(A.device)
        kind = "views" if background is None else "counts [b c m v u]"
        check_measured(views, kind, A.range_shape, A.device)
        if background is None:
            check_finite(views, on_gpu=False)
        views = to_accumulation_dtype(views)
        if start is not None:
            # not checked on a GPU, to avoid a synchronisation: results are then not finite either
            check(start, "start", A.domain_shape, A.device)
            unchecked = torch.compiler.is_exporting() or not start.is_cpu
            if start.shape[:2] != views.shape[:2] or not (unchecked or start.isfinite().all()):
                raise ValueError(
                    f"Expected a finite start with the views' [b c] {tuple(views.shape[:2])}, got "
                    f"{tuple(start.shape)} with {int((~start.isfinite()).sum())} values that are "
                    f"not finite"
                )
            start = start.to(views.dtype)
            start = start if support is None else start * support
        if background is None or (isinstance(background, int | float) and background == 0):
            background = 0.0
        else:
            background = spread_background(background, views)
        return cls(A, views, start, iterations, support, options.get("monitor"), background)

    @property
    def first(self) -> Float[Tensor, "b c d h w"]:
        """The initial volume."""
        if self.start is not None:
            return self.start
        return self.views.new_zeros(*self.views.shape[:2], *self.A.domain_shape)

    def divided(self, scale: Float[Tensor, "b c 1 1 1"]) -> Self:
        """Divide views, start and background by a scale."""
        start = None if self.start is None else self.start / scale
        background = self.background
        background = background / scale if isinstance(background, Tensor) else background
        return replace(self, views=self.views / scale, start=start, background=background)

    def residual(self, volume: Float[Tensor, "b c d h w"] | None) -> Float[Tensor, "b c m v u"]:
        """Return y - (A x + r); the views for None, without a projection."""
        if volume is None:
            return self.views
        expected = self.A(volume)
        if isinstance(self.background, Tensor):
            expected = expected + self.background
        return self.views - expected


class Step(NamedTuple):
    """An iterate as a method yields it.

    Args:
        volume: x_n.
        residual: y - A x_n, if the method has it; else computed for a monitor.
        gap: see `Iterate`.
    """

    volume: Float[Tensor, "b c d h w"]
    residual: Float[Tensor, "b c m v u"] | None = None
    gap: Float[Tensor, "b c"] | None = None


def solve(
    problem: InverseProblem,
    steps: Iterable[Step],
    scale: Float[Tensor, "#b #c 1 1 1"] | None = None,
    objective: Objective | None = None,
) -> Float[Tensor, "b c d h w"]:
    """Run a method; returns its last iterate, in the unit of the volume.

    A sample that a monitor stops early keeps its iterate, so batched results equal those of single
    samples.

    Args:
        problem: gives the number of iterations and the monitor.
        steps: the iterates of a method, infinite or until convergence.
        scale: divisor that the method has applied to views and start; None: one.
        objective: passed to the monitor; None: nothing.
    """
    step: Step | None = None
    done: Tensor | None = None
    kept: Tensor | None = None

    def scaled(tensor: Tensor) -> Tensor:
        return tensor if scale is None else tensor * scale

    for number, step in enumerate(islice(steps, problem.iterations), 1):
        if problem.monitor is None:
            continue
        volume, residual = scaled(step.volume), step.residual
        residual = problem.residual(volume) if residual is None else scaled(residual)
        value = None if objective is None else objective(volume, residual)
        stop = problem.monitor(Iterate(number, volume, residual, step.gap, value))
        if not isinstance(stop, Tensor):
            if stop:
                break
            continue
        stop = stop.to(volume.device)[:, None, None, None, None]
        kept = volume if kept is None or done is None else torch.where(done, kept, volume)
        done = stop if done is None else done | stop
        if done.all():
            break
    volume = problem.first if step is None else scaled(step.volume)
    return volume if kept is None or done is None else torch.where(done, kept, volume)


def spread_background(
    background: float | Tensor, counts: Float[Tensor, "b c m v u"]
) -> Float[Tensor, "b c m v u"]:
    """Expand a background to the shape of the counts, without copies.

    Raises:
        TypeError: neither a number nor a tensor.
        ValueError: a tensor that does not broadcast to the counts.
    """
    if not isinstance(background, Tensor | int | float):
        raise TypeError(f"Expected a background of one number or views, got {background!r}")
    like = to_accumulation_dtype(counts[:0])
    if not isinstance(background, Tensor):
        return like.new_full((), background).expand(counts.shape)
    added = background.to(like)
    try:
        return added.expand(counts.shape)
    except RuntimeError as error:
        raise ValueError(
            f"Expected a background of one number or views that broadcast to "
            f"{tuple(counts.shape)}, "
            f"got {tuple(added.shape)}"
        ) from error


def power_of_two(*tensors: Tensor | None) -> Float[Tensor, "b c 1 1 1"]:
    """Return the greatest power of two up to each sample's largest absolute value in all tensors;
    one for zeros.

    Dividing by it is exact and keeps squares within the range of float32.
    """
    peaks = [t.abs().flatten(2).amax(dim=2) for t in tensors if t is not None]
    peak = torch.stack(peaks).amax(dim=0)
    scale = peak / (2 * torch.frexp(peak).mantissa)
    return torch.where((peak > 0) & peak.isfinite(), scale, 1)[..., None, None, None]


def check_not_negative(**options: float) -> None:
    """Raise if an option is negative or not finite.

    Raises:
        ValueError: with the option's name.
    """
    for name, value in options.items():
        if not 0 <= value < float("inf"):
            raise ValueError(f"Expected {name} of at least 0, got {value}")
