"""DICOM NM volumes, written and read: a reconstruction with its geometry as one multi-frame file
(RECON TOMO). Requires pydicom; reading also nibabel.

Convention: DICOM's world is LPS, ours is RAS. Position and orientation of an NM volume are in its
DetectorInformationSequence (PS3.3, C.8.4.11); slices are stacked along rows x columns.
"""

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, check_file, file_errors, io_library, shown
from mvrecon.core.files.keys import Key, warn_of_unknown
from mvrecon.data.attenuation import CONCENTRATION
from mvrecon.data.dicom import RAS
from mvrecon.data.dicom_image import DicomImage, finite, same
from mvrecon.data.dicom_pixels import pixels_of
from mvrecon.data.resample import Planes, Slabs, oriented, storable
from mvrecon.geometry.grid import Grid
from mvrecon_spect.files.nm import began, frame_numbers
from mvrecon_spect.files.nm_keys import TIME, VIEW, WINDOW

#: Share of a voxel that the directions of a file may move it.
MOVED = 1e-3
#: Attributes of a volume besides `mvrecon.data.dicom_image.KEYS`.
KEYS = (
    Key("Modality", "refused", "", ("NM",)),
    Key("SliceVector", "applied", "order of the frames, each slice once"),
    *(Key(name, "refused", "where it differs: one volume") for name in (*TIME, *VIEW, WINDOW)),
    Key(
        "ImagePositionPatient, ImageOrientationPatient",
        "applied",
        "of the detectors, compared with the image's",
    ),
    Key("PixelSpacing", "applied"),
    Key("SpacingBetweenSlices", "applied", "also negative; of a single slice or SliceThickness"),
    Key("MeasurementUnitsCodeSequence, Units", "applied", "one unit"),
    Key(
        "CorrectedImage, DecayCorrection, DecayFactor, DoseCalibrationFactor, SUVType, "
        "SliceProgressionDirection",
        "ignored",
        "neither values nor places: the unit has them",
    ),
    Key(
        "SliceThickness, SliceLocation, GantryDetectorTilt, ZoomFactor, TableTraverse, "
        "PatientPosition, PatientOrientationCodeSequence",
        "ignored",
        "position, directions and distance decide",
    ),
)
#: NM Image Storage.
NM = "1.2.840.10008.5.1.4.1.1.20"
#: Attributes that a volume copies from its study; empty if the study lacks them.
SHARED = (
    "PatientName PatientID PatientBirthDate PatientSex StudyInstanceUID StudyID StudyDate "
    "StudyTime StudyDescription AccessionNumber ReferringPhysicianName FrameOfReferenceUID"
).split()
#: Attributes of patient, acquisition and isotope that a volume copies from a DICOM NM file that has
#: them: times, durations, dose, weight.
ACQUIRED = (
    "SpecificCharacterSet PatientAge PatientSize PatientWeight AcquisitionDate AcquisitionTime "
    "AcquisitionDateTime AcquisitionDuration ActualFrameDuration AcquisitionTerminationCondition "
    "AcquisitionStartCondition CountsAccumulated PatientPosition "
    "PatientOrientationCodeSequence PatientGantryRelationshipCodeSequence "
    "RadiopharmaceuticalInformationSequence NumberOfRotations RotationInformationSequence"
).split()
#: Attributes that may be unknown (type 2), as empty sequences.
UNKNOWN = (
    "PatientOrientationCodeSequence PatientGantryRelationshipCodeSequence "
    "EnergyWindowInformationSequence RadiopharmaceuticalInformationSequence"
).split()


class NmVolume(NamedTuple):
    """A volume of a DICOM NM file, its grid in world mm (RAS) and its unit in UCUM; start of the
    acquisition, duration of each view in s and administered activity in MBq, each None if the file
    contains none or several.
    """

    volume: Float[Tensor, "d h w"]
    grid: Grid
    unit: str
    start: datetime | None
    duration_s: float | None
    dose_mbq: float | None


