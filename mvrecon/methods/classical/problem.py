"""What every reconstruction method is asked: an operator, views, a start, a support, and a monitor
that looks at each iterate.
"""

import inspect
from collections.abc import Callable
from functools import wraps
from numbers import Integral
from typing import Any, Literal, NamedTuple, ParamSpec, TypedDict, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.registry import hint
from mvrecon.kernels.precision import wide
from mvrecon.operators.checks import check, check_finite, check_measured
from mvrecon.operators.operator import LinearOperator

P = ParamSpec("P")
Method = TypeVar("Method", bound=Callable[..., Any])
#: What a method's views are: line integrals, counts, or what a network was trained on.
Kind = Literal["integrals", "counts", "trained"]


class Iterate(NamedTuple):
    """An iterate x_n of a method, as a monitor sees it; its tensors must not be written into.

    Args:
        number: n, from 1.
        volume: x_n, in the unit of the volume.
        residual: y - A x_n, in the unit of the views.
        gap: how far the objective is above its minimum at most, relative to the objective; None for
            methods, and for iterates, without this number.
        objective: what the method minimises, of each sample; None for methods without this number.
    """

    number: int
    volume: Float[Tensor, "b c d h w"]
    residual: Float[Tensor, "b c m v u"]
    gap: Float[Tensor, "b c"] | None = None
    objective: Float[Tensor, " b"] | None = None


#: Looks at every iterate; the method ends with the one for which it returns true. A mask [b] ends
#: single samples: each keeps its iterate, and the method goes on until all have ended.
Monitor = Callable[[Iterate], bool | Bool[Tensor, " b"] | None]
#: What a method minimises, of each sample [b], from a volume and its residual views.
Objective = Callable[[Tensor, Tensor], Tensor]


class Common(TypedDict, total=False):
    """Options that every iterative method has.

    Args:
        start: the first volume [b c d h w], in the unit of the volume; zero by default.
        support: the voxels that may be anything but zero, a mask [d h w].
        monitor: called after every iteration; the method ends where it returns true.
    """

    start: Float[Tensor, "b c d h w"] | None
    support: Bool[Tensor, "d h w"] | None
    monitor: Monitor | None


def declares(views: Kind = "integrals", iterates: bool = False) -> Callable[[Method], Method]:
    """Decorator that declares properties of a classical method as its attributes.

    Args:
        views: line integrals, or counts.
        iterates: whether it shows its iterates to a monitor, so that stopping rules, progress bars
            and the choice of iterations apply.
    """

    def declared(method: Method) -> Method:
        setattr(method, "views", views)  # noqa: B010 - functions have no such attribute by type
        setattr(method, "iterates", iterates)  # noqa: B010
        return method

    return declared


def without_gradient(method: Callable[P, Tensor]) -> Callable[P, Tensor]:
    """A reconstructor that computes without gradients, and refuses views or a start that want one,
    instead of a volume that silently is a constant.

    Raises:
        ValueError: of the method that is returned, where gradients are recorded and a tensor among
            its arguments requires one.
    """

    @wraps(method)
    def checked(*args: P.args, **options: P.kwargs) -> Tensor:
        tensors = [value for value in (*args, *options.values()) if isinstance(value, Tensor)]
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
            name = getattr(method, "__name__", "the method")
            raise ValueError(
                f"Expected tensors without gradient for {name}, which has none, got one that "
                f"requires it; take tikhonov, sirt, fbp or fdk, which are differentiable, or "
                f"views.detach()"
            )
        with torch.no_grad():
            return method(*args, **options)

    return checked


class Problem(NamedTuple):
    """Views to be explained, y = A x, after the checks at the door.

    Args:
        A: the operator, with the support in it.
        views: y, float32 or float64.
        start: the first volume, zero outside the support; same dtype.
        monitor: looks at every iterate.
        started: whether the start is the user's; else it is zero.
    """

    A: LinearOperator
    views: Float[Tensor, "b c m v u"]
    start: Float[Tensor, "b c d h w"]
    monitor: Monitor | None = None
    started: bool = False

    def unexplained(self) -> Float[Tensor, "b c m v u"]:
        """The residual views y - A x of the start; of none, the views, without a projection."""
        return self.views - self.A(self.start) if self.started else self.views


def posed(
    method: Callable[..., Tensor], A: LinearOperator, views: Tensor, options: Common
) -> Problem:
    """The problem that a method is given, checked.

    Raises:
        TypeError: an option that the method does not have; the message gives the nearest and all.
        ValueError: views or a start of another shape than the operator's, on another device, or
            with values that are not finite; an empty batch; a support that is no mask of the
            volume's shape.
    """
    within = supported(method, A, options)
    check_measured(views, "views", A.range_shape, A.device)
    check_finite(views, on_gpu=False)
    views, support, start = wide(views), options.get("support"), options.get("start")
    started = start is not None
    if start is None:
        start = views.new_zeros(*views.shape[:2], *A.domain_shape)
    else:
        check_start(A, start, views)
        start = start.to(views.dtype)
    if support is not None:
        start = start * support.to(start.device)
    return Problem(within, views, start, options.get("monitor"), started)


