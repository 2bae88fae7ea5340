"""The pixels of a DICOM image: stored numbers, plain or compressed, and their scale. Needs pydicom,
and SimpleITK for other compressions than RLE: the extra `io`.
"""

import math
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from mvrecon.core.files.checks import VOLUME, Refused, file_errors, io_library
from mvrecon.data.dicom_image import DicomImage, finite

#: The only compressed transfer syntax that pydicom decodes by itself.
RLE = "1.2.840.10008.1.2.5"


class Scale(NamedTuple):
    """Values of a frame: slope times stored number plus intercept, for stored numbers within one of
    the `ranges`, each from a first to a last.
    """

    slope: float
    intercept: float
    ranges: tuple[tuple[float, float], ...] = ((-np.inf, np.inf),)


def scales_of(image: DicomImage) -> list[Scale]:
    """The scale of each frame: RescaleSlope and RescaleIntercept, else its real world value mapping
    (PS3.3, C.7.6.16.2.11), else the stored numbers.

    Raises:
        Refused: a mapping that differs from RescaleSlope and RescaleIntercept, several that differ,
            one by a look-up table or of some frames alone, or values of a frame that differ.
    """
    name = "RealWorldValueMappingSequence"
    with file_errors(image.path, f"has a RescaleSlope or {name} of no numbers"):
        mapped = [
            [_mapping(image.path, item) for _, items in image.stated(name, frame) for item in items]
            for frame in range(image.frames)
        ]
        if 0 < (count := sum(map(bool, mapped))) < image.frames:
            raise Refused(
                f"{image.path}: expected a {name} of every frame or of none, got it of {count} of "
                f"{image.frames} frames"
            )
        stated = (image.values(key) for key in ("RescaleSlope", "RescaleIntercept"))
        return [
            _scale(image.path, slope, intercept, mappings)
            for slope, intercept, mappings in zip(*stated, mapped, strict=True)
        ]


