"""Run time of a slow method, extrapolated from fewer iterations."""

from collections.abc import Callable
from typing import NamedTuple


class Shortened(NamedTuple):
    """A run time in seconds, extrapolated from a number of iterations."""

    seconds: float
    iterations: int


def shortened(run: Callable[[int], float], iterations: int, limit_s: float) -> Shortened | None:
    """Seconds of a number of iterations, extrapolated from one and two iterations; None if they
    would not exceed the limit and can be run.

    The second iteration costs the same as every later one; the first run also includes the setup.
    If one iteration already exceeds the limit, all iterations are assumed to cost the same.

    Args:
        run: seconds of a number of iterations.
        iterations: number of iterations of the full run.
        limit_s: maximum seconds of a run.
    """
    first = run(1)
    if first * iterations <= limit_s:
        return None
    if first > limit_s:
        return Shortened(first * iterations, 1)
    whole = first + (iterations - 1) * max(run(2) - first, 0.0)
    return Shortened(whole, 2) if whole > limit_s else None
