"""DICOM: header and pixels of a file, and a CT series, one slice a file or slices as frames, as one
volume. Needs pydicom, and nibabel for volumes: the extra `io`.

Convention: DICOM's world is LPS (x to the patient's left, y to the back), mvrecon's is RAS as in
NIfTI.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from mvrecon.core.files.checks import EDGE, VOLUME, Refused, file_errors, io_library, shown
from mvrecon.core.files.keys import Key, check_keys
from mvrecon.data.resample import Planes, Slabs, oriented, planes
from mvrecon.geometry.grid import Grid

#: Endings of DICOM files; others are recognised by the bytes from 128 on.
DICOM = (".dcm", ".dicom", ".ima")
MAGIC = 128
#: Attributes that change the pixels of any DICOM image.
KEYS = (
    Key("RescaleSlope", "applied", "of the image or of each frame"),
    Key("RescaleIntercept", "applied", "of the image or of each frame"),
    Key(
        "RealWorldValueMappingSequence",
        "applied",
        "where there is no RescaleSlope or RescaleIntercept, else compared with them; refused: a "
        "look-up table, several mappings that differ, or pixels outside the mapped range",
    ),
    Key("ModalityLUTSequence", "refused", "store the values that the look-up table gives"),
    Key("BitsAllocated", "applied"),
    Key("BitsStored", "applied", "also gives the largest stored value; higher bits are cleared"),
    Key("PixelRepresentation", "applied", "sign"),
    Key(
        "PhotometricInterpretation",
        "refused",
        "one grey value a pixel; MONOCHROME1 affects display alone",
        ("MONOCHROME1", "MONOCHROME2"),
    ),
    Key("SamplesPerPixel", "refused", "one grey value a pixel", (1,)),
    Key("WindowCenter, VOILUTSequence, PresentationLUTShape", "ignored", "display alone"),
)
#: Attributes of a CT series besides `KEYS`.
CT_KEYS = (
    Key("RescaleType", "refused", "values of a CT are in HU", ("HU", "US")),
    Key("PixelPaddingValue", "applied", "padding above air becomes air, -1000 HU"),
    Key("PixelPaddingRangeLimit", "applied", "other end of the padding's range"),
    Key("ImagePositionPatient", "applied"),
    Key("ImageOrientationPatient", "applied"),
    Key("PixelSpacing", "applied"),
    Key(
        "SliceThickness, SpacingBetweenSlices, SliceLocation, GantryDetectorTilt",
        "ignored",
        "positions decide",
    ),
)
#: Functional groups of an enhanced image for attributes of a plain one.
GROUPS = {
    "ImagePositionPatient": "PlanePositionSequence",
    "ImageOrientationPatient": "PlaneOrientationSequence",
    "PixelSpacing": "PixelMeasuresSequence",
    "RescaleSlope": "PixelValueTransformationSequence",
    "RescaleIntercept": "PixelValueTransformationSequence",
    "RescaleType": "PixelValueTransformationSequence",
    "RealWorldValueMappingSequence": "RealWorldValueMappingSequence",
    "ImagerPixelSpacing": "FramePixelDataPropertiesSequence",
    "PixelIntensityRelationship": "FramePixelDataPropertiesSequence",
    "PixelIntensityRelationshipSign": "FramePixelDataPropertiesSequence",
}
#: The only compressed transfer syntax that pydicom decodes by itself.
RLE = "1.2.840.10008.1.2.5"


def dicom_file(path: Path) -> bool:
    """Whether a file is DICOM, by its ending or, without one, by its first bytes."""
    if path.suffix.lower() in DICOM:
        return True
    with path.open("rb") as file:
        file.seek(MAGIC)
        return file.read(4) == b"DICM"


def header_of(path: Path) -> Any:
    """The header of a DICOM image of one grey value a pixel, without its pixels.

    Raises:
        ImportError: pydicom is not installed.
        Refused: not DICOM, cut short, in colour, without an image, or with one of the `KEYS` to
            refuse.
    """
    with file_errors(path, "cannot be read as DICOM"):
        dataset = io_library("pydicom", path).dcmread(path, stop_before_pixels=True)
        rows, columns = int(dataset.get("Rows") or 0), int(dataset.get("Columns") or 0)
        if not (0 < rows <= EDGE and 0 < columns <= EDGE):
            raise Refused(f"{path}: expected a DICOM image, got {rows} x {columns} pixels")
        check_keys(path, KEYS, dataset.get)
    return dataset


def frames_of(dataset: Any) -> int:
    """Number of frames of a DICOM image, by default 1."""
    return int(dataset.get("NumberOfFrames") or 1)


def enhanced(dataset: Any) -> bool:
    """Whether an image has functional groups, which describe its frames (PS3.3, C.7.6.16)."""
    return bool(dataset.get("PerFrameFunctionalGroupsSequence"))


def value_of(dataset: Any, name: str, frame: int = 0) -> Any:
    """Return an attribute of a frame: the image's, the frame's, or the shared one; None if missing.

    Args:
        dataset: of the image.
        name: such as ImagePositionPatient; those of `GROUPS` may be of a frame.
        frame: from 0.
    """
    group = GROUPS.get(name)
    if dataset.get(name) is not None or group is None:
        return dataset.get(name)
    own, shared = (
        dataset.get(f"{kind}FunctionalGroupsSequence") or [] for kind in ("PerFrame", "Shared")
    )
    for groups in (*own[frame : frame + 1], *shared[:1]):
        if macro := groups.get(group):
            return macro if group == name else macro[0].get(name)
    return None


class Scale(NamedTuple):
    """Values of a frame: slope times stored number plus intercept, for stored numbers from `first`
    to `last`.
    """

    slope: float
    intercept: float
    first: float = -np.inf
    last: float = np.inf


def scale_of(path: Path, dataset: Any, frame: int = 0) -> Scale:
    """The scale of a frame: RescaleSlope and RescaleIntercept, else its real world value mapping
    (PS3.3, C.7.6.16.2.11), else the stored numbers.

    Raises:
        Refused: a mapping that differs from RescaleSlope and RescaleIntercept, several that differ,
            or one by a look-up table.
    """
    with file_errors(path, "has a RescaleSlope or RealWorldValueMappingSequence of no numbers"):
        stated = [value_of(dataset, name, frame) for name in ("RescaleSlope", "RescaleIntercept")]
        rescaled = [u if v is None else float(v) for v, u in zip(stated, (1.0, 0.0), strict=True)]
        items = value_of(dataset, "RealWorldValueMappingSequence", frame) or []
        mapped = {_mapping(path, item) for item in items}
        scale = Scale(*rescaled)
        if mapped and stated == [None, None]:
            scale = mapped.pop()
            mapped = {item for item in mapped if item[:2] != scale[:2]}
        if not np.isfinite(scale[:2]).all() or scale.slope == 0:
            raise Refused(
                f"{path}: expected a finite slope, not 0, and a finite intercept, got {scale[:2]}"
            )
        if off := [item for item in mapped if not np.allclose(item[:2], scale[:2], rtol=1e-5)]:
            raise Refused(
                f"{path}: expected a RealWorldValueMappingSequence that agrees with the slope "
                f"{scale.slope:g} and intercept {scale.intercept:g} of its pixels, got "
                f"{off[0].slope:g} and {off[0].intercept:g}; keep the one that is meant"
            )
    return scale


def _mapping(path: Path, item: Any) -> Scale:
    if item.get("RealWorldValueLUTData") is not None or item.get("RealWorldValueSlope") is None:
        raise Refused(
            f"{path}: expected a RealWorldValueMappingSequence of a slope and an intercept, got a "
            f"look-up table"
        )
    ends = [
        item.get(f"{kind}{end}ValueMapped")
        for end in ("First", "Last")
        for kind in ("RealWorldValue", "DoubleFloatRealWorldValue")
    ]
    first, last = (
        next(v for v in (*pair, usual) if v is not None)
        for pair, usual in ((ends[:2], -np.inf), (ends[2:], np.inf))
    )
    slope, intercept = float(item.RealWorldValueSlope), float(item.RealWorldValueIntercept)
    return Scale(slope, intercept, float(first), float(last))


def stored_type(dataset: Any) -> tuple[np.dtype, tuple[float, float] | None]:
    """Type of the stored numbers, and the least and the largest of BitsStored; none of floats."""
    if dataset.get("BitsStored") is None or not dataset.get("BitsAllocated"):
        return np.dtype("f4"), None
    signed, bits = int(dataset.get("PixelRepresentation") or 0), int(dataset.BitsStored)
    kind = np.dtype(f"{'i' if signed else 'u'}{max(1, int(dataset.BitsAllocated) // 8)}")
    return kind, (-float(2 ** (bits - 1)) if signed else 0.0, float(2 ** (bits - signed) - 1))


def pixels_of(path: Path, air: float | None = None) -> Float[np.ndarray, "*m v u"]:
    """Pixels of a DICOM image, scaled by `scale_of`, float32: [v u], or [m v u] of frames.

    Ignores MONOCHROME1 and windows, which affect display only.

    Args:
        path: of the image.
        air: greatest value of padding pixels; None: padding is refused.

    Raises:
        ImportError: pydicom is not installed.
        Refused: cut short or damaged, numbers outside the range of a mapping, padding, or a
            compression that SimpleITK does not support either.
    """
    dataset, stored = _stored_pixels(path)
    padding, values = _padding(dataset, stored), stored.astype(np.float32)
    if air is None and padding.any():
        raise Refused(
            f"{path}: expected measured pixels alone, got {int(padding.sum())} of its "
            f"PixelPaddingValue {dataset.PixelPaddingValue}; cut the images to the measured region"
        )
    for frame, part in enumerate(values.reshape(-1, *values.shape[-2:])):
        scale = scale_of(path, dataset, frame)
        if part.min() < scale.first or part.max() > scale.last:
            raise Refused(
                f"{path}: expected stored numbers from {scale.first:g} to {scale.last:g}, for "
                f"which its RealWorldValueMappingSequence holds, got {part.min():g} to "
                f"{part.max():g}"
            )
        if scale[:2] != (1.0, 0.0):
            part *= np.float32(scale.slope)
            part += np.float32(scale.intercept)
    if air is not None and padding.any():
        values[padding] = values[padding].clip(max=air)
    return values


def _padding(dataset: Any, stored: Shaped[np.ndarray, "*m v u"]) -> Bool[np.ndarray, "*m v u"]:
    """Pixels within PixelPaddingValue and PixelPaddingRangeLimit."""
    if (value := dataset.get("PixelPaddingValue")) is None:
        return np.zeros(stored.shape, bool)
    limit = dataset.get("PixelPaddingRangeLimit")
    ends = np.array([int(value), int(value if limit is None else limit)]).astype(stored.dtype)
    return (stored >= ends.min()) & (stored <= ends.max())


def _stored_pixels(path: Path) -> tuple[Any, Shaped[np.ndarray, "*m v u"]]:
    """Data set and stored numbers of a DICOM image: [v u], or [m v u] of frames.

    Raises:
        ImportError, Refused: see `pixels_of`.
    """
    with file_errors(path, "has pixels that cannot be read"):
        dataset = io_library("pydicom", path).dcmread(path)
        frames = frames_of(dataset)
        if 4 * frames * int(dataset.Rows) * int(dataset.Columns) > VOLUME:
            raise Refused(f"{path}: expected at most {VOLUME} bytes of pixels, got more")
        syntax = dataset.file_meta.TransferSyntaxUID
        if not syntax.is_encapsulated or syntax == RLE:
            return dataset, dataset.pixel_array
        return dataset, _unpacked(path, dataset)


#: Attributes that describe stored numbers.
STORED = (
    "SamplesPerPixel Rows Columns NumberOfFrames BitsAllocated BitsStored HighBit "
    "PixelRepresentation PixelData"
).split()
#: Multi-frame Grayscale Word Secondary Capture.
CAPTURE = "1.2.840.10008.5.1.4.1.1.7.3"


def _unpacked(path: Path, dataset: Any) -> Integer[np.ndarray, "*m v u"]:
    """Stored numbers of a compressed image by SimpleITK, of a copy without further attributes:
    GDCM scales by RescaleSlope, ignores real world value mappings and inverts MONOCHROME1.
    """
    pydicom, itk = io_library("pydicom", path), io_library("SimpleITK", path)
    plain = pydicom.Dataset()
    for name in STORED:
        if name in dataset:
            plain[name] = dataset[name]
    plain.PhotometricInterpretation = "MONOCHROME2"
    plain.SOPClassUID, plain.SOPInstanceUID = CAPTURE, pydicom.uid.generate_uid()
    plain.file_meta = pydicom.dataset.FileMetaDataset()
    plain.file_meta.TransferSyntaxUID = dataset.file_meta.TransferSyntaxUID
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "pixels.dcm"
        plain.save_as(copy, enforce_file_format=True)
        values = itk.GetArrayFromImage(itk.ReadImage(str(copy), imageIO="GDCMImageIO"))
    return values if frames_of(dataset) > 1 else values.reshape(values.shape[-2:])


#: Tolerances: mm of slices' positions; share of the spacing of gaps between slices.
PLACE, GAP = 0.01, 0.01
#: Hounsfield units outside a resampled slice.
AIR = -1000.0
#: From DICOM's world (LPS) to RAS.
RAS = np.array([-1.0, -1.0, 1.0])


class Slice(NamedTuple):
    """One slice: its file, series, centre of pixel (0, 0) in mm, directions of rows and columns
    (all LPS), steps between rows and between columns in mm, pixels (rows, columns), and the frame
    of the file, None for a single slice.
    """

    path: Path
    series: str
    corner: np.ndarray
    axes: np.ndarray
    steps: tuple[float, float]
    shape: tuple[int, int]
    frame: int | None = None


def open_series(folder: str | Path, resample: bool = False) -> tuple[Slabs, Grid]:
    """Open the one CT series of a folder: Hounsfield units slice by slice along the normal, and the
    grid in world mm (RAS).

    Slices are sorted by position, regardless of file names; slope and intercept are per slice. A
    file holds one slice, or is an enhanced image with slices as frames, all of which are in memory
    while it is read.

    Args:
        folder: with the files of the series.
        resample: shift the slices of a tilted gantry within their planes, by linear interpolation,
            until they are aligned; `AIR` outside a slice.

    Raises:
        ImportError: pydicom or nibabel is not installed.
        FileNotFoundError: no such folder, or no DICOM file in it.
        Refused: several series (with their UIDs), another modality, slices of several sizes, a gap,
        two slices at one position, a tilted gantry, or damage; with the reason.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; expected one with a DICOM CT series")
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and dicom_file(path)]
    if not files:
        raise FileNotFoundError(f"{folder}: expected the files of a DICOM CT series, got none")
    if len(files) > EDGE:
        raise Refused(f"{folder}: expected at most {EDGE} slices, got {len(files)}")
    slices = [item for path in files for item in _slices(path)]
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


