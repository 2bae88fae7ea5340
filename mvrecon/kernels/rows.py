"""One row of an output lattice in a source lattice: its entry and exit, and bilinear values on
padded, flat planes, for all voxel-driven kernels.

Numerators and denominators of a row's positions are affine in the index i along it, so the part of
the row inside the source's box is an interval, given by linear inequalities. Sources are
zero-padded and flat, so that later loops test no bounds.
"""

import math
from collections import namedtuple
from collections.abc import Sequence
from math import ceil, floor

import numpy as np

from mvrecon.kernels.compiling import scalar

#: Zero samples before and behind along every axis: a cell just outside, and one more for rounding.
PAD = (1, 2)
#: The interior along one axis.
INNER = slice(PAD[0], -PAD[1])
#: Memory of a thread, as compiled loops allocate nothing: per position of a row a flat index and
#: three weights; and its own accumulator.
Scratch = namedtuple("Scratch", ["at", "weight", "own"])
#: Denominators below are rounding errors: a sample in the plane of the source.
LEAST = 1e-200


def padded_shape(shape: Sequence[int]) -> list[int]:
    """The sizes including padding."""
    return [int(size) + sum(PAD) for size in shape]


def flat_steps(shape: Sequence[int]) -> np.ndarray:
    """Flat steps of the padded array along (x, y, ..), as 32-bit integers if sufficient."""
    sizes = padded_shape(shape)
    kind = np.int64 if math.prod(sizes) >= 2**31 else np.int32
    return np.array(
        [math.prod(sizes[axis + 1 :]) for axis in reversed(range(len(sizes)))], dtype=kind
    )


def padded(values: np.ndarray, axes: int) -> np.ndarray:
    """Pad and flatten the last axes."""
    lead, shape = values.shape[:-axes], padded_shape(values.shape[-axes:])
    whole = np.zeros((*lead, *shape), dtype=values.dtype)
    whole[(..., *[INNER] * axes)] = values
    return whole.reshape(*lead, math.prod(shape))


def row_scratch(
    count: int, steps: np.ndarray, dtype: np.dtype, own: Sequence[int] = (0,)
) -> Scratch:
    """Memory for rows of `count`, and zeros of the shape `own`."""
    return Scratch(np.empty(count, steps.dtype), np.empty((3, count), dtype), np.zeros(own, dtype))


@scalar
def affine(line, j, k):
    """Value and slope along i of a bilinear map [2 3] on the row (j, k), all counted from the
    lattice's centre.
    """
    slope = line[0, 0] + k * line[1, 0]
    return (line[0, 1] + k * line[1, 1]) * j + (line[0, 2] + k * line[1, 2]), slope


@scalar
def positive(value, slope, lower, upper):
    """The part of (lower, upper) in which value + i slope > 0."""
    if slope > 0:
        return max(lower, -value / slope), upper
    if slope < 0:
        return lower, min(upper, -value / slope)
    return (lower, upper) if value > 0 else (0.0, -1.0)


@scalar
def between(top, under, low, high, part):
    """The part of an interval in which low < top / under < high, where under > 0."""
    lower, upper = positive(top[0] - low * under[0], top[1] - low * under[1], part[0], part[1])
    return positive(high * under[0] - top[0], high * under[1] - top[1], lower, upper)


@scalar
def whole(part, half, count):
    """The half-open range of positions of a row of `count`, centred at `half`, in an interval."""
    if part[0] > part[1]:
        return 0, 0
    return max(0, int(ceil(part[0] + half))), min(count, int(floor(part[1] + half)) + 1)


@scalar
def near(row, top, under, size, low, high, part):
    """The part of a row that can touch the lines [low, high) of `size` along an axis of the source,
    with a margin of half a line for rounding.
    """
    centre = (size - 1) / 2
    ends = (-row.half, row.half)
    interval = between(top, under, low - 1.5 - centre, high + 0.5 - centre, ends)
    first, last = whole(interval, row.half, row.count)
    return max(part[0], first), min(part[1], last)


@scalar
def over(under, i):
    """One over a denominator at position i."""
    return 1.0 / max(under[0] + i * under[1], LEAST)


@scalar
def cell(top, inverse, i, border, size):
    """The padded coordinate of a sample along one axis, clamped to the padding against rounding."""
    return min(max((top[0] + i * top[1]) * inverse + border, 0.0), size + 1.0)


@scalar
def face(flat, across):
    """Views of a plane from the four corners of its cells, for a common index."""
    return flat, flat[1:], flat[across:], flat[across + 1 :]


@scalar
def bilinear(face, k, x, y):
    """The value in cell k."""
    near, far = (
        face[0][k] + x * (face[1][k] - face[0][k]),
        face[2][k] + x * (face[3][k] - face[2][k]),
    )
    return near + y * (far - near)


@scalar
def lay(face, k, x, y, value):
    """Add a value to the corners of cell k with the weights of `bilinear`."""
    far = y * value
    near = value - far
    near_x, far_x = x * near, x * far
    face[0][k] += near - near_x
    face[1][k] += near_x
    face[2][k] += far - far_x
    face[3][k] += far_x
