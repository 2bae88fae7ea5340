"""DICOM NM volumes: a reconstruction with its geometry as one multi-frame file (RECON TOMO).
Requires pydicom.

Convention: DICOM's world is LPS, ours is RAS. Position and orientation of an NM volume are in its
DetectorInformationSequence (PS3.3, C.8.4.11); slices are stacked along rows x columns.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, io_library
from mvrecon.data.dicom import RAS, header_of
from mvrecon.geometry.grid import Grid

#: NM Image Storage.
NM = "1.2.840.10008.5.1.4.1.1.20"
#: Attributes that a volume copies from its study; empty if the study lacks them.
SHARED = (
    "PatientName PatientID PatientBirthDate PatientSex StudyInstanceUID StudyID StudyDate "
    "StudyTime StudyDescription AccessionNumber ReferringPhysicianName FrameOfReferenceUID"
).split()
#: Attributes that may be unknown (type 2), as empty sequences.
UNKNOWN = (
    "PatientOrientationCodeSequence PatientGantryRelationshipCodeSequence "
    "EnergyWindowInformationSequence RadiopharmaceuticalInformationSequence"
).split()


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
            copied.
        unit: unit of the values, in UCUM.

    Raises:
        ImportError: pydicom is not installed.
        Refused: `like` is not a DICOM image.
        ValueError: a volume with another shape than the grid or with values that are not finite, or
            a grid whose axes are not orthogonal.
    """
    values = volume.detach().cpu().double().numpy()
    if values.shape != grid.shape or not np.isfinite(values).all():
        raise ValueError(
            f"Expected one finite volume [d h w] of the grid's {grid.shape} voxels, got shape "
            f"{values.shape} with {int((~np.isfinite(values)).sum())} values that are not finite"
        )
    values, corner, axes = _as_seen(values, grid)
    low, high = min(0.0, values.min()), values.max()
    slope = (high - low) / 65535 or 1.0
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
    mapped.RealWorldValueSlope, mapped.RealWorldValueIntercept = float(slope), float(low)
    code = mapped.MeasurementUnitsCodeSequence[0]
    code.CodeValue = code.CodeMeaning = unit
    # by the slope as written, with 16 characters
    numbers = np.rint((values - low) / float(_text(slope))).clip(0, 65535)
    dataset.PixelData = numbers.astype("<u2").tobytes()
    with written_whole(Path(path).expanduser()) as part:
        dataset.save_as(part, enforce_file_format=True)


def nm_writer(path: Path, grid: Grid, unit: str) -> Callable[[Float[Tensor, "d h w"]], None]:
    """Return the function that writes a volume of this grid as `write_nm` does, for
    `mvrecon-reconstruct out=volume.dcm`.

    Raises:
        ImportError: pydicom is not installed.
        Refused: a unit other than "activity", or a grid whose axes are not orthogonal.
    """
    io_library("pydicom", path)
    if unit != "activity":
        raise Refused(f"{path}: expected activity for DICOM NM, got a volume in the unit {unit}")
    _axes(grid)
    return partial(write_nm, path, grid=grid)


def _axes(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Voxel spacing and unit vectors (columns x, y, z), LPS."""
    steps = RAS[:, None] * grid.affine.double().numpy()[:3, :3]
    axes = steps / np.linalg.norm(steps, axis=0)
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-5:
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

    dataset, source = pydicom.Dataset(), {} if like is None else header_of(Path(like).expanduser())
    for name in SHARED:
        dataset.__setattr__(name, source.get(name, ""))
    for name in ("StudyInstanceUID", "FrameOfReferenceUID"):
        dataset.__setattr__(name, source.get(name) or generate_uid())
    for name in UNKNOWN:
        dataset.__setattr__(name, [])
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
    """Format a number with the 16 characters of DICOM's decimal strings."""
    return f"{float(value):.9g}"
