"""When to stop: monitors of a method's iterates, and the corner of the L-curve."""

import math
from collections.abc import Sequence
from functools import reduce
from operator import or_

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.methods.classical.solver import Iterate, Monitor


def discrepancy(sigma: float | Float[Tensor, "#b #c #m #v #u"]) -> Monitor:
    """A monitor that ends each sample where the noise explains its residual: chi^2 per measurement,
    the mean of ((y - A x) / sigma)^2, is at most 1.

    Morozov's discrepancy principle (Soviet Math. Dokl. 7, 1966). Pixels whose sigma is infinite do
    not count.

    Args:
        sigma: standard deviation of the views' noise, in their unit; one number or views.

    Raises:
        ValueError: a sigma that is not positive.
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
    """A monitor that calls several, and ends the run, or a sample, where any of them does."""

    def all_of_them(iterate: Iterate) -> bool | Bool[Tensor, " b"]:
        verdicts = [monitor(iterate) for monitor in monitors]
        return reduce(or_, (v if isinstance(v, Tensor) else bool(v) for v in verdicts), False)

    return all_of_them


class Curve:
    """A monitor that records the convergence: |y - A x_n| and |x_n| of every iterate, over the
    whole batch, samples that have ended before the others included.

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
    """The corner of the L-curve: the index of the point of greatest curvature of log penalty over
    log residual.

    For iterates of `cgls` in turn, or for solutions with weights in turn; the curvature is that of
    the circle through a point and its neighbours (Hansen, Rank-Deficient and Discrete Ill-Posed
    Problems, 1998, 4.6).

    Args:
        residuals: |y - A x|, falling or rising.
        penalties: |x|, or what else is penalised.

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
    # an L is convex: both arms go around the corner in the sense that is the same for all points
    sense = 1 if points[0][0] > points[-1][0] else -1
    return 1 + max(range(len(bends)), key=lambda n: -sense * bends[n])


def _bend(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Signed curvature of the circle through three points, positive to the left."""
    cross = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    sides = math.dist(a, b) * math.dist(b, c) * math.dist(a, c)
    return 2 * cross / sides if sides else 0.0