def write_nm(
    path: str | Path,
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    like: str | Path | None = None,
    unit: str = "{counts}/mm3",
) -> None:
    """Write a volume as DICOM NM, with slices from feet to head and rows from anterior to posterior
    if the grid axes permit; an existing file is replaced atomically.

    Values are stored as 16-bit integers with a slope; the maximum error is half of (maximum -
    minimum) / 65535. Slope and intercept are stored as RescaleSlope, which most programs read, and
    as a real world value mapping with the unit.

    Args:
        path: path of the file.
        volume: values on the grid.
        grid: grid of the volume in world mm (RAS).
        like: a DICOM file of the same study, from which patient, study and frame of reference are
            copied; of an NM file also time, duration, rotation, radiopharmaceutical with its dose,
            and the energy window if there is only one.
        unit: unit of the values, in UCUM.

    Raises:
        ImportError: pydicom is not installed.
        Refused: `like` is not a DICOM image.
        ValueError: a volume with values that are not finite, or too small or too far apart for a
            slope in float32, or a grid whose axes are not orthogonal; see
            `mvrecon.data.resample.storable`.
    """
    values = storable(path, volume, grid)[0].astype(np.float64)
    if not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).sum())
        raise ValueError(f"{path}: expected a finite volume, got {bad} values that are not finite")
    values, corner, axes = _as_seen(values, grid)
    low, high = min(0.0, values.min()), values.max()
    slope = (high - low) / 65535 or 1.0
    if slope < np.finfo(np.float32).tiny or high - low > np.finfo(np.float32).max:
        raise ValueError(
            f"{path}: expected values that 16 bits with a slope of float32 hold, got {low:g} to "
            f"{high:g}; divide the volume by a unit of its own"
        )
    dataset = _described(io_library("pydicom", Path(path)), like)
    dataset.NumberOfFrames = dataset.NumberOfSlices = len(values)
    dataset.SliceVector = list(range(1, len(values) + 1))
    dataset.Rows, dataset.Columns = values.shape[1:]
    x, y, z = grid.spacing
    dataset.PixelSpacing, dataset.SpacingBetweenSlices = [_text(y), _text(x)], _text(z)
    dataset.SliceThickness = _text(z)
    detector = dataset.DetectorInformationSequence[0]
    detector.ImagePositionPatient = [_text(value) for value in corner]
    detector.ImageOrientationPatient = [_text(value) for value in axes[:, :2].T.flatten()]
    dataset.RescaleSlope, dataset.RescaleIntercept = _text(slope), _text(low)
    mapped = dataset.RealWorldValueMappingSequence[0]
    slope, low = float(_text(slope)), float(_text(low))  # as written, with 16 characters
    mapped.RealWorldValueSlope, mapped.RealWorldValueIntercept = slope, low
    code = mapped.MeasurementUnitsCodeSequence[0]
    code.CodeValue = code.CodeMeaning = unit
    numbers = np.rint((values - low) / slope).clip(0, 65535)
    dataset.PixelData = numbers.astype("<u2").tobytes()
    with written_whole(Path(path).expanduser()) as part:
        dataset.save_as(part, enforce_file_format=True)


#: Units of volumes by their word in UCUM.
UCUM = {"activity": "{counts}/mm3", CONCENTRATION: "kBq/ml"}


def nm_writer(path: Path, grid: Grid, unit: str) -> Callable[[Float[Tensor, "d h w"]], None]:
    """Return the function that writes a volume of this grid as `write_nm` does, for
    `mvrecon-reconstruct out=volume.dcm`.

    Raises:
        ImportError: pydicom is not installed.
        Refused: a unit other than "activity" or "kBq/ml", or a grid whose axes are not orthogonal.
    """
    io_library("pydicom", path)
    if unit not in UCUM:
        raise Refused(f"{path}: expected activity for DICOM NM, got a volume in the unit {unit}")
    _axes(grid)
    return partial(write_nm, path, grid=grid, unit=UCUM[unit])


