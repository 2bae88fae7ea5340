"""Splitting and validation of counts."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def check_counts(counts: Tensor, what: str = "counts") -> None:
    """Check that counts, or other values (`what`), are valid.

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
    """Split a measurement into shorter ones by binomial thinning: every count is assigned to a part
    at random.

    Parts of Poisson counts are independent Poisson counts with these fractions of the mean; for
    shares that sum to 1 they sum to the counts. Halves are two measurements of the same object.

    Args:
        counts: integer counts.
        shares: fraction of each part; their sum is at most 1.
        rng: random number generator.

    Raises:
        ValueError: shares that are negative or sum to more than 1, or counts that are negative, not
            finite or not integer.
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
