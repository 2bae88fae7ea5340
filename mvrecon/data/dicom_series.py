"""A DICOM CT series, one slice a file, as one volume. Needs pydicom and nibabel, the extra `io`.

Convention: DICOM's world is LPS (x to the patient's left, y to the back), ours is RAS as in NIfTI.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mvrecon.data.dicom import dicom_file, header_of, pixels_of
from mvrecon.data.orientation import Planes, oriented
from mvrecon.data.slabs import Slabs, planes
from mvrecon.files.checks import EDGE, VOLUME, Refused, blaming, shown
from mvrecon.geometry.grid import Grid

#: mm that slices may be off their places; part of the spacing that gaps between slices may differ.
PLACE, GAP = 0.01, 0.01
#: From DICOM's world (LPS) to ours (RAS).
RAS = np.array([-1.0, -1.0, 1.0])


class Slice(NamedTuple):
    """One slice: its file, series, centre of pixel (0, 0) in mm, directions of rows and columns
    (all LPS), step from row to row and from column to column in mm, and pixels (rows, columns).
    """

    path: Path
    series: str
    corner: np.ndarray
    axes: np.ndarray
    steps: tuple[float, float]
    shape: tuple[int, int]


def open_series(folder: str | Path) -> tuple[Slabs, Grid]:
    """Hounsfield units of the one CT series in a folder, slice by slice along the normal, and where
    its voxels lie in world mm (RAS).

    Files are sorted by their position, whatever their names; slope and intercept are each slice's
    own.

    Raises:
        ImportError: pydicom or nibabel is not installed.
        FileNotFoundError: there is no such folder, or no DICOM file in it.
        Refused: several series (with their UIDs), another modality, slices of several sizes, a gap,
            two slices at one place, a tilted gantry, or damage; with the reason.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; expected one with a DICOM CT series")
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and dicom_file(path)]
    if not files:
        raise FileNotFoundError(f"{folder}: expected the files of a DICOM CT series, got none")
    if len(files) > EDGE:
        raise Refused(f"{folder}: expected at most {EDGE} slices, got {len(files)}")
    slices = [_slice(path) for path in files]
    _check_alike(folder, slices)
    slices, step = _sorted(folder, slices)
    rows, columns = slices[0].shape
    if 4 * len(slices) * rows * columns > VOLUME:
        raise Refused(f"{folder}: expected a volume of at most {VOLUME} bytes, got more")
    affine = np.eye(4)
    (down, right), (along_row, along_column) = slices[0].steps, slices[0].axes
    affine[:3, 0], affine[:3, 1] = RAS * along_row * right, RAS * along_column * down
    affine[:3, 2], affine[:3, 3] = (
        RAS * np.cross(along_row, along_column) * step,
        (RAS * slices[0].corner),
    )
    return oriented(folder, (columns, rows, len(slices)), affine, lambda: _passes(slices))


def _passes(slices: Sequence[Slice]) -> Iterator[Planes]:
    count = planes(slices[0].shape[0] * slices[0].shape[1])
    for first in range(0, len(slices), count):
        part = np.stack([pixels_of(item.path) for item in slices[first : first + count]])
        yield first, part.T


def _slice(path: Path) -> Slice:
    dataset = header_of(path)
    modality = str(dataset.get("Modality") or "none")
    if modality != "CT":
        raise Refused(f"{path}: expected a slice of the modality CT, got {shown(modality)}")
    if int(dataset.get("NumberOfFrames") or 1) > 1:
        raise Refused(f"{path}: expected one slice in each file, got an image of several frames")
    for name in ("RescaleSlope", "RescaleIntercept"):
        with blaming(path, f"has a {name} that cannot be read"):
            value = dataset.get(name)
            if value is None or not np.isfinite(float(value)):
                raise Refused(f"{path}: expected a finite {name} of a CT slice, got {value}")
    if not dataset.get("SeriesInstanceUID"):
        raise Refused(f"{path}: expected a slice with SeriesInstanceUID, got none")
    corner = _numbers(path, dataset, "ImagePositionPatient", 3)
    axes = _numbers(path, dataset, "ImageOrientationPatient", 6).reshape(2, 3)
    down, right = _numbers(path, dataset, "PixelSpacing", 2).tolist()
    if np.abs(axes @ axes.T - np.eye(2)).max() > 1e-3:
        raise Refused(f"{path}: expected rows and columns at right angles, got {axes.tolist()}")
    shape = (int(dataset.Rows), int(dataset.Columns))
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Slice(path, str(dataset.SeriesInstanceUID), corner, axes, (down, right), shape)


def _numbers(path: Path, dataset: Any, name: str, count: int) -> np.ndarray:
    with blaming(path, f"has a {name} that cannot be read"):
        value = dataset.get(name)
        values = np.array([] if value is None else [float(x) for x in value])
        if values.shape != (count,) or not np.isfinite(values).all():
            raise Refused(f"{path}: expected {name} as {count} finite numbers, got {shown(value)}")
    return values


def _check_alike(folder: Path, slices: Sequence[Slice]) -> None:
    """Refuse slices of several series, or of several sizes or directions."""
    if len(series := sorted({item.series for item in slices})) > 1:
        raise Refused(
            f"{folder}: expected one series, got {len(series)}: {', '.join(series[:8])}; put each "
            f"into a folder of its own"
        )
    first = slices[0]
    for item in slices:
        if item.shape != first.shape or not (
            np.allclose(item.steps, first.steps, rtol=1e-4)
            and np.allclose(item.axes, first.axes, atol=1e-4)
        ):
            raise Refused(
                f"{item.path}: expected {first.shape} pixels of {first.steps} mm in the directions "
                f"{first.axes.tolist()} as {first.path.name}, got {item.shape} of {item.steps} in "
                f"{item.axes.tolist()}"
            )


def _sorted(folder: Path, slices: Sequence[Slice]) -> tuple[list[Slice], float]:
    """Slices in the order of their position along the normal, and the mm between them."""
    if len(slices) < 2:
        raise Refused(f"{folder}: expected at least two slices of a series, got one")
    normal = np.cross(*slices[0].axes)
    slices = sorted(slices, key=lambda item: float(item.corner @ normal))
    corners = np.stack([item.corner for item in slices])
    steps = np.diff(corners @ normal)
    step = float(np.median(steps))
    for k, gap in enumerate(steps.tolist()):
        names = f"{slices[k].path.name} and {slices[k + 1].path.name}"
        if gap < PLACE:
            raise Refused(f"{folder}: expected every slice at its own place, got {names} at one")
        if abs(gap - step) > max(PLACE, GAP * step):
            raise Refused(
                f"{folder}: expected slices {step:g} mm apart, got {gap:g} mm between {names}; is "
                f"a slice missing?"
            )
    across = corners - corners[0] - np.outer((corners - corners[0]) @ normal, normal)
    if (off := np.linalg.norm(across, axis=1)).max() > max(PLACE, GAP * min(slices[0].steps)):
        angle = np.degrees(np.arctan2(off[-1], steps.sum()))
        raise Refused(
            f"{folder}: expected slices straight above each other, got a shift of "
            f"{off.max():.3g} mm in their plane: a gantry tilt of {angle:.1f} degrees; resample it "
            f"first"
        )
    return slices, float(steps.mean())