def read_nm_volume(path: str | Path) -> NmVolume:
    """Read a reconstructed DICOM NM file, such as `write_nm` writes: slices in any order of frames,
    with slope and intercept applied.

    Axes are permuted and reversed (without moving values) until x, y, z run roughly to the
    patient's right, front and head.

    Raises:
        ImportError: pydicom or nibabel is not installed.
        FileNotFoundError: nothing is there.
        Refused: a wrong modality, measured views, several frames in time or energy windows, slices
            without position, direction or distance, or damage.
    """
    path = Path(path).expanduser()
    slabs, grid = open_nm_volume(path)
    image = DicomImage(path)
    dataset = image.dataset
    with file_errors(path, "describes its unit, time, duration or dose wrongly"):
        if len(found := image.units()) > 1:
            raise Refused(
                f"{path}: expected one unit of its values, got {', '.join(sorted(found))} by "
                f"MeasurementUnitsCodeSequence and Units; keep the one that is meant"
            )
        unit = found.pop() if found else ""
        turns = dataset.get("RotationInformationSequence") or []
        agents = dataset.get("RadiopharmaceuticalInformationSequence") or []
        ms = _only("ActualFrameDuration", [dataset, *turns])
        dose_mbq = _only("RadionuclideTotalDose", agents)
        start = began(dataset)
    return NmVolume(slabs.whole(), grid, unit, start, None if ms is None else ms / 1000, dose_mbq)


def open_nm_volume(path: Path) -> tuple[Slabs, Grid]:
    """Open a reconstructed DICOM NM file for `mvrecon.read_volume`; see `read_nm_volume`."""
    path = Path(path).expanduser()
    check_file(path, "a DICOM NM volume")
    image = DicomImage(path)
    if (modality := str(image.value("Modality"))) != "NM":
        raise Refused(f"{path}: expected the modality NM, got {modality}")
    count, (rows, columns) = image.frames, image.shape
    slices = frame_numbers(image, "SliceVector")
    if image.value("SliceVector") is not None:
        for name in (*TIME, *VIEW, WINDOW):
            if len(found := set(frame_numbers(image, name))) > 1:
                raise Refused(
                    f"{path}: expected one volume, got {len(found)} by {name}; write a file for "
                    f"each"
                )
    if image.value("SliceVector") is None or sorted(slices) != list(range(1, count + 1)):
        raise Refused(
            f"{path}: expected the slices of one volume, each once in SliceVector, got "
            f"{len(set(slices))} of {count}; read_nm reads measured views"
        )
    warn_of_unknown(path, image.private())
    with file_errors(path, "has no position, direction or distance of its slices"):
        corner = _place(image, "ImagePositionPatient", 3)
        axes = _place(image, "ImageOrientationPatient", 6).reshape(2, 3)
        if (pixel_mm := image.pixel_mm("PixelSpacing")) is None:
            raise Refused(f"{path}: expected PixelSpacing in mm, got none")
        between = image.value("SpacingBetweenSlices")
        if between is None and count == 1:
            between = image.value("SliceThickness")
        if between is None:
            raise Refused(
                f"{path}: expected SpacingBetweenSlices in mm, got none; state it (SliceThickness "
                f"is {image.value('SliceThickness')})"
            )
        (between,) = finite(path, "SpacingBetweenSlices", between, 1)
        if np.abs(axes @ axes.T - np.eye(2)).max() > 1e-3:
            raise Refused(f"{path}: expected rows at right angles to columns, got {axes.tolist()}")
        affine = np.eye(4)
        affine[:3, :3] = (
            RAS[:, None]
            * np.stack([*axes, np.cross(axes[0], axes[1])], axis=1)
            * np.array([*pixel_mm[::-1], between])
        )
        affine[:3, 3] = RAS * corner

    def passes() -> Iterator[Planes]:
        values = pixels_of(path).reshape(count, rows, columns)
        yield 0, values[np.argsort(slices)].T

    return oriented(path, (columns, rows, count), affine, passes)


def _only(name: str, items: Sequence[Any]) -> float | None:
    """The number that the items have in common; None if there is none, or several."""
    found = {float(item.get(name)) for item in items if item.get(name) not in (None, "")}
    return found.pop() if len(found) == 1 else None


