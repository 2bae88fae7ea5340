"""Confidence intervals of paired differences (Student's t)."""

import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple


class Interval(NamedTuple):
    """A mean with the bounds of its confidence interval; bounds are nan for fewer than two values,
    and where the mean is not finite.
    """

    mean: float
    low: float
    high: float


def mean_interval(values: Sequence[float], level: float = 0.95) -> Interval:
    """The mean of independent values and the interval that holds their expectation with a
    probability of `level`, for values of a normal distribution (Student 1908).

    No value is left out: the mean is nan where one is, and for none.
    """
    mean = sum(values) / len(values) if values else math.nan
    if len(values) < 2 or not math.isfinite(mean):
        return Interval(mean, math.nan, math.nan)
    error = statistics.stdev(values) / math.sqrt(len(values))
    half = t_quantile(level, len(values) - 1) * error
    return Interval(mean, mean - half, mean + half)


def t_quantile(level: float, freedom: int) -> float:
    """The t for which |T| < t has a probability of `level`, T of Student's distribution with
    `freedom` degrees of freedom.

    Raises:
        ValueError: a level that is not between 0 and 1, or no degree of freedom.
    """
    if not 0 < level < 1 or freedom < 1:
        raise ValueError(f"Expected 0 < level < 1 and freedom >= 1, got {level} and {freedom}")
    low, high = 0.0, math.pi / 2  # of atan(t / sqrt(freedom))
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _probability(middle, freedom) < level else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def _probability(angle: float, freedom: int) -> float:
    """P(|T| < t) for t = sqrt(freedom) tan(angle): a finite sum (Abramowitz & Stegun 1964, 26.7.3
    and 26.7.4).
    """
    odd, term, total = freedom % 2, 1.0, 0.0
    for k in range((freedom - odd) // 2):
        total += term
        term *= math.cos(angle) ** 2 * (2 * k + 1 + odd) / (2 * k + 2 + odd)
    if odd:
        return 2 / math.pi * (angle + math.sin(angle) * math.cos(angle) * total)
    return math.sin(angle) * total
