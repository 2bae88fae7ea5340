"""Interfile projections (.hs; SIMIND: .h00, GATE: .hdr) as measured views, read one by one."""

import warnings
from pathlib import Path

import numpy as np
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.turning import MAX_ANGLE, apart, turned
from mvrecon_spect.files.interfile import Header, check_repeated, numbers_of, read_header
from mvrecon_spect.files.stir import views_shape

#: Relative difference of durations in whole seconds.
CLOSE = 0.01


class InterfileViews(ProjectionStack):
    """Counts of Interfile projections in STIR's order: rows along the axis, columns perpendicular
    to it.

    Args:
        path: path of the header.

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
        down, right = (header.number(f"scaling factor (mm/pixel) [{axis}]", 0.0) for axis in (2, 1))
        self.pixel_mm = (down, right) if min(down, right) > 0 else None
        self.duration_s, self.total_s = _durations(header, views)
        self._arc = abs(header.number("extent of rotation", 0.0))
        super().__init__(path, names, (rows, columns), np.dtype("f4"))

    def check_rig(self, cameras: Cameras) -> None:
        """Compare also the turn from view to view with the extent of rotation, which ends at the
        last view or a step behind it. Programs differ in the zero and in the direction of angles.

        Raises:
            Refused: cameras that turn by other equal steps.

        Warns:
            UserWarning: cameras that do not turn by equal steps, as several rings or heads.
        """
        super().check_rig(cameras)
        if self.n_views < 2 or self._arc == 0:
            return
        got, count = turned(cameras, cameras.v.sum(dim=0)), self.n_views  # rows lie along the axis
        known = [self._arc / count, self._arc / (count - 1)]
        stated = got.new_tensor([sign * step for step in known for sign in (1, -1)])
        index = torch.arange(count, dtype=got.dtype, device=got.device)
        if apart(got, stated[:, None] * index).amax(dim=1).min() <= MAX_ANGLE:
            return
        steps = (got.diff() + 180) % 360 - 180
        message = (
            f"{self.path}: expected cameras that turn by {known[0]:g} or {known[1]:g} degrees from "
            f"view to view, as the 'extent of rotation' {self._arc:g} of {count} projections, got "
            f"{steps.min():g} to {steps.max():g}"
        )
        if apart(steps, steps[0]).max() <= MAX_ANGLE:
            raise Refused(f"{message}; give the cameras of these views, or correct the header")
        warnings.warn(message, stacklevel=2)

    def _block(self, first: int, last: int) -> np.ndarray:
        counts = self._numbers.read(first, last)
        if not (np.isfinite(counts) & (counts >= 0)).all():
            raise Refused(
                f"{self.path}: expected counts, finite and not negative, got {counts.min():g} in "
                f"views {first} to {last - 1}"
            )
        return counts


def _durations(header: Header, views: int) -> tuple[float | None, float | None]:
    """Durations in s of a view and of all; None where 0, -1 or no key says that it is unknown.

    Raises:
        Refused: an image duration that is neither.
    """
    each, image = (
        header.number(f"{name} (sec)", 0.0) for name in ("time per projection", "image duration")
    )
    if each <= 0:
        return None, image if image > 0 else None
    if image > 0 and abs(image / each - 1) > CLOSE:
        why = f"the time per projection of {views} projections"
        check_repeated(header, ["image duration (sec)"], views * each, why, CLOSE)
    return each, views * each
