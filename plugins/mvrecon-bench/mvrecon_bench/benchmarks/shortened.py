"""Run time of a method that takes too long, from fewer of its iterations."""

from collections.abc import Callable
from typing import NamedTuple


class Shortened(NamedTuple):
    """A run time in seconds, scaled from that of so many iterations."""

    seconds: float
    iterations: int


def shortened(run: Callable[[int], float], iterations: int, limit_s: float) -> Shortened | None:
    """The seconds that so many iterations would take, from one and two of them; None where they
    would take no longer than the limit, and may be run.

    A second iteration costs what every later one does; the first run has the setting up as well.
    Where one iteration passes the limit by itself, all are taken to cost as much.

    Args:
        run: seconds of a number of iterations.
        iterations: of the whole run.
        limit_s: seconds that a run may take.
    """
    first = run(1)
    if first * iterations <= limit_s:
        return None
    if first > limit_s:
        return Shortened(first * iterations, 1)
    whole = first + (iterations - 1) * max(run(2) - first, 0.0)
    return Shortened(whole, 2) if whole > limit_s else None
