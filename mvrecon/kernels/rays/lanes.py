"""Four numbers side by side, one of each of four volumes: written out, so that they travel as one vector.

A loop over them would store the first before it loads the second, which forbids the compiler to join them.
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


@scalar
def mix(low, high, share):
    """From `low` the part `share` of the way to `high`."""
    return (
        low[0] + share * (high[0] - low[0]),
        low[1] + share * (high[1] - low[1]),
        low[2] + share * (high[2] - low[2]),
        low[3] + share * (high[3] - low[3]),
    )


@scalar
def times(weight, four):
    """weight * four."""
    return weight * four[0], weight * four[1], weight * four[2], weight * four[3]


@ordered
def plus(four, other):
    """four + other, in this order: the sum of a ray must not depend on how many of its terms are zero."""
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
