"""A DICOM image: its attributes, wherever the file states them, for each frame, and its pixels.
Needs pydicom: the extra `io`.

An attribute may be stated for the image, for all frames in the shared functional groups, and for
each frame in its own (PS3.3, C.7.6.16), there within a sequence of any depth.
"""

import math
import re
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from mvrecon.core.files.checks import EDGE, VOLUME, Refused, file_errors, io_library, shown
from mvrecon.core.files.keys import Key, check_keys

#: Endings of DICOM files; others are recognised by the bytes from 128 on.
DICOM = (".dcm", ".dicom", ".ima")
MAGIC = 128
#: Attributes that change the pixels of any DICOM image.
KEYS = (
    Key("RescaleSlope", "applied", "frame by frame"),
    Key("RescaleIntercept", "applied", "frame by frame"),
    Key(
        "RealWorldValueMappingSequence",
        "applied",
        "where there is no RescaleSlope or RescaleIntercept, else compared with them; refused: a "
        "look-up table, several mappings that differ, or pixels outside the mapped ranges",
    ),
    Key("ModalityLUTSequence", "refused", "store the values that the look-up table gives"),
    Key("DoseGridScaling", "refused", "multiply the values by it", (1,)),
    Key("BitsAllocated", "applied"),
    Key("BitsStored", "applied", "also gives the largest stored value; higher bits are cleared"),
    Key("HighBit", "compared", "with BitsStored: one less"),
    Key(
        "OverlayBitPosition",
        "compared",
        "with BitsStored: overlays in higher bits are cleared, those in lower ones refused",
    ),
    Key("PixelRepresentation", "applied", "sign"),
    Key("NumberOfFrames", "compared", "with the pixels and the functional groups"),
    Key(
        "PixelPaddingValue",
        "applied",
        "padding of a CT is at most air, -1000 HU; elsewhere refused where a pixel has it",
    ),
    Key("PixelPaddingRangeLimit", "applied", "other end of the padding's range"),
    Key("FloatPixelPaddingValue, DoubleFloatPixelPaddingValue", "applied", "as PixelPaddingValue"),
    Key("PixelAspectRatio", "compared", "with the pixel size; without one refused unless 1"),
    Key(
        "PhotometricInterpretation",
        "refused",
        "one grey value a pixel; MONOCHROME1 affects display alone",
        ("MONOCHROME1", "MONOCHROME2"),
    ),
    Key("SamplesPerPixel", "refused", "one grey value a pixel", (1,)),
    Key("PlanarConfiguration", "ignored", "of colours"),
    Key("WindowCenter, VOILUTSequence, PresentationLUTShape", "ignored", "display alone"),
    Key("MaskSubtractionSequence, FramePixelShiftSequence", "ignored", "display alone"),
)
#: Functional groups whose attributes some files state in the same sequence of the image.
MACROS = {
    f"{name}Sequence"
    for name in (
        "PixelMeasures PlanePosition PlaneOrientation PixelValueTransformation FieldOfView "
        "RealWorldValueMapping FramePixelDataProperties FrameDetectorParameters FrameContent "
        "PixelIntensityRelationshipLUT"
    ).split()
}
#: Sequences of functional groups that describe other images.
OTHERS = re.compile("Referenced|Source|Derivation|Contributing|Original|ConversionSource")
#: The only compressed transfer syntax that pydicom decodes by itself.
RLE = "1.2.840.10008.1.2.5"


def dicom_file(path: Path) -> bool:
    """Whether a file is DICOM, by its ending or, without one, by its first bytes."""
    if path.suffix.lower() in DICOM:
        return True
    with path.open("rb") as file:
        file.seek(MAGIC)
        return file.read(4) == b"DICM"


