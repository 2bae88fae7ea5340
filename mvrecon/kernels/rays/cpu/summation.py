"""Arithmetic along a ray: numbers of four volumes side by side, which slabs a ray traverses, and in
which order their terms are added.

Four numbers are written out, so that they travel as one vector: a loop over them would store the
first before it loads the second, which forbids the compiler to join them.

A sum is kept in eight parts, as many as a brick has slabs, each of every eighth slab of the volume.
A term that is zero may then be left out or taken along: the parts, and so the sum, stay the same to
the last bit, however the compiler vectorises the terms themselves.
"""

import numpy as np

from mvrecon.kernels.compiling import ordered, scalar
from mvrecon.kernels.rays.lines import SIDDON
from mvrecon.kernels.rays.occupancy import EDGE

#: Volumes that may lie side by side.
LANES = 4
#: What single precision may move a ray by against its course in double precision, in voxels.
SLACK = 1e-3


@scalar
def take(values, k):
    """The four numbers at k."""
    return values[k], values[k + np.uint64(1)], values[k + np.uint64(2)], values[k + np.uint64(3)]


@scalar
def put(values, k, four):
    """Write four numbers at k."""
    values[k], values[k + np.uint64(1)], values[k + np.uint64(2)], values[k + np.uint64(3)] = four


@ordered
def blend(low, high, share, rest):
    """The part `rest` = 1 - share of `low` and the part `share` of `high`, as the transpose gives
    them back.

    low + share * (high - low) is one product less, but rounds to the digits of the greater of the
    two: next to a `low` with hardly any weight a `high` of zero would get none of the digits that
    the transpose has. In another order a compiler makes the one of the other.
    """
    return rest * low + share * high


@scalar
def mix(low, high, share, rest):
    """`blend` of each."""
    return (
        blend(low[0], high[0], share, rest),
        blend(low[1], high[1], share, rest),
        blend(low[2], high[2], share, rest),
        blend(low[3], high[3], share, rest),
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


@ordered
def fold(terms, lead, count):
    """The sum of terms[lead : lead + count], a term at k being part of the sum k % 8; it writes
    zeros around them.
    """
    none = terms.dtype.type(0)
    blocks = (lead + count + EDGE - 1) // EDGE
    for k in range(lead):
        terms[k] = none
    for k in range(lead + count, blocks * EDGE):
        terms[k] = none
    a = b = c = d = e = f = g = h = none
    for block in range(np.uint32(blocks)):
        k = np.uint64(block) * np.uint64(EDGE)
        a += terms[k]
        b += terms[k + np.uint64(1)]
        c += terms[k + np.uint64(2)]
        d += terms[k + np.uint64(3)]
        e += terms[k + np.uint64(4)]
        f += terms[k + np.uint64(5)]
        g += terms[k + np.uint64(6)]
        h += terms[k + np.uint64(7)]
    return ((a + e) + (c + g)) + ((b + f) + (d + h))


@scalar
def bricks_between(low, high, size):
    """The first and the last brick that hold the voxels from low to high, as far as there are
    any.
    """
    first = min(max(int(np.floor(low - SLACK)), 0), size - 1)
    last = min(max(int(np.floor(high + SLACK)), 0), size - 1)
    return first // EDGE, last // EDGE


@scalar
def empty(rig, ray, low, high):
    """Whether all cells that a ray meets in the slabs [low, high) of one layer of bricks lie in
    empty bricks.
    """
    # places of lower corners, without their padding; siddon's cells are met from face to face
    more, half = (0.5, 0.5) if rig.method == SIDDON else (0.0, 0.0)
    s0, s1 = low - ray.centre - half, high - 1 - ray.centre + half
    y0, y1 = ray.b - 1 + more + s0 * ray.slope_b, ray.b - 1 + more + s1 * ray.slope_b
    z0, z1 = ray.c - 1 + more + s0 * ray.slope_c, ray.c - 1 + more + s1 * ray.slope_c
    first_b, last_b = bricks_between(min(y0, y1), max(y0, y1), rig.sizes[ray.far])
    first_c, last_c = bricks_between(min(z0, z1), max(z0, z1), rig.sizes[ray.near])
    base = low // EDGE * rig.strides[ray.axis]
    for i in range(first_b, last_b + 1):
        for j in range(first_c, last_c + 1):
            if rig.bricks[base + i * rig.strides[ray.far] + j * rig.strides[ray.near]]:
                return False
    return True


@scalar
def traverse(rig, ray, span, scratch):
    """Write the places of the slabs in span = (first, last) that are not known to be empty into
    scratch.four.

    Returns:
        how many there are; where their terms begin, see `fold`.
    """
    slab = scratch.four
    real, whole = slab.dtype.type, scratch.index.dtype.type
    if not len(rig.bricks):
        start, count = real(span[0] - ray.centre), np.uint32(max(0, span[1] - span[0]))
        for i in range(count):
            slab[i] = real(whole(i)) + start
        return count, np.uint32(span[0] % EDGE)
    count, lead = np.uint32(0), np.uint32(0)
    low = span[0]
    while low < span[1]:
        high = min(span[1], low // EDGE * EDGE + EDGE)
        if not empty(rig, ray, low, high):
            lead = np.uint32(low % EDGE) if count == 0 else lead
            for k in range(low, high):
                slab[count] = real(k - ray.centre)
                count += np.uint32(1)
        low = high
    return count, lead
