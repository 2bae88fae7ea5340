"""The non-zero part of a volume: a box, and optionally bricks of eight voxels a side.

It passes through torch's operators encoded as a small integer tensor.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mvrecon.geometry.grid import Box, Three, bricks_along

#: Voxels along the edge of a brick.
EDGE = 8
#: Reach of a voxel's value from its centre, in voxels, with a margin for rounding.
REACH = 1.01
#: Numbers before the bricks in an occupancy's code, and the code of a share of one.
HEAD, WHOLE = 12, 10**6


@dataclass(frozen=True, eq=False)
class Occupancy:
    """The part of a volume that may differ from zero.

    Args:
        shape: voxels of the whole volume along (z, y, x).
        box: all is zero outside.
        bricks: bricks with a non-zero voxel inside or just behind; None: any.
        shares: remaining shares of the work with the box, and with bricks, estimated from some
            rays; NaN if not estimated.
    """

    shape: Three
    box: Box
    bricks: UInt8[np.ndarray, "z y x"] | None = None
    shares: tuple[float, float] = (float("nan"), float("nan"))

    @classmethod
    def whole(cls, shape: Sequence[int]) -> "Occupancy":
        """The whole volume."""
        box = Box.whole(shape)
        return cls(box.high, box)

    @classmethod
    def of(cls, shape: Sequence[int], code: "Tensor | Occupancy | None") -> "Occupancy":
        """The position of volumes of `shape` in the whole: an occupancy, or its code; None: the
        whole.
        """
        if code is None:
            return cls.whole(shape)
        return code if isinstance(code, Occupancy) else cls.decoded(code)

    @property
    def read(self) -> Box:
        """The box to which rays are clipped: a voxel larger than the occupied one, for rounding."""
        return self.box.grown(1, self.shape)

    def rows(self, low: int, high: int) -> "Occupancy":
        """The occupancy of the rows (along y) from `low`, a multiple of a brick's edge, to `high`,
        exclusive.
        """
        if (low, high) == (0, self.shape[1]):
            return self
        y0, y1 = (min(max(y - low, 0), high - low) for y in (self.box.low[1], self.box.high[1]))
        box = Box((self.box.low[0], y0, self.box.low[2]), (self.box.high[0], y1, self.box.high[2]))
        bricks = None if self.bricks is None else self.bricks[:, low // EDGE : -(-high // EDGE)]
        return replace(
            self, shape=(self.shape[0], high - low, self.shape[2]), box=box, bricks=bricks
        )

    def encoded(self) -> Tensor:
        """Encode as integers: shape, box, shares, whether there are bricks, bricks."""
        code = np.zeros(code_size(self.shape), np.int32)
        shares = [-1 if share != share else round(share * WHOLE) for share in self.shares]
        code[:HEAD] = *self.shape, *self.box.low, *self.box.high, *shares, self.bricks is not None
        if self.bricks is not None:
            code[HEAD:] = self.bricks.reshape(-1)
        return torch.from_numpy(code)

    @classmethod
    def decoded(cls, code: Tensor) -> "Occupancy":
        """The inverse of `encoded`; synchronises for a code on a GPU."""
        return cls._of(code.cpu().numpy())

    @classmethod
    def unwrapped(cls, code: Tensor) -> "Occupancy":
        """`decoded`, slower, for codes that `torch.func` may have wrapped, whose memory is
        inaccessible.
        """
        return cls._of(np.array(code.tolist()))

    @classmethod
    def _of(cls, numbers: np.ndarray) -> "Occupancy":
        d, h, w, z0, y0, x0, z1, y1, x1, one, two, by_bricks = numbers[:HEAD].tolist()
        bricks = (
            numbers[HEAD:].astype(np.uint8).reshape(bricks_along((d, h, w), EDGE))
            if by_bricks
            else None
        )
        shares = (
            one / WHOLE if one >= 0 else float("nan"),
            two / WHOLE if two >= 0 else float("nan"),
        )
        return cls((d, h, w), Box((z0, y0, x0), (z1, y1, x1)), bricks, shares)


def code_size(shape: Sequence[int]) -> int:
    """Number of integers in the code of a volume of `shape`."""
    return HEAD + math.prod(bricks_along(shape, EDGE))


def bricks_of_rig(occupancy: Occupancy) -> tuple[np.ndarray, Three, np.ndarray]:
    """The bricks in one row, their strides (x, y, z), and the occupied range along z of each column
    [y x 2] of them.

    All empty without bricks.
    """
    if occupancy.bricks is None:
        return np.zeros(0, np.uint8), (0, 0, 0), np.zeros((0, 0, 2), np.int32)
    bricks = np.ascontiguousarray(occupancy.bricks)
    layers, rows, columns = bricks.shape
    filled = bricks.max(axis=0)
    first, last = bricks.argmax(axis=0), layers - 1 - bricks[::-1].argmax(axis=0)
    # a brick counts for the voxel just behind it
    heights = np.stack([first * EDGE, last * EDGE + EDGE + 1], axis=-1) * filled[..., None]
    return bricks.reshape(-1), (1, columns, columns * rows), heights.astype(np.int32)


def boxes_of(occupancy: Occupancy) -> Float[np.ndarray, "n 6"] | None:
    """Boxes (x0, y0, z0, x1, y1, z1), in voxels from the volume's centre, that contain everything
    that rays can meet.

    None: the box is the whole volume.
    """
    if occupancy.bricks is None and occupancy.box == Box.whole(occupancy.shape):
        return None
    low, high = np.array([occupancy.box.low]), np.array([occupancy.box.high]) - 1
    if occupancy.bricks is not None:
        first = np.argwhere(occupancy.bricks) * EDGE
        low, high = np.maximum(first, low), np.minimum(first + EDGE, high)
    centre = (np.array(occupancy.shape) - 1) / 2
    bounds = [(low - centre - REACH)[:, ::-1], (high - centre + REACH)[:, ::-1]]
    # in one memory order, so that kernels are compiled once
    return np.ascontiguousarray(np.concatenate(bounds, axis=1))
