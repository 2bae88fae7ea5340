"""A DICOM CT series, one slice a file or slices as frames, as one volume. Needs pydicom and
nibabel: the extra `io`.

Convention: DICOM's world is LPS (x to the patient's left, y to the back), mvrecon's is RAS as in
NIfTI.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mvrecon.core.files.checks import EDGE, VOLUME, Refused, check_link, file_errors, shown
from mvrecon.core.files.keys import Key
from mvrecon.data.dicom_image import PARTS, DicomImage, dataset_of, dicom_file, same
from mvrecon.data.dicom_pixels import pixels_of
from mvrecon.data.resample import Planes, Slabs, oriented, planes
from mvrecon.geometry.grid import Grid

#: Codes of Hounsfield units, in lower case.
HU = ("[hnsf'u]", "hu", "1", "us")
#: Attributes that slices of one volume have in common, and those on which their values depend.
ONE_VOLUME = (
    *("StackID", "TemporalPositionIndex", "FrameType", "TemporalPositionIdentifier"),
    *("NominalPercentageOfCardiacPhase", "NominalPercentageOfRespiratoryPhase"),
    *("NominalCardiacTriggerDelayTime", "TemporalPositionTimeOffset", "PatientPosition"),
)
VALUES_DEPEND = (
    *("KVP", "ConvolutionKernel", "ReconstructionAlgorithm", "ImageFilter"),
    *("MultienergyCTAcquisition", "MonoenergeticEnergyEquivalent"),
)
#: Words of an ImageType or FrameType whose pixels are no slices of Hounsfield units: projections,
#: differences, statistics, and materials (PS3.3, C.8.2.1.1.1 and C.8.16.1.4).
OTHERWISE = {
    *("LOCALIZER", "MAXIMUM", "MINIMUM", "MIP", "MINIP", "ADDITION", "SUBTRACTION", "DIVISION"),
    *("MULTIPLICATION", "STD_DEVIATION", "QUANTITY", "MAT_SPECIFIC", "MAT_FRACTIONAL"),
    *("MAT_VALUE_BASED", "EFF_ATOMIC_NUM", "ELECTRON_DENSITY"),
}
#: Attributes of a CT series besides `dicom_image.KEYS`.
CT_KEYS = (
    Key("RescaleType", "refused", "values of a CT are in HU", ("HU", "US")),
    Key(
        "MeasurementUnitsCodeSequence, Units",
        "compared",
        f"values of a CT are in HU: refused unless {', '.join(HU)}",
    ),
    Key("ImagePositionPatient", "applied"),
    Key("ImageOrientationPatient", "applied"),
    Key("PixelSpacing", "applied"),
    Key("SeriesInstanceUID, FrameOfReferenceUID", "compared", "one of all slices"),
    Key(", ".join(ONE_VOLUME), "compared", "one of all slices"),
    Key(", ".join(VALUES_DEPEND), "compared", "of all slices; warned of"),
    Key(", ".join(PARTS), "compared", "all parts of a concatenation must be there"),
    Key("VolumetricProperties", "refused", "flat slices", ("VOLUME", "SAMPLED", "MIXED")),
    Key(
        "VolumeBasedCalculationTechnique",
        "refused",
        "slices, not projections through several",
        ("NONE", "MPR"),
    ),
    Key("Modality", "refused", "series of other objects beside a CT are skipped", ("CT",)),
    Key("SOPClassUID", "applied", "series of captures are skipped"),
    Key(
        "ImageType",
        "compared",
        "series of localizers are skipped; flat slices in HU: refused, as is FrameType, with "
        f"{', '.join(sorted(OTHERWISE))}",
    ),
    Key(
        "SliceThickness, SpacingBetweenSlices, SliceLocation, GantryDetectorTilt, "
        "GantryDetectorSlew, TableHeight, TablePosition, ReconstructionDiameter, "
        "ReconstructionTargetCenterPatient, ReconstructionPixelSpacing, "
        "DataCollectionCenterPatient, ImageToEquipmentMappingMatrix, ImagePosition, "
        "ImageOrientation, DimensionIndexValues, InStackPositionNumber",
        "ignored",
        "positions, of the patient, decide",
    ),
)
#: SOP classes of CT images: plain, enhanced, and legacy converted enhanced; and attributes by which
#: a series is one of slices.
CT = tuple(f"1.2.840.10008.5.1.4.1.1.2{end}" for end in ("", ".1", ".2"))
HEAD = [
    *("Modality", "SeriesInstanceUID", "SOPClassUID", "ImageType", "DirectoryRecordSequence"),
    *PARTS,
]
#: Tolerances: mm of slices' positions; share of the spacing of gaps between slices.
PLACE, GAP = 0.01, 0.01
#: Hounsfield units outside a resampled slice.
AIR = -1000.0
#: From DICOM's world (LPS) to RAS.
RAS = np.array([-1.0, -1.0, 1.0])


class Slice(NamedTuple):
    """One slice: its file, series, frame of reference, centre of pixel (0, 0) in mm, directions of
    rows and columns (all LPS), steps between rows and between columns in mm, pixels (rows,
    columns), the frame of the file, None for a single slice, and what it states of `ONE_VOLUME` and
    `VALUES_DEPEND`.
    """

    path: Path
    series: str
    reference: str
    corner: np.ndarray
    axes: np.ndarray
    steps: tuple[float, float]
    shape: tuple[int, int]
    frame: int | None = None
    stated: tuple[Any, ...] = ()


def ct_file(path: Path) -> bool:
    """Whether a path is a DICOM file of the modality CT."""
    return path.is_file() and dicom_file(path) and _head(path).get("Modality") == "CT"


def open_series(folder: str | Path, resample: bool = False) -> tuple[Slabs, Grid]:
    """Open the one CT series of a folder, or of a file: Hounsfield units slice by slice along the
    normal, and the grid in world mm (RAS).

    Slices are sorted by position, regardless of file names; slope and intercept are per slice. A
    file holds one slice, or is an enhanced image with slices as frames, all of which are in memory
    while it is read.

    Args:
        folder: a folder with the files of the series, or a file with all of its slices as frames.
        resample: shift the slices of a tilted gantry within their planes, by linear interpolation,
            until they are aligned; `AIR` outside a slice.

    Raises:
        ImportError: pydicom or nibabel is not installed.
        FileNotFoundError: no such folder, or no DICOM file in it.
        Refused: several series (with their UIDs), another modality, slices of several sizes, a gap,
        two slices at one position, a tilted gantry, or damage; with the reason.

    Warns:
        UserWarning: other objects beside the series, which are skipped: structures, doses, reports,
        localizers, or images of another modality.
    """
    folder = Path(folder).expanduser()
    if not folder.exists():
        raise FileNotFoundError(f"{folder}: no such folder; expected one with a DICOM CT series")
    inside = sorted(folder.iterdir()) if folder.is_dir() else [folder]
    for path in (path for path in inside if not path.name.startswith(".")):
        check_link(path)
    files = [path for path in inside if path.is_file() and dicom_file(path)]
    if not files:
        raise FileNotFoundError(f"{folder}: expected the files of a DICOM CT series, got none")
    _check_others(folder, {path for path in inside if path.is_file()} - {*files}, files)
    if len(files) > EDGE:
        raise Refused(f"{folder}: expected at most {EDGE} slices, got {len(files)}")
    slices = [item for path in _ct_files(folder, files) for item in _slices(path)]
    _check_alike(folder, slices)
    slices, step = _sorted(folder, slices)
    shifts = _shifts(folder, slices, resample)
    rows, columns = slices[0].shape + np.ceil(np.ptp(shifts, axis=0) - PLACE).astype(int)
    if 4 * len(slices) * rows * columns > VOLUME:
        raise Refused(f"{folder}: expected a volume of at most {VOLUME} bytes, got more")
    affine = np.eye(4)
    (down, right), (along_row, along_column) = slices[0].steps, slices[0].axes
    least = shifts.min(axis=0)
    corner = slices[0].corner + along_column * least[0] * down + along_row * least[1] * right
    affine[:3, 0], affine[:3, 1] = RAS * along_row * right, RAS * along_column * down
    affine[:3, 2], affine[:3, 3] = RAS * np.cross(along_row, along_column) * step, RAS * corner
    size = (int(rows), int(columns))
    return oriented(
        folder,
        (size[1], size[0], len(slices)),
        affine,
        lambda: _passes(slices, shifts - least, size),
    )


def _passes(slices: Sequence[Slice], shifts: np.ndarray, size: tuple[int, int]) -> Iterator[Planes]:
    count = planes(size[0] * size[1])
    frames = lru_cache(maxsize=1)(partial(pixels_of, air=AIR))

    def values(item: Slice, shift: np.ndarray) -> np.ndarray:
        alone = item.frame is None
        whole = pixels_of(item.path, AIR) if alone else frames(item.path)[item.frame]
        return whole if whole.shape == size and not shift.any() else _shifted(whole, shift, size)

    for first in range(0, len(slices), count):
        last = first + count
        part = map(values, slices[first:last], shifts[first:last])
        yield first, np.stack(list(part)).T


def _shifted(values: np.ndarray, shift: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Shift a slice by rows and columns into a larger one, by linear interpolation."""
    for axis in (0, 1):
        places = np.arange(size[axis]) - shift[axis]
        low = np.floor(places + PLACE).astype(int)
        part = np.clip(places - low, 0, 1)
        first, last = low >= 0, low + (part > PLACE) < values.shape[axis]
        rows = np.moveaxis(values, axis, -1)
        ends = (np.clip(low + k, 0, values.shape[axis] - 1) for k in (0, 1))
        one, other = (rows[..., end] for end in ends)
        moved = np.where(first & last, one + part * (other - one), np.nan)
        values = np.moveaxis(moved, -1, axis)
    return np.where(np.isnan(values), np.float32(AIR), values).astype(np.float32)