class DicomImage:
    """The attributes of a DICOM image of one grey value a pixel, for each frame.

    Attributes:
        dataset: of pydicom.
        frames: number of frames, by default 1.
        groups: number of functional groups of single frames: that of the frames, or 0.
        shape: rows and columns.

    Args:
        path: of the file.
        pixels: whether to read its pixels as well.

    Raises:
        ImportError: pydicom is not installed.
        Refused: not DICOM, cut short, in colour, without an image, or with one of the `KEYS` to
            refuse.
    """

    def __init__(self, path: Path, pixels: bool = False):
        self.path = path
        with file_errors(path, "cannot be read as DICOM"):
            pydicom = io_library("pydicom", path)
            self.dataset = dataset = pydicom.dcmread(path, stop_before_pixels=not pixels)
            rows, columns = int(dataset.get("Rows") or 0), int(dataset.get("Columns") or 0)
            if not (0 < rows <= EDGE and 0 < columns <= EDGE):
                raise Refused(f"{path}: expected a DICOM image, got {rows} x {columns} pixels")
            self.shape, self.frames = (rows, columns), int(dataset.get("NumberOfFrames") or 1)
            own = dataset.get("PerFrameFunctionalGroupsSequence") or []
            if self.frames < 1 or len(own) not in (0, self.frames):
                raise Refused(
                    f"{path}: expected a functional group of each of its NumberOfFrames, got "
                    f"{self.frames} with {len(own)} groups"
                )
            self.groups = len(own)
            self._image = [("the image", _holders(dataset, {}, MACROS.__contains__))]
            for group in dataset.get("SharedFunctionalGroupsSequence") or []:
                self._image.append(("the shared functional groups", _holders(group, {})))
            self._frames = [(f"frame {k}", _holders(group, {})) for k, group in enumerate(own)]
            self._values: dict[str, list[Any]] = {}
            self._check_bits()
        self.check(KEYS)

    def stated(self, name: str, frame: int | None = None) -> list[tuple[str, Any]]:
        """All values of an attribute that are not empty, each with its place in words.

        Args:
            name: such as RescaleSlope.
            frame: of this frame alone: the image's, the shared and its own; None: of all.
        """
        own = self._frames if frame is None else self._frames[frame : frame + 1]
        found = []
        with file_errors(self.path, f"has a {name} that cannot be read"):
            for place, holders in (*self._image, *own):
                found += [(place, group[name].value) for group in holders.get(name, ())]
        return [(place, value) for place, value in found if not _empty(value)]

    def values(self, name: str) -> list[Any]:
        """The value of an attribute for each frame; None where it is missing.

        Raises:
            Refused: several values of one frame that differ, or frames of which some have one.
        """
        if name not in self._values:
            frames = range(self.frames if self.groups else 1)
            values = [self._agreed(name, frame) for frame in frames]
            if (count := sum(value is not None for value in values)) not in (0, len(values)):
                raise Refused(
                    f"{self.path}: expected {name} of every frame or of none, got it of {count} of "
                    f"{len(values)} frames"
                )
            self._values[name] = values if self.groups else values * self.frames
        return self._values[name]

    def value(self, name: str) -> Any:
        """The value of an attribute that all frames have in common; None if it is missing.

        Raises:
            Refused: it differs between frames; see `values`.
        """
        values = self.values(name)
        for frame, other in enumerate(values):
            if not same(values[0], other):
                raise Refused(
                    f"{self.path}: expected one {name} of all frames, got {shown(values[0])} of "
                    f"frame 0 and {shown(other)} of frame {frame}; write a file for each"
                )
        return values[0]

    def numbers(self, name: str, count: int) -> list[np.ndarray]:
        """Finite numbers of each frame [count].

        Raises:
            Refused: missing, another number of them, or not finite; see `values`.
        """
        return [finite(self.path, name, value, count) for value in self.values(name)]

    def check(self, keys: Sequence[Key]) -> None:
        """Raise if a key to refuse is stated anywhere in the file with a value not allowed."""
        for key in keys:
            for place, value in self.stated(key.name) if key.use == "refused" else []:
                where = f"{self.path}{'' if place == 'the image' else f', {place}'}"
                check_keys(where, [key], {key.name: value}.get)

    def pixel_mm(self, *names: str) -> tuple[float, float] | None:
        """Size of a pixel (v, u) in mm by the first of some attributes that the file has; None if
        it has none.

        Raises:
            Refused: several that differ, sizes that are no positive numbers, or a PixelAspectRatio
                that contradicts them.
        """
        sizes = [(name, value) for name in names if (value := self.value(name)) is not None]
        ratio = self.value("PixelAspectRatio")
        pitches = [finite(self.path, name, value, 2) for name, value in sizes]
        for (name, _), pitch in zip(sizes, pitches, strict=True):
            if pitch.min() <= 0 or not same(pitch, pitches[0]):
                raise Refused(
                    f"{self.path}: expected positive pixel sizes that agree, got {name} "
                    f"{pitch.tolist()} and {sizes[0][0]} {pitches[0].tolist()}; keep the detector's"
                )
        if ratio is not None:
            down, along = finite(self.path, "PixelAspectRatio", ratio, 2)
            got = pitches[0][0] / pitches[0][1] if pitches else 1.0
            if not np.isclose(down, got * along, rtol=1e-3):
                raise Refused(
                    f"{self.path}: expected a PixelAspectRatio (rows to columns) of {got:g} as its "
                    f"pixel size has, got {down:g} to {along:g}; state {' or '.join(names)} in mm"
                )
        return (float(pitches[0][0]), float(pitches[0][1])) if pitches else None

    def _agreed(self, name: str, frame: int) -> Any:
        found = self.stated(name, frame)
        for place, value in found:
            if not same(value, found[0][1]):
                raise Refused(
                    f"{self.path}: expected one {name} of frame {frame} wherever it is stated, got "
                    f"{shown(found[0][1])} of {found[0][0]} and {shown(value)} of {place}; keep "
                    f"the one that is meant"
                )
        return found[0][1] if found else None

    def _check_bits(self) -> None:
        """Raise for values that do not fill the lowest bits of a pixel, or share these."""
        stored, high = self.value("BitsStored"), self.value("HighBit")
        if stored is None:
            return
        if high is not None and int(high) != int(stored) - 1:
            raise Refused(
                f"{self.path}: expected HighBit {int(stored) - 1}, one less than BitsStored, got "
                f"{high}; shift the pixels to the lowest bits"
            )
        for group in range(0x6000, 0x6020, 2):  # overlays
            allocated, bit, data = (
                self.dataset.get((group, element)) for element in (0x0100, 0x0102, 0x3000)
            )
            size, place = (int(e.value or 0) if e is not None else 0 for e in (allocated, bit))
            if data is None and (size > 1 or place > 0) and place < int(stored):
                raise Refused(
                    f"{self.path}: expected an overlay in bits above BitsStored {stored}, got "
                    f"OverlayBitPosition {place}, which is part of the pixel values; clear it"
                )


