"""Random numbers that depend on the seed and the case alone, and division where the divisor may be
zero.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor


def generator(seed: int, index: int) -> torch.Generator:
    """The random numbers of one case.

    Torch's CPU generator takes 32 bits of seed: here the murmur3 finaliser, a bijection, of seed *
    2^32 / phi + index. No two indices of a series share a stream, nor do any two of the series 0 to
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
    """Context in which torch's global random numbers are those of one case, so that a scene that
    draws from them is a pure function, too.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(mixed(seed, index))
        yield


def mixed(seed: int, index: int) -> int:
    """The 32 bits that seed the case `index` of the series `seed`."""
    h = (seed * 0x9E3779B9 + index) & 0xFFFFFFFF
    h = ((h ^ h >> 16) * 0x85EBCA6B) & 0xFFFFFFFF
    h = ((h ^ h >> 13) * 0xC2B2AE35) & 0xFFFFFFFF
    return h ^ h >> 16


def uniform(rng: torch.Generator, low: float, high: float) -> float:
    """A number uniform between two others."""
    return low + (high - low) * torch.rand((), generator=rng, dtype=torch.float64).item()


def divided(
    dividend: Float[Tensor, "*#n"] | float, divisor: Float[Tensor, "*#n"], otherwise: float = 0.0
) -> Float[Tensor, "*n"]:
    """Ratio of two tensors where the divisor is positive, elsewhere a number; its gradient is
    finite in both.
    """
    positive = divisor > 0
    return torch.where(positive, dividend / torch.where(positive, divisor, 1), otherwise)


def positive_mean(values: Float[Tensor, "*n"], otherwise: float) -> float:
    """Mean of the positive values of a tensor, in their unit, or a number where there are none; a
    GPU is waited for once.
    """
    positive = values > 0
    mean = (torch.where(positive, values, 0).sum() / positive.sum()).item()
    return otherwise if math.isnan(mean) else mean
