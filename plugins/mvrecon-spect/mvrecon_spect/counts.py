"""Counts in parts, and counts that decay while a detector looks."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.operators.operator import LinearOperator, Scaled
from mvrecon_spect.scatter import check_counts


def thinned(
    counts: Float[Tensor, "*n"], shares: Sequence[float], rng: torch.Generator
) -> list[Float[Tensor, "*n"]]:
    """Shorter measurements out of one, by binomial thinning: every count falls into a part at
    random, in counts.

    The parts of Poisson numbers are independent Poisson numbers with these shares of the mean; with
    shares that sum to 1 they sum to the counts. Halves are two measurements of one object.

    Args:
        counts: whole numbers.
        shares: of each part, 1 together at most.
        rng: of the random numbers.

    Raises:
        ValueError: shares that are negative or sum to more than 1, counts that are negative, not
            finite or not whole.
    """
    if not shares or min(shares) < 0 or sum(shares) > 1 + 1e-9:
        raise ValueError(f"Expected shares of at least 0 that sum to 1 at most, got {list(shares)}")
    check_counts(counts)
    if (counts != counts.round()).any():
        raise ValueError(
            f"Expected whole counts, got others; the first is "
            f"{counts[counts != counts.round()][0].item():.6g}"
        )
    rest, left, parts = counts, 1.0, []
    for share in shares:
        chance = min(1.0, share / left) if left > 1e-9 else 0.0
        parts.append(torch.binomial(rest, torch.full_like(rest, chance), generator=rng))
        rest, left = rest - parts[-1], left - share
    return parts


def decay_factors(
    start_s: Sequence[float], duration_s: Sequence[float], half_life_s: float
) -> Float[Tensor, " m"]:
    """Mean activity while each view is measured, relative to that at time zero, without unit:
    exp(-k t) (1 - exp(-k T)) / (k T) with k = ln 2 / half-life.

    Args:
        start_s: time t at which each view begins, in seconds.
        duration_s: how long T each view takes, in seconds.
        half_life_s: of the isotope; 99mTc: 21624 s.

    Raises:
        ValueError: a half-life or durations that are not positive, or lists of two lengths.
    """
    if not half_life_s > 0 or len(start_s) != len(duration_s) or not min(duration_s) > 0:
        raise ValueError(
            f"Expected a positive half-life, and for each view a start and a positive duration in "
            f"s, got {half_life_s}, {len(start_s)} starts and durations {list(duration_s)}"
        )
    start, duration = (torch.tensor(list(t), dtype=torch.float64) for t in (start_s, duration_s))
    rate = math.log(2) / half_life_s
    return torch.exp(-rate * start) * -torch.expm1(-rate * duration) / (rate * duration)


def decaying(A: LinearOperator, factors: Float[Tensor, " m"]) -> Scaled:
    """The operator of counts whose views see a decayed activity, volumes at time zero to counts.

    Convention: decay is in the operator, never in the counts, which would no longer be Poisson
    numbers.

    Args:
        A: of the activity at time zero.
        factors: of each view, as by `decay_factors`.

    Raises:
        ValueError: not one factor for each view.
    """
    if factors.shape != A.range_shape[:1]:
        raise ValueError(
            f"Expected a factor for each of {A.range_shape[0]} views, got {tuple(factors.shape)}"
        )
    return Scaled(A, pixels=factors[:, None, None])
