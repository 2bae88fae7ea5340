"""The views of one energy window and one frame in time of a DICOM NM study. Requires pydicom."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvrecon.core.files.checks import Refused
from mvrecon.data.dicom_image import DicomImage
from mvrecon.data.projections.images import ImageFiles
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.turning import MAX_ANGLE, apart, turned
from mvrecon_spect.files.nm import EnergyWindow, Frame, View, read_frames

#: Relative difference of durations for rounding.
MAX_DURATION = 1e-3


def dicom_views(path: Path, dataset: str | None = None) -> ProjectionStack:
    """Views in a DICOM file: `NmViews` of a gamma camera, or projections in the file's order.

    Args:
        path: path of the file.
        dataset: see `NmViews`.

    Raises:
        ImportError: pydicom is not installed.
        Refused: see `NmViews` and `ImageFiles`; a data set of other DICOM than NM.
    """
    if DicomImage(path).value("Modality") == "NM":
        return NmViews(path, dataset)
    if dataset is not None:
        raise Refused(f"{path}: expected DICOM NM for views.dataset={dataset}, got another")
    return ImageFiles([path])


class NmViews(ProjectionStack):
    """Counts of a DICOM NM file, sorted by detector, rotation and angular view.

    All detectors measure at the same time, one angular view after the other; the time between
    views, which NM does not contain, is taken to be zero.

    Args:
        path: path of the file.
        dataset: the energy window and the frame in time, numbered from 1 in the order of
            `read_frames`: "window2", "frame3" or "window2/frame3"; None: the only ones.

    Raises:
        ImportError: pydicom is not installed.
        Refused: several windows or frames of which none is chosen, or an unknown one; views of
            different durations; see `read_frames`.
    """

    kind = "counts"
    unit = "spect of activity"
    dose = 1.0
    own_unit = True

    def __init__(self, path: Path, dataset: str | None = None):
        frames, studies = zip(*read_frames(path), strict=True)
        windows = {f"window{k}": _energies(w) for k, w in enumerate(studies[0].windows, 1)}
        times = {f"frame{k}": _time(frame) for k, frame in enumerate(frames, 1)}
        names = dataset.strip("/").split("/") if dataset else []
        known = [name for name in names if name in (*windows, *times)]
        if known != names or len({name in windows for name in names}) != len(names):
            raise Refused(
                f"{path}: expected views.dataset of a window and a frame in time out of "
                f"{_listed(windows)}; {_listed(times)}, got {dataset!r}"
            )
        window, moment = (_chosen(path, names, words) for words in (windows, times))
        study = studies[moment]
        self._counts = study.counts[window][0, 0]
        self.pixel_mm, self.began = study.pixel_mm, study.began
        if len(limits := study.windows[window].limits_kev) == 1:
            self.window_kev = limits[0]
        self.duration_s = _duration(path, study.views)
        if self.duration_s is not None:
            self.starts_s = _starts(study.views, frames, moment, self.duration_s)
        self._angles = [view.angle_degrees for view in study.views]
        views = [f"detector {d} rotation {r} view {n}" for d, r, n, *_ in study.views]
        super().__init__(path, views, study.counts[0].shape[-2:], np.dtype("f4"))

    def check_rig(self, cameras: Cameras) -> None:
        """Compare also the detectors' angles about the z axis with those of the views, except for
        an angle in common.

        Convention: with z towards the head, angles increase from the patient's back (-y) to the
        left (-x), as in DICOM.
        """
        super().check_rig(cameras)
        angles = [angle for angle in self._angles if angle is not None]
        if len(angles) < len(self._angles):
            return
        got = turned(cameras, cameras.u.new_tensor([0.0, 0.0, -1.0]))
        stated = (got.new_tensor(angles) - angles[0]) % 360
        off = apart(got, stated)
        if off.max() > MAX_ANGLE:
            k = int(off.argmax())
            raise Refused(
                f"{self.path}: expected cameras in the file's order of detectors, {stated[k]:.1f} "
                f"degrees from the first to {self.names[k]}, counter-clockwise seen from -z, got "
                f"{got[k]:.1f}"
            )

    def _block(self, first: int, last: int) -> np.ndarray:
        return self._counts[first:last].numpy()


def _chosen(path: Path, names: Sequence[str], words: dict[str, str]) -> int:
    """The index of the only window or frame, or of that which is named."""
    for k, name in enumerate(words):
        if name in names or len(words) == 1:
            return k
    raise Refused(
        f"{path}: expected one of several to be chosen by views.dataset={next(iter(words))} or the "
        f"like, got {_listed(words)}"
    )


def _listed(words: dict[str, str]) -> str:
    return ", ".join(f"{name} ({about})" if about else name for name, about in words.items())


def _energies(window: EnergyWindow) -> str:
    limits = " and ".join(f"{low:g} to {high:g} keV" for low, high in window.limits_kev)
    return ", ".join(part for part in (window.name, limits) if part)


def _time(frame: Frame) -> str:
    known = {"from": frame.start_s, "for": frame.duration_s}
    return " ".join(f"{word} {time:g} s" for word, time in known.items() if time is not None)


def _duration(path: Path, views: Sequence[View]) -> float | None:
    """The duration of every view in s; None if unknown."""
    known = [view.duration_s for view in views if view.duration_s is not None]
    if not known:
        return None
    if len(known) < len(views) or max(known) > min(known) * (1 + MAX_DURATION):
        raise Refused(
            f"{path}: expected views of one duration, got {min(known):g} to {max(known):g} s in "
            f"{len(known)} of {len(views)} views; in Python, corrected(A, durations) takes them"
        )
    return known[0]


def _starts(
    views: Sequence[View], frames: Sequence[Frame], moment: int, duration_s: float
) -> list[float] | None:
    """The start of each view in s since that of the measurement. None if unknown: for frames
    without phases, and for frames of several angular views, which may follow one another.
    """
    turns = sorted({(view.rotation, view.number) for view in views})
    first = frames[moment].start_s
    if len(frames) > 1 and (first is None or len(turns) > 1):
        return None
    numbers = (turns.index((view.rotation, view.number)) for view in views)
    return [(first or 0.0) + duration_s * number for number in numbers]