def _ct_files(folder: Path, files: Sequence[Path]) -> list[Path]:
    """The files of CT series, if there is one, without series of other objects beside it, such as
    structures, doses, reports and localizers. A file that states no series is kept.
    """
    heads = {path: _head(path) for path in files}

    def series(wanted: Callable[[Any], bool]) -> set[str]:
        return {str(head.get("SeriesInstanceUID")) for head in heads.values() if wanted(head)}

    slices = series(
        lambda head: (
            head.get("Modality") == "CT" and "LOCALIZER" not in (head.get("ImageType") or ())
        )
    )
    kept = series(lambda head: head.get("SOPClassUID") in CT) & slices or slices
    others = {
        path: str(head.get("Modality") or "DICOMDIR")
        for path, head in heads.items()
        if kept
        and (head.get("SeriesInstanceUID") or "DirectoryRecordSequence" in head)
        and str(head.get("SeriesInstanceUID")) not in kept
    }
    if others:
        warnings.warn(
            f"{folder}: skipped {len(others)} files that are no slices of a CT: "
            f"{', '.join(sorted(set(others.values())))}, such as {next(iter(others)).name}",
            stacklevel=4,
        )
    chosen = [path for path in files if path not in others]
    _check_parts(folder, [heads[path] for path in chosen])
    return chosen


