"""Counts in parts, and their check."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def check_counts(counts: Tensor, what: str = "counts") -> None:
    """Check that counts, or other values (`what`), are possible.

    Raises:
        ValueError: values that are negative or not finite.
    """
    bad = int((~(counts >= 0) | ~counts.isfinite()).sum())
    if bad:
        raise ValueError(
            f"Expected {what} that are finite and not negative, got {bad} of {counts.numel()} that "
            f"are not"
        )


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
