"""Covering arrays: every value, every pair, and fewer rows than the product."""

import itertools
import math

import pytest

from tests.covering import covering_array


@pytest.mark.parametrize("sizes", [(3, 3, 3), (15, 4, 2), (2, 2, 2, 2), (6, 5, 4, 3), (1, 1, 1)])
def test_every_pair_of_values_occurs(sizes):
    rows = covering_array(sizes)
    for (i, one), (j, other) in itertools.combinations(enumerate(sizes), 2):
        pairs = {(row[i], row[j]) for row in rows}
        assert pairs == set(itertools.product(range(one), range(other)))
    greatest = math.prod(sorted(sizes)[-2:])
    assert greatest <= len(rows) <= min(math.prod(sizes), 1.5 * greatest + 4)


@pytest.mark.parametrize("sizes", [(15, 4), (4, 15), (3, 3), (7,), (1, 5)])
def test_of_two_options_every_value_occurs_and_shifts_cover_the_product(sizes):
    rows = [covering_array(sizes, shift) for shift in range(min(sizes))]
    for each in rows:
        assert len(each) == max(sizes)
        assert all({row[i] for row in each} == set(range(size)) for i, size in enumerate(sizes))
    assert set(itertools.chain(*rows)) == set(itertools.product(*map(range, sizes)))
