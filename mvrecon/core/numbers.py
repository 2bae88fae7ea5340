"""Random numbers that depend on seed and case only, the noise of neighbouring pixels, division with
zero divisors, and the check of a data range."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Real
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

#: Standard deviations of a normal distribution in its median absolute deviation.
SIGMA_PER_MEDIAN = 1.4826


def generator(seed: int, index: int) -> torch.Generator:
    """Return the random generator of one case.

    Torch's CPU generator has 32 bits of seed: here the murmur3 finaliser, a bijection, of seed *
    2^32 / phi + index. Distinct indices of a series have distinct streams, as have all series 0 to
    999 below index 10^6.

    Raises:
        ValueError: a negative seed or index.
    """
    if seed < 0 or index < 0:
        raise ValueError(
            f"A case needs a seed and an index of at least 0, got seed {seed}, index {index}"
        )
    return torch.Generator().manual_seed(mixed(seed, index))


@contextmanager
def case_numbers(seed: int, index: int) -> Iterator[None]:
    """Context in which torch's global random numbers are those of one case, so that scenes that use
    them are pure functions, too.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(mixed(seed, index))
        yield


def mixed(seed: int, index: int) -> int:
    """The 32-bit seed of the case `index` of the series `seed`."""
    h = (seed * 0x9E3779B9 + index) & 0xFFFFFFFF
    h = ((h ^ h >> 16) * 0x85EBCA6B) & 0xFFFFFFFF
    h = ((h ^ h >> 13) * 0xC2B2AE35) & 0xFFFFFFFF
    return h ^ h >> 16


def uniform(rng: torch.Generator, low: float, high: float) -> float:
    """A uniform number between two others."""
    return low + (high - low) * torch.rand((), generator=rng, dtype=torch.float64).item()


def data_range_of(value: Any) -> float:
    """The range of a scene's values, by which figures of merit and losses are scaled, as a float.

    Raises:
        TypeError: not a number.
        ValueError: not positive and finite.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"data_range: expected a positive and finite number, got {value!r}")
    try:
        number = float(value)
    except OverflowError:  # a whole number beyond float64
        number = math.inf
    if not 0 < number < math.inf:
        raise ValueError(f"data_range: expected a positive and finite number, got {number}")
    return number


def second_differences(values: Float[Tensor, "*n"], dim: int = -1) -> Float[Tensor, "*k"]:
    """Second differences along an axis, two fewer than values, in which smooth parts vanish; those
    of noise of independent pixels have its variance (Immerkaer, CVIU 64, 1996).
    """
    return values.diff(n=2, dim=dim) / math.sqrt(6)


def divided(
    dividend: Float[Tensor, "*#n"] | float, divisor: Float[Tensor, "*#n"], otherwise: float = 0.0
) -> Float[Tensor, "*n"]:
    """Ratio of two tensors where the divisor is positive, else a constant; its gradient is finite
    in both.
    """
    positive = divisor > 0
    return torch.where(positive, dividend / torch.where(positive, divisor, 1), otherwise)


def positive_mean(values: Float[Tensor, "*n"], otherwise: float) -> float:
    """Mean of the positive values of a tensor, in their unit, or a default without any;
    synchronises with a GPU once.
    """
    positive = values > 0
    mean = (torch.where(positive, values, 0).sum() / positive.sum()).item()
    return otherwise if math.isnan(mean) else mean