def _holders(
    group: Any, held: dict[str, list[Any]], inside: Callable[[str], bool] | None = None
) -> dict[str, list[Any]]:
    """The data sets with each attribute: a functional group, and those nested in its sequences.

    Args:
        group: of pydicom.
        held: is extended.
        inside: whether to enter a sequence; by default, if it does not describe other images.
    """
    from pydicom.datadict import keyword_for_tag

    for tag in list(group.keys()):
        name = keyword_for_tag(tag)  # none of private attributes
        held.setdefault(name, []).append(group)
        enter = inside(name) if inside else not OTHERS.match(name)
        if name.endswith("Sequence") and enter:
            for item in group[tag].value or []:
                _holders(item, held)
    return held


def _empty(value: Any) -> bool:
    return value is None or (hasattr(value, "__len__") and len(value) == 0)


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal: numbers to 1e-5 of the greatest, text regardless of case, and
    None to itself.
    """
    if one is None or other is None:
        return one is other
    try:
        a, b = (np.array(v, float) for v in (one, other))
    except (TypeError, ValueError):
        if isinstance(one, str) and isinstance(other, str):
            return one.strip().lower() == other.strip().lower()
        return bool(one == other)
    return a.shape == b.shape and bool(
        (np.abs(a - b) <= 1e-5 * max(np.abs(a).max(), np.abs(b).max())).all()
    )


def finite(path: Path, name: str, value: Any, count: int) -> np.ndarray:
    """An attribute as finite numbers [count].

    Raises:
        Refused: missing, another number of them, or not finite.
    """
    with file_errors(path, f"has a {name} that cannot be read"):
        values = np.array([] if value is None else [float(x) for x in np.atleast_1d(value)])
        if values.shape != (count,) or not np.isfinite(values).all():
            raise Refused(f"{path}: expected {name} as {count} finite numbers, got {shown(value)}")
    return values


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
        path: of the image.
        air: greatest value of padding pixels; None: padding is refused.

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
        if air is None and padding.any():
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