def _slices(path: Path) -> list[Slice]:
    """The slices of a file: one, or the frames of an enhanced image."""
    dataset = header_of(path)
    modality = str(dataset.get("Modality") or "none")
    if modality != "CT":
        raise Refused(f"{path}: expected a slice of the modality CT, got {shown(modality)}")
    frames = frames_of(dataset)
    if frames == 1:
        return [_slice(path, dataset, None)]
    groups = len(dataset.get("PerFrameFunctionalGroupsSequence") or [])
    if groups != frames or frames > EDGE:
        raise Refused(
            f"{path}: expected one slice in each file, or at most {EDGE} frames with functional "
            f"groups, got an image of several frames: {frames} with {groups} groups"
        )
    return [_slice(path, dataset, frame) for frame in range(frames)]


def _slice(path: Path, dataset: Any, frame: int | None) -> Slice:
    check_keys(path, CT_KEYS, lambda name: value_of(dataset, name, frame or 0))
    for name in ("RescaleSlope", "RescaleIntercept"):
        with file_errors(path, f"has a {name} that cannot be read"):
            value = value_of(dataset, name, frame or 0)
            if value is None or not np.isfinite(float(value)):
                raise Refused(f"{path}: expected a finite {name} of a CT slice, got {value}")
    if not dataset.get("SeriesInstanceUID"):
        raise Refused(f"{path}: expected a slice with SeriesInstanceUID, got none")
    corner, axes, steps = (
        _numbers(path, name, value_of(dataset, name, frame or 0), count)
        for name, count in (
            ("ImagePositionPatient", 3),
            ("ImageOrientationPatient", 6),
            ("PixelSpacing", 2),
        )
    )
    axes, (down, right) = axes.reshape(2, 3), steps.tolist()
    if np.abs(axes @ axes.T - np.eye(2)).max() > 1e-3:
        raise Refused(f"{path}: expected rows and columns at right angles, got {axes.tolist()}")
    shape = (int(dataset.Rows), int(dataset.Columns))
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Slice(path, str(dataset.SeriesInstanceUID), corner, axes, (down, right), shape, frame)


def _numbers(path: Path, name: str, value: Any, count: int) -> np.ndarray:
    with file_errors(path, f"has a {name} that cannot be read"):
        values = np.array([] if value is None else [float(x) for x in value])
        if values.shape != (count,) or not np.isfinite(values).all():
            raise Refused(f"{path}: expected {name} as {count} finite numbers, got {shown(value)}")
    return values


def _check_alike(folder: Path, slices: Sequence[Slice]) -> None:
    """Raise for slices of several series, sizes or directions."""
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
    """Sort slices by position along the normal; also returns their distance in mm."""
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
    return slices, float(steps.mean())


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
