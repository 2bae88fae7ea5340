"""Stopping rules: monitors of a method's iterates, the corner of the L-curve, and cross-validation
over views.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import or_
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.grid import Box
from mvrecon.methods.classical.solver import Iterate, Monitor
from mvrecon.operators.checks import check_finite
from mvrecon.operators.operator import LinearOperator, Projector


def discrepancy(sigma: float | Float[Tensor, "#b #c #m #v #u"]) -> Monitor:
    """A monitor that stops each sample when the noise explains its residual: chi^2 per measurement,
    the mean of ((y - A x) / sigma)^2, is at most 1.

    Morozov's discrepancy principle (Soviet Math. Dokl. 7, 1966). Pixels of infinite sigma are
    ignored.

    Args:
        sigma: standard deviation of the views' noise, in their unit; one number or views.

    Raises:
        ValueError: sigma is not positive.
    """
    spread = torch.as_tensor(sigma)
    if not (spread > 0).all():
        raise ValueError(f"Expected a positive sigma, got {spread.min().item()}")

    def explained(iterate: Iterate) -> Bool[Tensor, " b"]:
        chi = (iterate.residual / spread.to(iterate.residual)).square()
        known = spread.to(chi).isfinite().expand_as(chi).flatten(1).sum(dim=1)
        return chi.flatten(1).sum(dim=1) <= known

    return explained


def combined(*monitors: Monitor) -> Monitor:
    """A monitor that calls several and stops the run, or a sample, when any of them does."""

    def all_of_them(iterate: Iterate) -> bool | Bool[Tensor, " b"]:
        verdicts = [monitor(iterate) for monitor in monitors]
        return reduce(or_, (v if isinstance(v, Tensor) else bool(v) for v in verdicts), False)

    return all_of_them


class Curve:
    """A monitor that records |y - A x_n| and |x_n| of every iterate over the whole batch, including
    samples that have stopped.

    `residuals` and `norms` are lists, in the unit of the views and of the volume.
    """

    def __init__(self) -> None:
        self.residuals: list[float] = []
        self.norms: list[float] = []

    def __call__(self, iterate: Iterate) -> bool:
        self.residuals.append(iterate.residual.norm().item())
        self.norms.append(iterate.volume.norm().item())
        return False


def corner(residuals: Sequence[float], penalties: Sequence[float]) -> int:
    """Return the index of the corner of the L-curve, the point of greatest curvature of log penalty
    over log residual.

    For successive iterates of `cgls`, or solutions of successive weights; the curvature is that of
    the circle through a point and its neighbours (Hansen, Rank-Deficient and Discrete Ill-Posed
    Problems, 1998, 4.6).

    Args:
        residuals: |y - A x|, falling or rising.
        penalties: |x|, or another penalty.

    Raises:
        ValueError: fewer than three points, lists of two lengths, or values that are not positive.
    """
    if len(residuals) != len(penalties) or len(residuals) < 3:
        raise ValueError(
            f"Expected three points or more, got {len(residuals)} residuals and {len(penalties)} "
            f"penalties"
        )
    if not min(*residuals, *penalties) > 0:
        raise ValueError("Expected residuals and penalties above 0, got others")
    points = [(math.log(r), math.log(p)) for r, p in zip(residuals, penalties, strict=True)]
    bends = [_bend(*points[n - 1 : n + 2]) for n in range(1, len(points) - 1)]
    # an L is convex: the sign of curvature at the corner is that of the whole curve
    sense = 1 if points[0][0] > points[-1][0] else -1
    return 1 + max(range(len(bends)), key=lambda n: -sense * bends[n])


def _bend(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Signed curvature of the circle through three points, positive to the left."""
    cross = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    sides = math.dist(a, b) * math.dist(b, c) * math.dist(a, c)
    return 2 * cross / sides if sides else 0.0


@torch.no_grad()
def left_out_residual(
    method: Callable[[Projector, Tensor], Tensor],
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
) -> Float[Tensor, "b m"]:
    """Relative leave-one-out error of each view, |y_m - A_m x| / |y_m| with x from all views but
    the m-th.

    It is large for a misaligned camera, and where the other views do not determine this one; unlike
    |y - A x| it does not decrease with every iteration. Costs M reconstructions (leave-one-out:
    Wahba, Spline Models for Observational Data, 1990, chapter 4).

    Args:
        method: maps an operator and its views to a volume, such as `partial(sirt, iterations=20)`.
        A: the operator.
        views: measured views.

    Raises:
        ValueError: fewer than two views, or values that are not finite.
    """
    count = A.range_shape[0]
    if count < 2:
        raise ValueError(f"expected at least two views to leave one out, got {count}")
    check_finite(views)
    errors = []
    for m in range(count):
        kept, (A_m, y_m) = without(A, views, [m])
        size = y_m.flatten(1).norm(dim=1).clamp_min(torch.finfo(views.dtype).tiny)
        errors.append((y_m - A_m(method(*kept))).flatten(1).norm(dim=1) / size)
    return torch.stack(errors, dim=1)


def without(
    A: LinearOperator, views: Float[Tensor, "b c m v u"], left: Sequence[int]
) -> tuple[tuple[Projector, Tensor], tuple[Projector, Tensor]]:
    """Operator and views without some of the cameras, and operator and views of these."""
    grid = Box.whole(A.domain_shape)  # a crop, unlike a subset, keeps the voxel size
    kept = [m for m in range(A.range_shape[0]) if m not in left]
    return (
        (A.cropped(grid, kept), views[:, :, kept]),
        (A.cropped(grid, left), views[:, :, list(left)]),
    )