def _check_parts(folder: Path, heads: Sequence[Any]) -> None:
    """Raise for a part of a concatenation, an image in several files, without all others."""
    found: dict[str, set[int]] = {}
    totals = {}
    for head in heads:
        uid, number, total = map(head.get, PARTS)
        if uid is not None or number is not None:
            found.setdefault(str(uid), set()).add(int(number or 0))
            totals[str(uid)] = int(total or 0)
    for uid, numbers in found.items():
        if numbers != {*range(1, totals[uid] + 1)}:
            raise Refused(
                f"{folder}: expected all {totals[uid] or ''} parts of the image of the "
                f"ConcatenationUID {uid} by InConcatenationNumber and InConcatenationTotalNumber, "
                f"got {', '.join(map(str, sorted(numbers)))}; put the files of all into the folder"
            )


def _check_others(folder: Path, others: set[Path], files: Sequence[Path]) -> None:
    """Warn of files that are not DICOM although they are named as those that are: without an
    ending, or with a number as in a UID.
    """
    endings = {path.suffix for path in files}
    known = [path for path in others if path.suffix in endings or path.suffix[1:].isdigit()]
    if known := sorted(path.name for path in known if not path.name.startswith(".")):
        warnings.warn(
            f"{folder}: skipped {len(known)} files that are not DICOM, such as {known[0]}; is one "
            f"of them a slice that is cut short?",
            stacklevel=4,
        )


def _head(path: Path) -> Any:
    return dataset_of(path, specific_tags=HEAD, stop_before_pixels=True)


def _slices(path: Path) -> list[Slice]:
    """The slices of a file: one, or the frames of an enhanced image."""
    image = DicomImage(path)
    modality = str(image.value("Modality") or "none")
    if modality != "CT":
        raise Refused(f"{path}: expected a slice of the modality CT, got {shown(modality)}")
    if image.frames > 1 and not 0 < image.groups <= EDGE:
        raise Refused(
            f"{path}: expected one slice in each file, or at most {EDGE} frames with functional "
            f"groups, got an image of several frames: {image.frames} with {image.groups} groups"
        )
    image.check(CT_KEYS)
    words = {"ImageType": OTHERWISE, "FrameType": OTHERWISE}
    image.check_words(words, "flat slices of Hounsfield units")
    stated: list[Any] = [image.value(name) for name in ONE_VOLUME]
    for name in VALUES_DEPEND:
        stated.append(", ".join(sorted({str(value) for _, value in image.stated(name)})))
    if other := {unit for unit in image.units() if unit.lower() not in HU}:
        raise Refused(
            f"{path}: expected Hounsfield units by Units and MeasurementUnitsCodeSequence, got "
            f"{', '.join(sorted(other))}"
        )
    mapped = image.stated("RealWorldValueMappingSequence")
    for name in ("RescaleSlope", "RescaleIntercept"):
        for value in image.values(name):
            with file_errors(path, f"has a {name} that cannot be read"):
                if not mapped if value is None else not np.isfinite(float(value)):
                    raise Refused(f"{path}: expected a finite {name} of a CT slice, got {value}")
    if not (series := image.value("SeriesInstanceUID")):
        raise Refused(f"{path}: expected a slice with SeriesInstanceUID, got none")
    corners, directions, steps = (
        image.numbers(name, count)
        for name, count in (
            ("ImagePositionPatient", 3),
            ("ImageOrientationPatient", 6),
            ("PixelSpacing", 2),
        )
    )
    image.pixel_mm("PixelSpacing")
    reference = str(image.value("FrameOfReferenceUID") or "")
    slices = []
    for frame, (corner, direction, step) in enumerate(zip(corners, directions, steps, strict=True)):
        axes = direction.reshape(2, 3)
        if np.abs(axes @ axes.T - np.eye(2)).max() > 1e-3:
            raise Refused(f"{path}: expected rows and columns at right angles, got {axes.tolist()}")
        axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        slices.append(
            Slice(
                path,
                str(series),
                reference,
                corner,
                axes,
                (float(step[0]), float(step[1])),
                image.shape,
                frame if image.frames > 1 else None,
                tuple(stated),
            )
        )
    return slices


