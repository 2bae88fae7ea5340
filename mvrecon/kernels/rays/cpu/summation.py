"""Which slabs a ray visits, and in which order their terms are added.

A sum is kept in eight parts, as many as a brick has slabs, each of every eighth slab of the volume.
A term that is zero may then be left out or taken along: the parts, and so the sum, stay the same to
the last bit, however the compiler vectorises the terms themselves.
"""

import numpy as np

from mvrecon.kernels.compiling import ordered, scalar
from mvrecon.kernels.rays.occupancy import EDGE
from mvrecon.kernels.rays.trace import SIDDON

#: What single precision may move a ray by against its course in double precision, in voxels.
SLACK = 1e-3


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
def visit(rig, ray, span, room):
    """Write the places of the slabs in span = (first, last) that are not known to be empty into
    room.four.

    Returns:
        how many there are; where their terms begin, see `fold`.
    """
    slab = room.four
    real, whole = slab.dtype.type, room.index.dtype.type
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
