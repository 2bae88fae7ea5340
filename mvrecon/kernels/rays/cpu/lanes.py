"""Four numbers side by side, one of each of four volumes: written out, so that they travel as one
vector.

A loop over them would store the first before it loads the second, which forbids the compiler to
join them.
"""

import numpy as np

from mvrecon.kernels.compiling import ordered, scalar

LANES = 4


@scalar
def take(values, k):
    """The four numbers at k."""
    return values[k], values[k + np.uint64(1)], values[k + np.uint64(2)], values[k + np.uint64(3)]


@scalar
def put(values, k, four):
    """Write four numbers at k."""
    values[k], values[k + np.uint64(1)], values[k + np.uint64(2)], values[k + np.uint64(3)] = four


@ordered
def between(low, high, share, rest):
    """The part `rest` = 1 - share of `low` and the part `share` of `high`, as the transpose gives
    them back.

    low + share * (high - low) is one product less, but rounds to the digits of the greater of the
    two: next to a `low` with hardly any weight a `high` of zero would get none of the digits that
    the transpose has. In another order a compiler makes the one of the other.
    """
    return rest * low + share * high


@scalar
def mix(low, high, share, rest):
    """`between` of each."""
    return (
        between(low[0], high[0], share, rest),
        between(low[1], high[1], share, rest),
        between(low[2], high[2], share, rest),
        between(low[3], high[3], share, rest),
    )


@scalar
def times(weight, four):
    """weight * four."""
    return weight * four[0], weight * four[1], weight * four[2], weight * four[3]


@ordered
def plus(four, other):
    """four + other, in this order: the sum of a ray must not depend on how many of its terms are
    zero.
    """
    return four[0] + other[0], four[1] + other[1], four[2] + other[2], four[3] + other[3]


@scalar
def more(four, weight, other):
    """four + weight * other."""
    return (
        four[0] + weight * other[0],
        four[1] + weight * other[1],
        four[2] + weight * other[2],
        four[3] + weight * other[3],
    )
