"""The part of a detector that is used, and the pixels of it that are joined: for views and cameras
alike.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import shown
from mvrecon.geometry.cameras.camera import Cameras


class Region:
    """Rows and columns of a detector that are kept, and how many of them make one new pixel.

    Args:
        detector: rows and columns of the whole detector.
        rows: first row, and the one behind the last; None: all.
        columns: first column, and the one behind the last; None: all.
        binning: rows and columns that are joined into one pixel, one number or two.

    Raises:
        ValueError: rows or columns outside of the detector, or a binning that does not divide what
            is kept.
    """

    def __init__(
        self,
        detector: tuple[int, int],
        rows: Sequence[int] | None = None,
        columns: Sequence[int] | None = None,
        binning: int | Sequence[int] = 1,
    ):
        pair = (binning, binning) if isinstance(binning, int) else tuple(binning)
        kept = [
            (0, count) if ends is None else tuple(ends)
            for ends, count in zip((rows, columns), detector, strict=True)
        ]
        for name, part, count in zip(("rows", "columns"), kept, detector, strict=True):
            whole = len(part) == 2 and all(type(n) is int for n in part)
            if not (whole and 0 <= part[0] < part[1] <= count):
                raise ValueError(
                    f"Expected {name} as [first, behind the last] within 0 to {count}, got "
                    f"{shown(list(part))}"
                )
        sizes = [last - first for first, last in kept]
        if len(pair) != 2 or any(type(n) is not int or n < 1 for n in pair):
            raise ValueError(f"Expected a binning of one or two positive integers, got {binning!r}")
        if any(size % n for size, n in zip(sizes, pair, strict=True)):
            raise ValueError(
                f"Expected a binning that divides the {sizes[0]} rows and {sizes[1]} columns, got "
                f"{pair}; rows=[first, last] and columns=[first, last] leave some out"
            )
        self.detector, self.binning = detector, (pair[0], pair[1])
        self.rows, self.columns = ((first, last) for first, last in kept)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a view after it."""
        (top, bottom), (left, right) = self.rows, self.columns
        return (bottom - top) // self.binning[0], (right - left) // self.binning[1]

    def cropped(self, values: Tensor) -> Tensor:
        """The kept rows and columns of pixels [... v u]."""
        return values[..., slice(*self.rows), slice(*self.columns)]

    def binned(self, values: Float[Tensor, "m v u"]) -> Float[Tensor, "m i j"]:
        """Means over the pixels that are joined, of pixels that have been cropped."""
        if self.binning == (1, 1):
            return values
        return F.avg_pool2d(values[:, None], self.binning)[:, 0]

    def all_binned(self, mask: Bool[Tensor, "m v u"]) -> Bool[Tensor, "m i j"]:
        """Whether all of the pixels that are joined are true, of a mask that has been cropped."""
        if self.binning == (1, 1):
            return mask
        return ~F.max_pool2d((~mask)[:, None].to(torch.float32), self.binning)[:, 0].bool()

    def seen_by(self, cameras: Cameras) -> Cameras:
        """Cameras of the whole detector as cameras of this region: each new pixel is centred where
        the pixels are that it is made of.

        Raises:
            ValueError: cameras of another detector.
        """
        if cameras.shape != self.detector:
            raise ValueError(
                f"Expected cameras whose detector is that of the views on disk, {self.detector} "
                f"(rows, columns), got {cameras.shape}"
            )
        return cameras.cropped(self.rows, self.columns).binned(self.binning)