def supported(method: Callable[..., Tensor], A: LinearOperator, options: Common) -> LinearOperator:
    """A diag(support), after the check of the options' names.

    Raises:
        TypeError: an option that the method does not have.
        ValueError: a support that is no mask of the volume's shape.
    """
    parameters = inspect.signature(method).parameters.values()
    specific, common = {p.name for p in parameters}, Common.__annotations__
    for option in set(options) - set(common):
        known = (specific - {"common"}) | set(common)
        raise TypeError(f"{method.__name__} has no option {option!r}{hint(option, known)}")
    support = options.get("support")
    if support is None:
        return A
    if support.dtype != torch.bool or tuple(support.shape) != tuple(A.domain_shape):
        got = f"{support.dtype} {tuple(support.shape)}"
        raise ValueError(f"Expected a support, a mask of {tuple(A.domain_shape)}, got {got}")
    return A.with_support(support)


def check_iterations(iterations: int) -> None:
    """Refuse a number of iterations that is none.

    Raises:
        ValueError: no whole number, or a negative one.
    """
    if not isinstance(iterations, Integral) or iterations < 0:
        raise ValueError(f"Expected iterations, a whole number of at least 0, got {iterations!r}")


def check_start(A: LinearOperator, start: Tensor, views: Tensor) -> None:
    """Refuse a first volume that does not belong to the operator and the views.

    Raises:
        ValueError: another shape, batch or device, or values that are not finite; on a GPU, where
            nobody waits for them, results from such values are not finite either.
    """
    check(start, "start", A.domain_shape, A.device)
    if start.shape[:2] != views.shape[:2] or (start.is_cpu and not start.isfinite().all()):
        raise ValueError(
            f"Expected a finite start with the views' [b c] {tuple(views.shape[:2])}, got "
            f"{tuple(start.shape)} with {int((~start.isfinite()).sum())} values that are not finite"
        )


class Watch:
    """Shows a monitor the iterates of a method whose steps begin at x + beta (x - last).

    The residual at that point gives the one at x by linearity, so that no iterate is projected for
    the monitor but the last. Without a monitor nothing is kept. A sample that has ended before the
    others keeps its iterate, so that a batch gives what its samples alone would.

    Args:
        monitor: looks at every iterate.
        objective: of each sample, from volume and residual; None: not shown.
    """

    def __init__(self, monitor: Monitor | None, objective: Objective | None = None):
        self.monitor, self.objective = monitor, objective
        self.residual: Tensor | None = None
        self._done: Tensor | None = None
        self._kept: Tensor | None = None

    def ends(
        self,
        number: int,
        volume: Tensor,
        residual: Callable[[], Tensor],
        beta: float | Tensor = 0,
        gap: Tensor | None = None,
    ) -> bool:
        """Whether the method ends with iterate `number`.

        Args:
            number: of the iterate; 0, the start, is not shown.
            volume: x.
            residual: y - A (x + beta (x - last)), asked for only where a monitor looks.
            beta: how far the step begins beyond x.
            gap: of the iterate, where it is known.
        """
        if self.monitor is None:
            return False
        of_volume = residual()
        if self.residual is not None:
            of_volume = (of_volume + beta * self.residual) / (1 + beta)
        self.residual = of_volume
        if number == 0:
            return False
        objective = None if self.objective is None else self.objective(volume, of_volume)
        verdict = self.monitor(Iterate(number, volume, of_volume, gap, objective))
        return self._ended(verdict, volume) if isinstance(verdict, Tensor) else bool(verdict)

    def result(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c d h w"]:
        """The volume that a method returns: of every sample the iterate with which it has ended."""
        if self._done is None or self._kept is None:
            return volume
        return torch.where(_of_samples(self._done), self._kept, volume)

    def _ended(self, verdict: Bool[Tensor, " b"], volume: Tensor) -> bool:
        """Keep the samples that end here; whether all have ended."""
        verdict = verdict.to(volume.device)
        kept = self.result(volume)
        self._done = verdict if self._done is None else self._done | verdict
        if self._done.any():
            self._kept = kept
        return bool(self._done.all())


def _of_samples(mask: Bool[Tensor, " b"]) -> Bool[Tensor, "b 1 1 1 1"]:
    return mask[:, None, None, None, None]
