"""Iterations and weight from the data alone: some views are left out, and judge."""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.box import Box
from mvrecon.methods.classical.problem import Iterate, Monitor
from mvrecon.methods.classical.stopping import combined
from mvrecon.operators.checks import check_finite
from mvrecon.operators.operator import LinearOperator, Projector


@torch.no_grad()
def left_out_residual(
    method: Callable[[Projector, Tensor], Tensor],
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
) -> Float[Tensor, "b m"]:
    """Relative error of each view as the other cameras predict it, |y_m - A_m x| / |y_m| with x
    from all views but the m-th, without a unit.

    It is large where a camera is wrong, and where the others do not determine what it sees; unlike
    |y - A x| it does not fall with every iteration. The cost is that of M reconstructions
    (leave-one-out: Wahba, Spline Models for Observational Data, 1990, chapter 4).

    Args:
        method: from an operator and its views to a volume, such as `partial(sirt, iterations=20)`.
        A: the operator.
        views: measured.

    Raises:
        ValueError: fewer than two views, or values that are not finite.
    """
    count = A.range_shape[0]
    if count < 2:
        raise ValueError(f"expected at least two views to leave one out, got {count}")
    check_finite(views)
    grid, errors = Box.whole(A.domain_shape), []  # a crop, unlike a subset, knows its voxels' size
    for m in range(count):
        others = [n for n in range(count) if n != m]
        volume = method(A.cropped(grid, others), views[:, :, others])
        view = views[:, :, [m]]
        rest = (view - A.cropped(grid, [m])(volume)).flatten(1).norm(dim=1)
        errors.append(rest / view.flatten(1).norm(dim=1).clamp_min(torch.finfo(view.dtype).tiny))
    return torch.stack(errors, dim=1)


#: A reconstructor: operator, views and options to a volume.
Method = Callable[..., Tensor]


class Trial(NamedTuple):
    """A run without the views that judge.

    Args:
        weight: of the penalty; None for a method without.
        errors: relative error of the views that were left out, |y - A x_n| / |y|, for n = 1, 2, ...
            of each sample in turn.
    """

    weight: float | None
    errors: list[list[float]]


class Choice(NamedTuple):
    """What views that were left out have chosen.

    Args:
        volume: of all views, in the unit of the volume.
        iterations: how many were best, for each sample.
        weights: which was best, for each sample; None for a method without.
        trials: the runs that were compared.
    """

    volume: Float[Tensor, "b c d h w"]
    iterations: list[int]
    weights: list[float] | None
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

    Every sample of a batch has its own choice, the one that it would have alone. Then all views are
    reconstructed with it, samples of the same choice together. The cost is that of one more
    reconstruction for every weight (cross-validation: Wahba, Spline Models for Observational Data,
    1990, chapter 4).

    Args:
        method: an iterative reconstructor, such as `cgls`.
        A: the operator.
        views: measured.
        weights: values of the method's option `weight` to compare; None: the method's own value.
        every: one view in so many judges.
        patience: a trial ends where so many iterations have brought nothing better to any sample.
        options: of the method; its `iterations` are the most that are tried, its `monitor` sees the
            iterates of all runs in turn.

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
        trials.append(Trial(weight, jury.errors(run, fixed.get("monitor"))))
    picks = [_best(trials, sample) for sample in range(len(views))]
    most = max(pick.iterations for pick in picks)
    if most == fixed.get("iterations"):
        warnings.warn(
            f"All {most} iterations that were allowed are the best of {method.__name__}; more may "
            f"be better",
            stacklevel=2,
        )
    volume = _chosen(method, A, views, picks, fixed)
    best = None if weights is None else [pick.weight for pick in picks if pick.weight is not None]
    return Choice(volume, [pick.iterations for pick in picks], best, trials)


class _Pick(NamedTuple):
    """The choice of one sample."""

    iterations: int
    weight: float | None


class _Jury(NamedTuple):
    """Views that were left out, and how long they wait for something better."""

    A: LinearOperator
    views: Tensor
    patience: int

    def errors(self, run: Callable[..., Tensor], monitor: Monitor | None) -> list[list[float]]:
        """Their relative error after every iteration of a run, for each sample."""
        errors: list[list[float]] = [[] for _ in self.views]
        size = self.views.flatten(1).norm(dim=1).clamp_min(torch.finfo(torch.float32).tiny)

        def judge(iterate: Iterate) -> bool:
            misfit = (self.views - self.A(iterate.volume)).flatten(1).norm(dim=1) / size
            for curve, error in zip(errors, misfit.tolist(), strict=True):
                if not self._tired(curve):
                    curve.append(error)
            return all(map(self._tired, errors))

        run(monitor=judge if monitor is None else combined(judge, monitor))
        if not all(errors):
            raise ValueError("Expected a method that iterates, got one that ended before it began")
        return errors

    def _tired(self, errors: list[float]) -> bool:
        return len(errors) - 1 - errors.index(min(errors)) >= self.patience if errors else False


def _best(trials: Sequence[Trial], sample: int) -> _Pick:
    """The iterations and the weight with the least error of a sample."""
    best = min(trials, key=lambda trial: min(trial.errors[sample]))
    return _Pick(1 + best.errors[sample].index(min(best.errors[sample])), best.weight)


def _chosen(
    method: Method, A: LinearOperator, views: Tensor, picks: list[_Pick], options: dict[str, Any]
) -> Float[Tensor, "b c d h w"]:
    """All samples, those of the same choice in one run."""
    parts: dict[int, Tensor] = {}
    for pick in dict.fromkeys(picks):
        samples = [sample for sample, choice in enumerate(picks) if choice == pick]
        chosen = {**_with(options, pick.weight), "iterations": pick.iterations}
        if chosen.get("start") is not None:
            chosen["start"] = chosen["start"][samples]
        parts.update(zip(samples, method(A, views[samples], **chosen), strict=True))
    return torch.stack([parts[sample] for sample in range(len(views))])


def _with(options: dict[str, Any], weight: float | None) -> dict[str, Any]:
    return options if weight is None else {**options, "weight": weight}
