"""Combinations of options: a covering array in place of the full product."""

import itertools
from collections.abc import Iterable

import pytest

Row = tuple[int, ...]


def covering_array(sizes: Iterable[int], shift: int = 0) -> list[Row]:
    """Rows of indices into options with these numbers of values.

    Of three options or more, every pair of values of two options occurs in a row. Of one or two,
    every value occurs: the longer option's once, with the values of the shorter one in turn, from
    `shift` on. Tests of several laws on the same two options cover their pairs by different shifts.

    Greedy: each row is the first that covers the most missing pairs (Cohen et al., The AETG system,
    IEEE Trans. Softw. Eng. 1997).
    """
    sizes = tuple(sizes)
    if len(sizes) < 3:
        longer = sizes.index(max(sizes))
        return [
            tuple((k if i == longer else k + shift) % size for i, size in enumerate(sizes))
            for k in range(max(sizes))
        ]
    every = list(itertools.product(*map(range, sizes)))
    missing, rows = set().union(*map(_pairs, every)), []
    while missing:
        rows.append(max(every, key=lambda row: len(_pairs(row) & missing)))
        missing -= _pairs(rows[-1])
    return rows


def _pairs(row: Row) -> set[tuple[tuple[int, int], ...]]:
    return set(itertools.combinations(enumerate(row), 2))


def takes_long(config: pytest.Config) -> bool:
    """Whether tests marked as long are asked for."""
    return config.option.markexpr not in ("not long", "fast")
