"""One DICOM file: its header and its pixels. Needs pydicom, the extra `io`."""

from pathlib import Path
from typing import Any

import numpy as np

from mvrecon.core.files.checks import EDGE, VOLUME, Refused, file_errors

#: Endings of DICOM files; a file of another name is one if it says so from byte 128 on.
DICOM = (".dcm", ".dicom", ".ima")
MAGIC = 128
#: Where the frames of an enhanced image have what a plain slice has itself.
GROUPS = {
    "ImagePositionPatient": "PlanePositionSequence",
    "ImageOrientationPatient": "PlaneOrientationSequence",
    "PixelSpacing": "PixelMeasuresSequence",
    "RescaleSlope": "PixelValueTransformationSequence",
    "RescaleIntercept": "PixelValueTransformationSequence",
}
#: The one packed transfer syntax that pydicom reads alone.
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
        Refused: not DICOM, cut short, in colour, or without an image.
    """
    with file_errors(path, "cannot be read as DICOM"):
        dataset = _pydicom(path).dcmread(path, stop_before_pixels=True)
        rows, columns = int(dataset.get("Rows") or 0), int(dataset.get("Columns") or 0)
        if not (0 < rows <= EDGE and 0 < columns <= EDGE):
            raise Refused(f"{path}: expected a DICOM image, got {rows} x {columns} pixels")
        if (colours := int(dataset.get("SamplesPerPixel") or 1)) != 1:
            raise Refused(f"{path}: expected one grey value a pixel, got {colours}")
    return dataset


def frames_of(dataset: Any) -> int:
    """Number of frames of a DICOM image, 1 without such a number."""
    return int(dataset.get("NumberOfFrames") or 1)


def enhanced(dataset: Any) -> bool:
    """Whether an image has functional groups, which describe its frames (PS3.3, C.7.6.16)."""
    return bool(dataset.get("PerFrameFunctionalGroupsSequence"))


def value_of(dataset: Any, name: str, frame: int = 0) -> Any:
    """A value of a frame: the image's own, the frame's, or that which all frames share; None where
    there is none.

    Args:
        dataset: of the image.
        name: such as ImagePositionPatient, one of `GROUPS`.
        frame: from 0.
    """
    if dataset.get(name) is not None:
        return dataset.get(name)
    own, shared = (
        dataset.get(f"{kind}FunctionalGroupsSequence") or [] for kind in ("PerFrame", "Shared")
    )
    for groups in (*own[frame : frame + 1], *shared[:1]):
        if macro := groups.get(GROUPS[name]):
            return macro[0].get(name)
    return None


def pixels_of(path: Path) -> np.ndarray:
    """Pixels of a DICOM image, slope and intercept applied, float32: [v u], or [m v u] of frames.

    MONOCHROME1 and windows change how a screen shows the values, not the values.

    Raises:
        ImportError: pydicom is not installed.
        Refused: cut short or damaged, or compressed in a way that SimpleITK does not read either.
    """
    with file_errors(path, "has pixels that cannot be read"):
        dataset = _pydicom(path).dcmread(path)
        frames = frames_of(dataset)
        if 4 * frames * int(dataset.Rows) * int(dataset.Columns) > VOLUME:
            raise Refused(f"{path}: expected at most {VOLUME} bytes of pixels, got more")
        syntax = dataset.file_meta.TransferSyntaxUID
        if syntax.is_encapsulated and syntax != RLE:
            if enhanced(dataset):
                raise Refused(f"{path}: expected frames unpacked or as RLE, got {syntax.name}")
            return _decompressed(path, frames)
        values = dataset.pixel_array.astype(np.float32)
        slope, intercept = (
            _of_frames(dataset, name, usual, frames)
            for name, usual in (("RescaleSlope", 1), ("RescaleIntercept", 0))
        )
        return values * slope + intercept


def _of_frames(dataset: Any, name: str, usual: float, frames: int) -> np.ndarray:
    """A number for each frame, [m 1 1]; one number without axes where there is one frame."""
    values = [value_of(dataset, name, frame) for frame in range(frames)]
    numbers = np.array([usual if value is None else float(value) for value in values], np.float32)
    return numbers[:, None, None] if frames > 1 else numbers[0]


def _decompressed(path: Path, frames: int) -> np.ndarray:
    """SimpleITK's values, which have slope and intercept applied."""
    from mvrecon.data.itk import simple_itk

    image = simple_itk(path)
    values = image.GetArrayFromImage(image.ReadImage(str(path), imageIO="GDCMImageIO"))
    return (values if frames > 1 else values.squeeze(0)).astype(np.float32)


def _pydicom(path: Path) -> Any:
    try:
        import pydicom
    except ImportError as error:
        raise ImportError(f"{path}: DICOM needs pydicom: pip install 'mvrecon[io]'") from error
    return pydicom
