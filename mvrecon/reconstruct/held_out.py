"""Iterations and weight from the data alone: some views are left out, and judge."""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.views import check_finite
from mvrecon.geometry.box import Box
from mvrecon.projectors.operator import LinearOperator
from mvrecon.reconstruct.problem import Iterate

#: A reconstructor: operator, views and options to a volume.
Method = Callable[..., Tensor]


class Trial(NamedTuple):
    """A run without the views that judge.

    Args:
        weight: of the penalty; None for a method without.
        errors: relative error of the views that were left out, |y - A x_n| / |y|, for n = 1, 2, ...
    """

    weight: float | None
    errors: list[float]


class Choice(NamedTuple):
    """What views that were left out have chosen.

    Args:
        volume: of all views, in the unit of the volume.
        iterations: how many were best.
        weight: which was best; None for a method without.
        trials: the runs that were compared.
    """

    volume: Float[Tensor, "b c d h w"]
    iterations: int
    weight: float | None
    trials: list[Trial]


def held_out(
    method: Method,
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    weights: Sequence[float] | None = None,
    every: int = 8,
    patience: int = 20,
    options: dict[str, Any] | None = None,
) -> Choice:
    """The volume with those iterations and that weight of which a reconstruction of the other views
    predicts one view in `every` best, in the unit of the volume.

    One choice for the whole batch. Then all views are reconstructed with it. The cost is that of
    one more reconstruction for every weight (cross-validation: Wahba, Spline Models for
    Observational Data, 1990, chapter 4).

    Args:
        method: an iterative reconstructor, such as `cgls`.
        A: the operator.
        views: measured.
        weights: values of the method's option `weight` to compare; None: the method's own value.
        every: one view in so many judges.
        patience: a trial ends where so many iterations have brought nothing better.
        options: of the method; its `iterations` are the most that are tried.

    Warns:
        UserWarning: the best number of iterations is the most that was allowed.

    Raises:
        ValueError: fewer than two views, `every` below 2, no weight; views that are not finite; no
            iteration, as for views of zero.
    """
    count, fixed = A.range_shape[0], dict(options or {})
    if count < 2 or every < 2 or (weights is not None and not len(weights)):
        raise ValueError(
            f"Expected at least two views, every >= 2 and a weight, got {count} views, "
            f"every={every}, weights={weights}"
        )
    check_finite(views)
    judges = list(range(min(every // 2, count - 1), count, every))
    rest = [view for view in range(count) if view not in set(judges)]
    grid = Box.whole(A.domain_shape)  # a crop, unlike a subset, knows its voxels' size
    jury, trials = _Jury(A.cropped(grid, judges), views[:, :, judges], patience), []
    taken, explained = A.cropped(grid, rest), views[:, :, rest]
    for weight in [None] if weights is None else weights:
        run = partial(method, taken, explained, **_with(fixed, weight))
        trials.append(Trial(weight, jury.errors(run)))
    best = min(trials, key=lambda trial: min(trial.errors))
    iterations = 1 + best.errors.index(min(best.errors))
    if iterations == fixed.get("iterations"):
        warnings.warn(
            f"All {iterations} iterations that were allowed are the best of {method.__name__}; "
            f"more may be better",
            stacklevel=2,
        )
    chosen = {**_with(fixed, best.weight), "iterations": iterations}
    return Choice(method(A, views, **chosen), iterations, best.weight, trials)


class _Jury(NamedTuple):
    """Views that were left out, and how long they wait for something better."""

    A: LinearOperator
    views: Tensor
    patience: int

    def errors(self, run: Callable[..., Tensor]) -> list[float]:
        """Their relative error after every iteration of a run."""
        errors, size = [], self.views.norm().clamp_min(torch.finfo(torch.float32).tiny)

        def judge(iterate: Iterate) -> bool:
            errors.append(((self.views - self.A(iterate.volume)).norm() / size).item())
            return len(errors) - 1 - errors.index(min(errors)) >= self.patience

        run(monitor=judge)
        if not errors:
            raise ValueError("Expected a method that iterates, got one that ended before it began")
        return errors


def _with(options: dict[str, Any], weight: float | None) -> dict[str, Any]:
    return options if weight is None else {**options, "weight": weight}
