"""Looking for what is not zero in volumes."""

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from mvrecon.geometry.box import Box, bricks_along, three
from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.occupancy import EDGE
from mvrecon.kernels.threads import share

#: Bricks along an axis that are looked at to guess how many are empty.
SOME = 6


def readable(volumes: Tensor) -> np.ndarray:
    """Volumes in which what is zero is zero; halves as the integers that their bits are, so that -0
    counts as there.
    """
    volumes = volumes.detach().cpu()
    return (volumes.view(torch.int16) if volumes.element_size() == 2 else volumes).numpy()


def box_of(volumes: np.ndarray) -> Box:
    """The least box with every voxel of volumes [n d h w] that is not zero; NaN is not.

    It comes from outside, from both sides at once, so that a full volume costs next to nothing.
    """
    low, high = np.zeros(3, np.int64), np.array(volumes.shape[1:], np.int64)
    for axis in range(3):
        ends = np.zeros(2, np.int64)

        def find(first: int, last: int, axis: int = axis, ends: np.ndarray = ends) -> None:
            for side in range(first, last):
                ends[side] = inward(volumes, axis, side, low, high)

        share(find, 2, volumes.size)
        low[axis], high[axis] = ends
        if low[axis] >= high[axis]:
            return Box((0, 0, 0), (0, 0, 0))
    return Box(three(low), three(high))


@compiled
def inward(volumes, axis, side, low, high):
    """The bound of a box along an axis, moved inwards until its face holds something; side 0: the
    lower one.
    """
    for step in range(high[axis] - low[axis]):
        place = high[axis] - 1 - step if side else low[axis] + step
        if _face_holds(volumes, axis, place, low, high):
            return place + side
    return low[axis] if side else high[axis]


@compiled
def _face_holds(volumes, axis, place, low, high):
    z0, z1 = (place, place + 1) if axis == 0 else (low[0], high[0])
    y0, y1 = (place, place + 1) if axis == 1 else (low[1], high[1])
    x0, x1 = (place, place + 1) if axis == 2 else (low[2], high[2])
    for n in range(len(volumes)):
        for z in range(z0, z1):
            for y in range(y0, y1):
                nonzero = 0
                for x in range(x0, x1):
                    nonzero |= np.int64(volumes[n, z, y, x] != 0)
                if nonzero:
                    return True
    return False


@compiled
def mark(volumes, low, high, bricks):
    """Set the bricks [z y x] that hold a voxel of the box that is not zero, or have one just behind
    their last ones.
    """
    for n in range(len(volumes)):
        for z in range(low[0], high[0]):
            for y in range(low[1], high[1]):
                for i in range(max(0, low[2] - 1) // EDGE, (high[2] - 1) // EDGE + 1):
                    nonzero = 0
                    for x in range(max(low[2], i * EDGE), min(high[2], i * EDGE + EDGE + 1)):
                        nonzero |= np.int64(volumes[n, z, y, x] != 0)
                    if nonzero:
                        k, j = z // EDGE, y // EDGE
                        for before_z in range(k - int(z % EDGE == 0 and z > 0), k + 1):
                            for before_y in range(j - int(y % EDGE == 0 and y > 0), j + 1):
                                bricks[before_z, before_y, i] = 1


def empty_share(volumes: np.ndarray, box: Box) -> float:
    """The share of bricks in a box that hold nothing, of at most a few hundred of them."""
    counts = np.zeros(2, np.int64)
    look(volumes, np.array(box.low), np.array(box.high), counts)
    return counts[0] / max(1, counts[1])


@compiled
def look(volumes, low, high, counts):
    """Count some of the bricks in a box: how many are empty, and how many there are."""
    steps = (_stride(low[0], high[0]), _stride(low[1], high[1]), _stride(low[2], high[2]))
    for z in range(low[0] - low[0] % EDGE, high[0], steps[0]):
        for y in range(low[1] - low[1] % EDGE, high[1], steps[1]):
            for x in range(low[2] - low[2] % EDGE, high[2], steps[2]):
                counts[0] += not _brick_holds(volumes, z, y, x)
                counts[1] += 1


@scalar
def _stride(low, high):
    return EDGE * max(1, (high - low) // EDGE // SOME)


@compiled
def _brick_holds(volumes, z0, y0, x0):
    count, depth, height, width = volumes.shape
    for n in range(count):
        for z in range(z0, min(z0 + EDGE, depth)):
            for y in range(y0, min(y0 + EDGE, height)):
                for x in range(x0, min(x0 + EDGE, width)):
                    if volumes[n, z, y, x] != 0:
                        return True
    return False


def bricks_of(volumes: np.ndarray, box: Box) -> UInt8[np.ndarray, "z y x"]:
    """The bricks of volumes [n d h w] as an `Occupancy` has them, where all that is not zero lies
    in a box.
    """
    bricks = np.zeros(bricks_along(volumes.shape[1:], EDGE), np.uint8)
    if box.size:
        mark(volumes, np.array(box.low), np.array(box.high), bricks)
    return bricks
