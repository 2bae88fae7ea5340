"""Interfile projections (.hs) as measured views, read one by one."""

from pathlib import Path

import numpy as np

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon_spect.files.interfile import numbers_of, read_header
from mvrecon_spect.files.stir import views_shape


class InterfileViews(ProjectionStack):
    """Counts of Interfile projections in STIR's order: rows along the axis, columns perpendicular
    to it.

    Args:
        path: path of the header, .hs.

    Raises:
        FileNotFoundError: the header or the data file does not exist.
        Refused: missing keys, a size that does not match the file; or, when read, counts that are
            negative or not finite.
    """

    kind = "counts"
    unit = "spect of activity"
    dose = 1.0
    own_unit = True

    def __init__(self, path: Path):
        header = read_header(path, "projections")
        views, rows, columns = views_shape(header)
        self._numbers = numbers_of(header, (views, rows, columns))
        names = [f"{path.stem} {k}" for k in range(views)]
        low, high = (header.number(f"energy window {end} level", 0.0) for end in ("lower", "upper"))
        self.window_kev = (low, high) if high > low > 0 else None
        seconds = header.number("image duration (sec)", 0.0)
        self.total_s = seconds if seconds > 0 else None  # 0 and -1: unknown
        super().__init__(path, names, (rows, columns), np.dtype("f4"))

    def _block(self, first: int, last: int) -> np.ndarray:
        counts = self._numbers.read(first, last)
        if not (np.isfinite(counts) & (counts >= 0)).all():
            raise Refused(
                f"{self.path}: expected counts, finite and not negative, got {counts.min():g} in "
                f"views {first} to {last - 1}"
            )
        return counts
