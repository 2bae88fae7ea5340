"""Operators that can be had on a finer grid: what a coarse grid and thin rays cannot hold of views
is the largest error where these are few and clean.
"""

from typing import Any


class Refinable:
    """An operator that may be had on a finer grid, which it says by the capability "refine"."""

    def refined(self, factor: int) -> Any:
        """A on a grid `factor` times finer, a pixel the mean over `factor` times as many rays each
        way: a projector whose views have the same shape.

        Raises:
            ValueError: an operator that is not known on another grid.
        """
        raise ValueError(
            f"Expected an operator that can be had on a grid {factor} times finer, such as drr or "
            f"radon, got {type(self).__name__}"
        )
