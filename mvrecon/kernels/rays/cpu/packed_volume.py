"""Copies of volumes for the ray loops: one axis contiguous, with adjacent values readable as a
pair.

Each volume is zero-padded by two voxels on each side, so that loops test no bounds: rays are
clipped to cells that touch the volume, from one voxel before it, and rounding may move them into
the cell before that.
"""

import math
from collections import namedtuple
from collections.abc import Sequence

import numpy as np

from mvrecon.kernels.compiling import compiled
from mvrecon.kernels.rows import PAD

#: values [g p l] in one row, of g groups of l volumes; pairs, each value and the next as one
#: complex number in the same memory; p, the voxels of a volume; strides in voxels of the axes (x,
#: y, z); the contiguous axis; l.
Store = namedtuple("Store", ["values", "pairs", "size", "strides", "near", "lanes"])
COMPLEX = {np.dtype(np.float32): np.complex64, np.dtype(np.float64): np.complex128}
#: Zero voxels before the volume along every axis; behind it those of `PAD`.
FRONT = 2
#: Edge in voxels of the tiles of a transposition.
TILE = 16


def empty(
    count: int, sizes: Sequence[int], near: int, lanes: int, dtype: np.dtype, memory=None
) -> np.ndarray:
    """Zero-padded memory for volumes of `sizes` (x, y, z), `lanes` of them adjacent.

    It is [g z y x l] with x as near axis and [g y x z l] with z, in the memory of a given array, if
    any.
    """
    x, y, z = (FRONT + size + PAD[1] for size in sizes)
    shape = (-(-count // lanes), *((z, y, x) if near == 0 else (y, x, z)), lanes)
    if memory is None or memory.size < math.prod(shape):
        return np.zeros(shape, dtype)
    flat = memory.reshape(-1)[: math.prod(shape)]
    flat[:] = 0
    return flat.reshape(shape)


def part_of(padded: np.ndarray, near: int, where: tuple[slice, slice, slice]) -> np.ndarray:
    """The part of padded volumes at `where` along (x, y, z), counted without the padding."""
    x, y, z = (slice(part.start + FRONT, part.stop + FRONT) for part in where)
    return padded[:, z, y, x] if near == 0 else padded[:, y, x, z]


def store_of(volumes: np.ndarray, near: int) -> Store:
    """Padded volumes as a store."""
    values, size, lanes = volumes.reshape(-1), volumes[:1, ..., 0].size, volumes.shape[4]
    pairs = np.ndarray(
        (max(0, values.size - 1),), COMPLEX[values.dtype], values, strides=values.strides
    )
    beside, across = volumes.shape[3], volumes.shape[3] * volumes.shape[2]
    steps = (1, beside, across) if near == 0 else (beside, across, 1)
    return Store(
        values, pairs, size, np.array(steps, np.int64 if size >= 2**31 else np.int32), near, lanes
    )


@compiled
def fill(volumes, near, into, first):
    """Write volumes [n d h w] into those of a store, from row (along y) `first` on."""
    count, depth, height, width = volumes.shape
    lanes = into.shape[4]
    for n in range(count):
        g, lane = n // lanes, n % lanes
        for y in range(height):
            if near == 0:
                for z in range(depth):
                    for x in range(width):
                        into[g, z, first + y, x, lane] = volumes[n, z, y, x]
                continue
            for x0 in range(0, width, TILE):
                for z0 in range(0, depth, TILE):
                    for x in range(x0, min(x0 + TILE, width)):
                        for z in range(z0, min(z0 + TILE, depth)):
                            into[g, first + y, x, z, lane] = volumes[n, z, y, x]


@compiled
def add(padded, near, volumes, first, last):
    """Add rows (along y) first to last of volumes in a store to volumes [n d h w]."""
    count, depth, _, width = volumes.shape
    lanes = padded.shape[4]
    for n in range(count):
        g, lane = n // lanes, n % lanes
        for y in range(first, last):
            if near == 0:
                for z in range(depth):
                    for x in range(width):
                        volumes[n, z, y, x] += padded[g, z, y, x, lane]
                continue
            for x0 in range(0, width, TILE):
                for z0 in range(0, depth, TILE):
                    for z in range(z0, min(z0 + TILE, depth)):
                        for x in range(x0, min(x0 + TILE, width)):
                            volumes[n, z, y, x] += padded[g, y, x, z, lane]