def _place(image: DicomImage, name: str, count: int) -> np.ndarray:
    """A position or direction of the volume: its detectors', which is the image's as well."""
    detectors = image.value("DetectorInformationSequence") or []
    stated = [image.value(name), *(detector.get(name) for detector in detectors)]
    found = [finite(image.path, name, value, count) for value in stated if value not in (None, "")]
    if not found or not all(same(value, found[0]) for value in found):
        raise Refused(
            f"{image.path}: expected one {name} of its {len(detectors)} detectors and the image, "
            f"got {shown([value.tolist() for value in found])}"
        )
    return found[0]


def _axes(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Voxel spacing and unit vectors (columns x, y, z), LPS."""
    steps = RAS[:, None] * grid.affine.double().numpy()[:3, :3]
    axes = steps / np.linalg.norm(steps, axis=0)
    skew = np.abs(axes.T @ axes - np.eye(3)).max()  # moves the slices, which lie along the normal
    if skew * max(grid.size) * max(grid.spacing) > MOVED * min(grid.spacing):
        raise Refused("Expected a grid whose axes are at right angles for DICOM, got an oblique")
    return steps, axes


def _as_seen(values: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The volume with columns, rows and slices along DICOM's axes, the centre of its first voxel
    and its unit vectors (columns x, y, z), both LPS; slices along x cross y.
    """
    steps, axes = _axes(grid)
    corner = RAS * grid.affine.double().numpy()[:3, 3]
    for axis in range(3):
        along = axes[:, axis]
        ahead = (
            np.cross(axes[:, 0], axes[:, 1]) @ along if axis == 2 else along[abs(along).argmax()]
        )
        if ahead < 0:
            corner = corner + steps[:, axis] * (grid.size[axis] - 1)
            steps[:, axis], axes[:, axis] = -steps[:, axis], -along
            values = np.flip(values, 2 - axis)
    return values, corner, axes


def _described(pydicom: Any, like: str | Path | None) -> Any:
    """A reconstructed NM image without pixels and geometry."""
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    dataset, source = pydicom.Dataset(), {}
    if like is not None:
        source = DicomImage(Path(like).expanduser()).dataset
    for name in SHARED:
        dataset.__setattr__(name, source.get(name, ""))
    for name in ("StudyInstanceUID", "FrameOfReferenceUID"):
        dataset.__setattr__(name, source.get(name) or generate_uid())
    for name in UNKNOWN:
        dataset.__setattr__(name, [])
    if source.get("Modality") == "NM":
        copied = [name for name in ACQUIRED if name in source]
        if len(source.get("EnergyWindowInformationSequence") or []) == 1:
            copied.append("EnergyWindowInformationSequence")
        for name in copied:
            dataset[name] = deepcopy(source[name])
    dataset.SOPClassUID, dataset.SOPInstanceUID = NM, generate_uid()
    dataset.SeriesInstanceUID, dataset.SeriesNumber, dataset.InstanceNumber = generate_uid(), 1, 1
    dataset.Modality, dataset.Manufacturer, dataset.PositionReferenceIndicator = "NM", "", ""
    dataset.SeriesDescription = "mvrecon"
    dataset.ImageType = ["DERIVED", "PRIMARY", "RECON TOMO", "EMISSION"]
    dataset.FrameIncrementPointer = pydicom.tag.Tag("SliceVector")
    dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 16, 16, 15
    dataset.PixelRepresentation, dataset.NumberOfDetectors, dataset.NumberOfEnergyWindows = 0, 1, 1
    dataset.DetectorInformationSequence = [pydicom.Dataset()]
    unit = pydicom.Dataset()
    unit.CodingSchemeDesignator = "UCUM"
    mapped = pydicom.Dataset()
    mapped.RealWorldValueFirstValueMapped, mapped.RealWorldValueLastValueMapped = 0, 65535
    mapped.LUTLabel = mapped.LUTExplanation = "value"
    mapped.MeasurementUnitsCodeSequence = [unit]
    dataset.RealWorldValueMappingSequence = [mapped]
    dataset.file_meta = pydicom.dataset.FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset.file_meta.MediaStorageSOPClassUID = NM
    dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    return dataset


def _text(value: float) -> str:
    """Format a number with the most digits that fit into the 16 characters of DICOM's decimals."""
    texts = (f"{float(value):.{digits}g}" for digits in range(15, 8, -1))
    return next(text for text in texts if len(text) <= 16)