def _scale(path: Path, slope: Any, intercept: Any, mappings: Sequence[Scale]) -> Scale:
    """The scale of a frame by what it states, None if missing."""
    scale = Scale(
        1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept)
    )
    if mappings and slope is None and intercept is None:
        ranges = (part for mapping in mappings for part in mapping.ranges)
        scale = mappings[0]._replace(ranges=tuple(ranges))
    if not np.isfinite(scale[:2]).all() or scale.slope == 0:
        raise Refused(
            f"{path}: expected a finite slope, not 0, and a finite intercept, got {scale[:2]}"
        )
    for other in mappings:
        relative = np.array([other[:2], scale[:2]]) / scale.slope
        if not np.allclose(*relative, rtol=1e-5, atol=1e-6):
            raise Refused(
                f"{path}: expected a RealWorldValueMappingSequence that agrees with the slope "
                f"{scale.slope:g} and intercept {scale.intercept:g} of its pixels, got "
                f"{other.slope:g} and {other.intercept:g}; keep the one that is meant"
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
    return Scale(slope, intercept, ((float(first), float(last)),))


def stored_type(image: DicomImage) -> tuple[np.dtype, tuple[float, float] | None]:
    """Type of the stored numbers, and the least and the largest of BitsStored; none of floats."""
    allocated, stored, sign = map(
        image.value, ("BitsAllocated", "BitsStored", "PixelRepresentation")
    )
    if stored is None or not allocated:
        return np.dtype("f4"), None
    signed, bits = int(sign or 0), int(stored)
    kind = np.dtype(f"{'i' if signed else 'u'}{max(1, int(allocated) // 8)}")
    return kind, (-float(2 ** (bits - 1)) if signed else 0.0, float(2 ** (bits - signed) - 1))


def pixels_of(path: Path, air: float | None = None) -> Float[np.ndarray, "*m v u"]:
    """Pixels of a DICOM image, scaled by `scales_of`, float32: [v u], or [m v u] of frames.

    Ignores MONOCHROME1 and windows, which affect display only.

    Args:
        path: path of the image.
        air: greatest value of padding pixels; None: padding is refused, but of NM where it has zero
            counts.

    Raises:
        ImportError: pydicom is not installed.
        Refused: cut short or damaged, numbers outside the range of a mapping, padding, or a
            compression that SimpleITK does not support either.
    """
    image = DicomImage(path, pixels=True)
    stored = _stored_pixels(image)
    values = stored.astype(np.float32)
    views, raws = (x.reshape(image.frames, *image.shape) for x in (values, stored))
    for frame, (part, raw, scale) in enumerate(zip(views, raws, scales_of(image), strict=True)):
        padding = _padding(image, raw, frame)
        counts = scale.slope * raw[padding].astype(np.float64) + scale.intercept
        zero = image.value("Modality") == "NM" and not counts.any()
        if air is None and padding.any() and not zero:
            raise Refused(
                f"{path}: expected measured pixels alone, got {int(padding.sum())} of its "
                f"PixelPaddingValue in frame {frame}; cut the images to the measured region"
            )
        mapped = [(part >= first) & (part <= last) for first, last in scale.ranges]
        if not (np.logical_or.reduce(mapped) | padding).all():
            raise Refused(
                f"{path}: expected stored numbers from "
                f"{' or '.join(f'{first:g} to {last:g}' for first, last in scale.ranges)}, for "
                f"which its RealWorldValueMappingSequence holds, got {part.min():g} to "
                f"{part.max():g}"
            )
        if scale[:2] != (1.0, 0.0):
            part *= np.float32(scale.slope)
            part += np.float32(scale.intercept)
        if air is not None and padding.any():
            part[padding] = np.minimum(part[padding], air)
    return values


def _padding(
    image: DicomImage, stored: Shaped[np.ndarray, "v u"], frame: int
) -> Bool[np.ndarray, "v u"]:
    """Pixels within PixelPaddingValue and PixelPaddingRangeLimit, of integers or of floats."""
    kind = {"f4": "Float", "f8": "DoubleFloat"}.get(stored.dtype.str[1:], "")
    stated = {
        name: value
        for end in ("Value", "RangeLimit")
        if (value := image.values(name := f"{kind}PixelPadding{end}")[frame]) is not None
    }
    if f"{kind}PixelPaddingValue" not in stated:
        return np.zeros(stored.shape, bool)
    ends = np.concatenate([finite(image.path, name, v, 1) for name, v in stated.items()])
    ends = ends if kind else ends.astype("i8")  # 63536 is -2000 of 16 bits with a sign
    low, high = np.sort(ends.astype(stored.dtype))[[0, -1]]
    return (stored >= low) & (stored <= high)


def _stored_pixels(image: DicomImage) -> Shaped[np.ndarray, "*m v u"]:
    """Stored numbers of a DICOM image: [v u], or [m v u] of frames.

    Raises:
        ImportError, Refused: see `pixels_of`.
    """
    path, dataset, count = image.path, image.dataset, image.frames
    with file_errors(path, "has pixels that cannot be read"):
        if 4 * count * math.prod(image.shape) > VOLUME:
            raise Refused(f"{path}: expected at most {VOLUME} bytes of pixels, got more")
        if (found := _frames_in(dataset, math.prod(image.shape))) > count:
            raise Refused(
                f"{path}: expected pixels of as many frames as NumberOfFrames, {count}, got those "
                f"of {found}; state their number"
            )
        syntax = dataset.file_meta.TransferSyntaxUID
        if not syntax.is_encapsulated or syntax == RLE:
            return dataset.pixel_array
        kind, _ = stored_type(image)
        above = 8 * kind.itemsize - int(dataset.BitsStored)  # bits to clear, or those of the sign
        values = _unpacked(path, dataset).astype(kind) << above >> above
        return values.reshape((count, *image.shape) if count > 1 else image.shape)


def _frames_in(dataset: Any, pixels: int) -> int:
    """Number of whole frames of the pixel data, by its bytes or, compressed, its code streams."""
    data = dataset.get("PixelData")
    if data is None:  # floats, whose size pydicom checks
        return 0
    syntax = dataset.file_meta.TransferSyntaxUID
    if not syntax.is_encapsulated:
        return int(len(data) // max(2, pixels * int(dataset.BitsAllocated) / 8))
    from pydicom.encaps import generate_fragments, parse_basic_offsets

    with BytesIO(data) as buffer:
        parse_basic_offsets(buffer)
        parts = generate_fragments(buffer)
        return sum(syntax == RLE or part[:2] in (b"\xff\xd8", b"\xff\x4f") for part in parts)


#: Attributes that describe stored numbers.
STORED = (
    "SamplesPerPixel Rows Columns NumberOfFrames BitsAllocated BitsStored HighBit "
    "PixelRepresentation PixelData"
).split()
#: Multi-frame Grayscale Word Secondary Capture.
CAPTURE = "1.2.840.10008.5.1.4.1.1.7.3"


def _unpacked(path: Path, dataset: Any) -> Integer[np.ndarray, "m v u"]:
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
    return values