def _check_alike(folder: Path, slices: Sequence[Slice]) -> None:
    """Raise for slices of several series, frames of reference, sizes or directions."""
    if len(series := sorted({item.series for item in slices})) > 1:
        raise Refused(
            f"{folder}: expected one series, got {len(series)}: {', '.join(series[:8])}; put each "
            f"into a folder of its own"
        )
    if len(references := {item.reference for item in slices if item.reference}) > 1:
        raise Refused(
            f"{folder}: expected one FrameOfReferenceUID, in which the slices have their places, "
            f"got {len(references)}; put the slices of each into a folder of its own"
        )
    first = slices[0]
    for k, name in enumerate((*ONE_VOLUME, *VALUES_DEPEND)):
        value = first.stated[k]
        others = [item.stated[k] for item in slices if not same(item.stated[k], value)]
        if others:
            text = f"expected one {name} of all slices, got {shown(value)} and {shown(others[0])}"
            if name in ONE_VOLUME:
                raise Refused(f"{folder}: {text}; put the slices of each into a folder of its own")
            warnings.warn(f"{folder}: {text}, on which their values depend", stacklevel=4)
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
    """Sort slices by position along the normal; also returns their distance in mm."""
    if len(slices) < 2:
        raise Refused(
            f"{folder}: expected at least two slices of a series, got one; give their folder"
        )
    normal = np.cross(*slices[0].axes)
    slices = sorted(slices, key=lambda item: float(item.corner @ normal))
    corners = np.stack([item.corner for item in slices])
    steps = np.diff(corners @ normal)
    step = float(np.median(steps))
    off = np.ptp(corners @ normal - np.arange(len(slices)) * steps.mean())
    rounded = off <= 1.01 * _last_digit(corners) < step / 4  # as 0, 0.8, 1.5 of 0.75 mm
    for k, gap in enumerate(steps.tolist()):
        names = f"{slices[k].path.name} and {slices[k + 1].path.name}"
        if gap < PLACE:
            raise Refused(f"{folder}: expected every slice at its own place, got {names} at one")
        if abs(gap - step) > max(PLACE, GAP * step) and not rounded:
            raise Refused(
                f"{folder}: expected slices {step:g} mm apart, got {gap:g} mm between {names}; is "
                f"a slice missing?"
            )
    return slices, float(steps.mean())


def _last_digit(corners: np.ndarray) -> float:
    """A unit of the last digit of positions in mm, of one or two decimals; else 0."""
    units = (0.1, 0.01)
    whole = (u for u in units if (abs(corners / u - np.rint(corners / u)) < 1e-6).all())
    return next(whole, 0.0)


def _shifts(folder: Path, slices: Sequence[Slice], resample: bool) -> np.ndarray:
    """In-plane shift of each slice relative to the first, in rows and columns [m 2]; zeros for an
    upright series.
    """
    corners, axes = np.stack([item.corner for item in slices]), slices[0].axes
    across = (corners - corners[0]) @ axes[::-1].T  # mm along the columns (rows downwards) and rows
    off = np.linalg.norm(across, axis=1)
    if off.max() <= max(PLACE, GAP * min(slices[0].steps)):
        return np.zeros((len(slices), 2))
    if not resample:
        rise = float((corners[-1] - corners[0]) @ np.cross(*axes))
        raise Refused(
            f"{folder}: expected slices straight above each other, got a shift of "
            f"{off.max():.3g} mm in their plane: a gantry tilt of "
            f"{np.degrees(np.arctan2(off[-1], rise)):.1f} degrees; resample it: "
            f"read_volume(..., resample=True)"
        )
    return across / np.array(slices[0].steps)
