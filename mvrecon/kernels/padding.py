"""Volumes and views with a border of nothing, flat, so that no compiled loop tests a bound."""

import math
from collections import namedtuple
from collections.abc import Sequence

import numpy as np

#: Samples of nothing before and behind along every axis: a cell that just misses, and one more for
#: rounding.
PAD = (1, 2)
#: What lies inside the border, along one axis.
INNER = slice(PAD[0], -PAD[1])
#: What a thread works in, since compiled loops make no arrays: per position of a row a flat index
#: and three weights; and what it gathers for itself.
Room = namedtuple("Room", ["at", "weight", "own"])


def padded_shape(shape: Sequence[int]) -> list[int]:
    """The sizes with their border."""
    return [int(size) + sum(PAD) for size in shape]


def steps(shape: Sequence[int]) -> np.ndarray:
    """Flat steps of the padded array along (x, y, ..), as 32-bit integers where they do."""
    sizes = padded_shape(shape)
    kind = np.int64 if math.prod(sizes) >= 2**31 else np.int32
    return np.array(
        [math.prod(sizes[axis + 1 :]) for axis in reversed(range(len(sizes)))], dtype=kind
    )


def padded(values: np.ndarray, axes: int) -> np.ndarray:
    """The last axes with their border, made one."""
    lead, shape = values.shape[:-axes], padded_shape(values.shape[-axes:])
    wide = np.zeros((*lead, *shape), dtype=values.dtype)
    wide[(..., *[INNER] * axes)] = values
    return wide.reshape(*lead, math.prod(shape))


def room(count: int, steps: np.ndarray, dtype: np.dtype, own: Sequence[int] = (0,)) -> Room:
    """Room for rows of `count`, and zeros of the shape `own`."""
    return Room(np.empty(count, steps.dtype), np.empty((3, count), dtype), np.zeros(own, dtype))
