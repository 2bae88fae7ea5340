"""A stack of projections on disk, of which only the views that are asked for are in memory."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, file_errors
from mvrecon.core.machine import check_memory

#: Views that a stack may have.
VIEWS = 2**16
#: Pixels that are read at once where a whole stack is gone through, 64 MiB in float32.
PIXELS = 2**24


class ProjectionStack(ABC):
    """Projections of one size on disk, in grey values or line integrals as they are stored.

    Args:
        path: of the file or folder, for messages.
        names: of the views, in their order.
        shape: rows and columns of a view.
        dtype: of the pixels as they are stored.

    Raises:
        Refused: no view or too many, or pixels that are not integers or floats.
    """

    #: What the pixels are where the format says it: "integrals" (or counts) or "intensities".
    kind: Literal["integrals", "intensities"] | None = None
    #: Unit of the pixels where the file says it, as `mvrecon-simulate` does.
    unit: str | None = None
    #: From a pixel's index (u, v, view) to the file's (x, y, z) in mm, where the file states it.
    affine: np.ndarray | None = None

    def __init__(
        self,
        path: str | Path,
        names: Sequence[str],
        shape: tuple[int, int],
        dtype: np.dtype,
    ):
        self.path, self.names, self.dtype = Path(path), tuple(names), np.dtype(dtype)
        self.shape = (int(shape[0]), int(shape[1]))
        if not 0 < len(self.names) <= VIEWS or min(self.shape) < 1:
            got = f"{len(self.names)} views of {self.shape[0]} x {self.shape[1]} pixels"
            raise Refused(f"{path}: expected 1 to {VIEWS} views with pixels, got {got}")
        if self.dtype.kind not in "iuf":
            raise Refused(f"{path}: expected pixels that are integers or floats, got {self.dtype}")

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.names)

    @property
    def top(self) -> float | None:
        """Greatest grey value of the pixels' integer type; none for floats."""
        return None if self.dtype.kind == "f" else float(np.iinfo(self.dtype).max)

    @abstractmethod
    def _block(self, first: int, last: int) -> np.ndarray:
        """Views `first` to `last - 1` [m v u] as they are stored."""

    def read(self, first: int, last: int) -> Float[Tensor, "m v u"]:
        """Views from disk, float32, in the unit they are stored in: `first` to `last - 1`.

        Raises:
            IndexError: there are no such views.
            Refused: they cannot be read, or have values that are not finite.
        """
        if not 0 <= first < last <= self.n_views:
            raise IndexError(
                f"{self.path}: expected views within 0 to {self.n_views}, got {first} to {last}"
            )
        rows, columns = self.shape
        check_memory(8 * (last - first) * rows * columns, f"{last - first} views of {self.path}")
        with file_errors(self.path, f"views {first} to {last - 1} cannot be read"):
            values = torch.from_numpy(self._block(first, last).astype(np.float32))
            if tuple(values.shape) != (last - first, rows, columns):
                raise Refused(
                    f"{self.path}: expected views {first} to {last - 1} of {rows} x {columns} "
                    f"pixels, got {tuple(values.shape)}"
                )
        bad = (~values.isfinite()).sum(dim=(1, 2))
        if bad.any():
            view = int(bad.argmax())
            raise Refused(
                f"{self.path}: expected finite pixels, got {int(bad[view])} that are NaN or "
                f"infinite in view {first + view} ({self.names[first + view]})"
            )
        return values

    def chunks(self, pixels: int = PIXELS) -> Iterator[Float[Tensor, "m v u"]]:
        """All views in order, as many at a time as have a number of pixels (one at least)."""
        step = max(1, pixels // (self.shape[0] * self.shape[1]))
        for first in range(0, self.n_views, step):
            yield self.read(first, min(first + step, self.n_views))

    def mean(self) -> Float[Tensor, "v u"]:
        """Mean of all views, float32, in the unit they are stored in; memory of a few views."""
        total = torch.zeros(self.shape, dtype=torch.float64)
        for block in self.chunks():
            total += block.sum(dim=0, dtype=torch.float64)
        return (total / self.n_views).float()