#: Maps operator, views and options to a volume.
Method = Callable[..., Tensor]


class ValidationRun(NamedTuple):
    """A run without the validation views.

    Args:
        weight: weight of the penalty; None for a method without.
        errors: relative error of the validation views, |y - A x_n| / |y|, for n = 1, 2, ... of each
            sample.
    """

    weight: float | None
    errors: list[list[float]]


class Choice(NamedTuple):
    """Result of cross-validation over views.

    Args:
        volume: volume of all views, in the unit of the volume.
        iterations: best number, for each sample.
        weights: best weight, for each sample; None for a method without.
        trials: the runs that were compared.
    """

    volume: Float[Tensor, "b c d h w"]
    iterations: list[int]
    weights: list[float] | None
    trials: list[ValidationRun]


def held_out(
    method: Method,
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    weights: Sequence[float] | None = None,
    every: int = 8,
    patience: int = 20,
    options: dict[str, Any] | None = None,
) -> Choice:
    """Reconstruct with the number of iterations and the weight chosen by cross-validation over
    views, in the unit of the volume.

    One view in `every` is held out and predicted from the others. Every sample of a batch has its
    own choice, as if it were alone; all views are then reconstructed, samples of equal choice
    together. Costs one more reconstruction for each weight (cross-validation: Wahba, Spline Models
    for Observational Data, 1990, chapter 4).

    Args:
        method: an iterative reconstructor, such as `cgls`.
        A: the operator.
        views: measured views.
        weights: values of the method's option `weight` to compare; None: its default.
        every: one view in so many is held out.
        patience: stop a trial after so many iterations without improvement in any sample.
        options: options of the method; `iterations` is the maximum, and `monitor` gets the iterates
            of all runs.

    Returns:
        The volume of all views, with the iterations and weights that were chosen and all trials.

    Warns:
        UserWarning: the best number of iterations is the maximum.

    Raises:
        ValueError: fewer than two views, `every` below 2, no weight; non-finite views; a method
            that makes no iteration, as for zero views.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> views = A(x) + 2 * torch.randn(A(x).shape, generator=torch.Generator().manual_seed(0))
        >>> best = mv.held_out(mv.cgls, A, views, patience=2, options={"iterations": 20})
        >>> bool((best.volume - x).norm() < (mv.cgls(A, views, iterations=20) - x).norm())
        True
    """
    count, fixed = A.range_shape[0], dict(options or {})
    if count < 2 or every < 2 or (weights is not None and not len(weights)):
        raise ValueError(
            f"Expected at least two views, every >= 2 and a weight, got {count} views, "
            f"every={every}, weights={weights}"
        )
    check_finite(views)
    left = list(range(min(every // 2, count - 1), count, every))
    kept, held_out = without(A, views, left)
    trials, picks = [], []
    for weight in [None] if weights is None else weights:
        run = partial(method, *kept, **_with(fixed, weight))
        errors = _errors(run, *held_out, patience, fixed.get("monitor"))
        trials.append(ValidationRun(weight, errors))
    for sample in range(len(views)):
        best = min(trials, key=lambda trial: min(trial.errors[sample]))  # noqa: B023
        errors = best.errors[sample]
        picks.append((1 + errors.index(min(errors)), best.weight))
    most = max(iterations for iterations, _ in picks)
    if most == fixed.get("iterations"):
        warnings.warn(
            f"All {most} iterations that were allowed are the best of {method.__name__}; more may "
            f"be better",
            stacklevel=2,
        )
    volume = _chosen(method, A, views, picks, fixed)
    chosen = None if weights is None else [weight for _, weight in picks if weight is not None]
    return Choice(volume, [iterations for iterations, _ in picks], chosen, trials)


def _errors(
    run: Callable[..., Tensor],
    A: LinearOperator,
    views: Tensor,
    patience: int,
    monitor: Monitor | None,
) -> list[list[float]]:
    """The relative error of held-out views after every iteration of a run, for each sample; the run
    stops after so many iterations without improvement.
    """
    errors: list[list[float]] = [[] for _ in views]
    size = views.flatten(1).norm(dim=1).clamp_min(torch.finfo(torch.float32).tiny)

    def stalled(curve: list[float]) -> bool:
        return bool(curve) and len(curve) - 1 - curve.index(min(curve)) >= patience

    def record(iterate: Iterate) -> bool:
        misfit = (views - A(iterate.volume)).flatten(1).norm(dim=1) / size
        for curve, error in zip(errors, misfit.tolist(), strict=True):
            if not stalled(curve):
                curve.append(error)
        return all(map(stalled, errors))

    run(monitor=record if monitor is None else combined(record, monitor))
    if not all(errors):
        raise ValueError("Expected a method that iterates, got one that ended before it began")
    return errors


def _chosen(
    method: Method,
    A: LinearOperator,
    views: Tensor,
    picks: list[tuple[int, float | None]],
    options: dict[str, Any],
) -> Float[Tensor, "b c d h w"]:
    """Reconstruct all samples by their iterations and weights, those of equal choice in one run."""
    parts: dict[int, Tensor] = {}
    for iterations, weight in dict.fromkeys(picks):
        samples = [sample for sample, pick in enumerate(picks) if pick == (iterations, weight)]
        chosen: dict[str, Any] = {**_with(options, weight), "iterations": iterations}
        if chosen.get("start") is not None:
            chosen["start"] = chosen["start"][samples]
        parts.update(zip(samples, method(A, views[samples], **chosen), strict=True))
    return torch.stack([parts[sample] for sample in range(len(views))])


def _with(options: dict[str, Any], weight: float | None) -> dict[str, Any]:
    return options if weight is None else {**options, "weight": weight}
