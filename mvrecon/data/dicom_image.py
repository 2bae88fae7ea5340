"""The attributes of a DICOM image, wherever the file states them, for each frame. Needs pydicom:
the extra `io`.

An attribute may be stated for the image, for all frames in the shared functional groups, and for
each frame in its own (PS3.3, C.7.6.16), there within a sequence of any depth.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from mvrecon.core.files.checks import EDGE, Refused, file_errors, io_library, shown
from mvrecon.core.files.keys import FREE_TEXT, Key, check_keys, has_effect
from mvrecon.core.files.prose import stated_effects

#: Endings of DICOM files; others are recognised by the bytes from 128 on, or, without these, by a
#: short element of the group 2 or 8 at their beginning: with a type of two letters, or a length.
DICOM = (".dcm", ".dicom", ".ima")
MAGIC = 128
BARE = re.compile(rb"[\x02\x08]\0[\0-\x18]\0(UL|UI|CS|DA|TM|OB|[\0-\x80]\0\0\0)", re.DOTALL)
#: Beginning of the SOP classes of DICOM's objects.
SOP_CLASSES = "1.2.840.10008.5.1.4."
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
        "padding of a CT is at most air, -1000 HU, and of NM zero counts; else refused where a "
        "pixel has it",
    ),
    Key("PixelPaddingRangeLimit", "applied", "other end of the padding's range"),
    Key(
        "FloatPixelPaddingValue, FloatPixelPaddingRangeLimit, DoubleFloatPixelPaddingValue, "
        "DoubleFloatPixelPaddingRangeLimit",
        "applied",
        "as PixelPaddingValue",
    ),
    Key("PixelAspectRatio", "compared", "with the pixel size; without one refused unless 1"),
    Key(
        "PhotometricInterpretation",
        "refused",
        "one grey value per pixel; MONOCHROME1 affects display alone",
        ("MONOCHROME1", "MONOCHROME2"),
    ),
    Key("SamplesPerPixel, Planes", "refused", "one grey value per pixel", (1,)),
    Key(
        "SegmentationType, SegmentationFractionalType, MaximumFractionalValue",
        "refused",
        "an image, not labels",
    ),
    Key(
        "BurnedInAnnotation",
        "refused",
        "measured pixels, without text in them; state NO where there is none",
        ("NO",),
    ),
    Key("PlanarConfiguration", "ignored", "of colours"),
    Key(
        "LossyImageCompression, LossyImageCompressionRatio, LossyImageCompressionMethod",
        "ignored",
        "values are those that are decoded",
    ),
    Key(
        "WindowCenter, WindowWidth, VOILUTFunction, VOILUTSequence, PresentationLUTShape, "
        "PixelPresentation, OverlayData, ShutterShape, FrameDisplayShutterSequence, "
        "MaskSubtractionSequence, FramePixelShiftSequence",
        "ignored",
        "display alone",
    ),
    Key(
        "SmallestImagePixelValue, LargestImagePixelValue, QualityControlImage",
        "ignored",
        "statistics and purpose",
    ),
)
#: Attributes of a part of a multi-frame image that is stored in several files, and the refusal of
#: one where they are not joined.
PARTS = ("ConcatenationUID", "InConcatenationNumber", "InConcatenationTotalNumber")
ONE_FILE = [Key(name, "refused", "join the parts of the image in one file") for name in PARTS[:2]]
#: Maximum number of frames.
FRAMES = 2**16
#: Functional groups whose attributes some files state in the same sequence of the image.
MACROS = {
    f"{name}Sequence"
    for name in (
        "PixelMeasures PlanePosition PlaneOrientation PixelValueTransformation FieldOfView "
        "RealWorldValueMapping FramePixelDataProperties FrameDetectorParameters FrameContent "
        "PixelIntensityRelationshipLUT Exposure XRayFilter XRayGrid XRayAcquisitionDose "
        "XRayGeometry IsocenterReferenceSystem PositionerPosition DetectorPosition TablePosition "
        "FrameAcquisition XAXRFFrameCharacteristics PerProjectionAcquisition "
        "CTImageFrameType XRay3DFrameType CTExposure CTXRayDetails CTReconstruction CTGeometry "
        "CTPosition CardiacSynchronization RespiratorySynchronization TemporalPosition "
        "MultienergyCTProcessing MultienergyCTCharacteristics"
    ).split()
}
#: Private attributes of projections in DICOM-CT-PD (Chen and others, Med. Phys. 42, 2015; user
#: manual of 2020) by tag in the first block of its group, and the type of their numbers, "" of
#: text: pydicom reads those of an unknown type as bytes.
PRIVATE = {
    0x70291002: ("DetectorElementTransverseSpacing", "<f4"),
    0x70291006: ("DetectorElementAxialSpacing", "<f4"),
    0x7029100B: ("DetectorShape", ""),
    0x70291010: ("NumberofDetectorRows", "<u2"),
    0x70291011: ("NumberofDetectorColumns", "<u2"),
    0x70311001: ("DetectorFocalCenterAngularPosition", "<f4"),
    0x70311002: ("DetectorFocalCenterAxialPosition", "<f4"),
    0x70311003: ("DetectorFocalCenterRadialDistance", "<f4"),
    0x70311031: ("ConstantRadialDistance", "<f4"),
    0x70311033: ("DetectorCentralElement", "<f4"),
    0x7033100B: ("SourceAngularPositionShift", "<f4"),
    0x7033100C: ("SourceAxialPositionShift", "<f4"),
    0x7033100D: ("SourceRadialDistanceShift", "<f4"),
    0x7033100E: ("FlyingFocalSpotMode", ""),
    0x70331013: ("NumberofSourceAngularSteps", "<u2"),
    0x7033105D: ("SourceIndex", "<u2"),
    0x70331061: ("NumberofSpectra", "<u2"),
    0x70331063: ("SpectrumIndex", "<u2"),
    0x70331065: ("PhotonStatistics", "<f4"),
    0x70331067: ("Timestamp", "<f4"),
    0x70371009: ("TypeofProjectionData", ""),
    0x7037100A: ("TypeofProjectionGeometry", ""),
    0x70391003: ("BeamHardeningCorrectionFlag", ""),
    0x70391004: ("GainCorrectionFlag", ""),
    0x70391005: ("DarkFieldCorrectionFlag", ""),
    0x70391006: ("FlatFieldCorrectionFlag", ""),
    0x70391007: ("BadPixelCorrectionFlag", ""),
    0x70391008: ("ScatterCorrectionFlag", ""),
    0x70391009: ("LogFlag", ""),
    0x70411001: ("WaterAttenuationCoefficient", ""),
}
#: Words in the names of other private attributes, as pydicom knows them, which scale, correct or
#: turn the pixels, and the value that does not.
EFFECTS = {
    r"pixel scal(e|ing)|rescale slope|fscalar|(scal(e|ing)|dose calibration|decay) factor\b": 1,
    r"pixel offset|rescale intercept": 0,
    r"(image|pet) flip|image rotation(?! angle)|flipped|flip flag|mirror": 0,
    r"(decay|scatter|attenuation)\b.* flag": 0,
    r"decay correction$": "NONE",
}
#: Attributes of free text that may say how values were derived.
TEXTS = ("ImageComments", "FrameComments", "AcquisitionDeviceProcessingDescription")
#: Derivations that change no values beyond a codec's errors.
COMPRESSED = re.compile("compress|jpeg|encod", re.IGNORECASE)
#: Attributes of X-ray images and of measured counts that say how values were derived.
DERIVED = (
    Key(
        "DerivationDescription, DerivationCodeSequence",
        "compared",
        "with compression; a warning names other derivations",
    ),
    Key(", ".join(TEXTS[:2]), "ignored", FREE_TEXT),  # the third is also compared, of projections
)
#: Sequences of functional groups that describe other images.
OTHERS = re.compile("Referenced|Source|Derivation|Contributing|Original|ConversionSource")


def dicom_file(path: Path) -> bool:
    """Whether a file is DICOM, by its ending or, without one, by its first bytes."""
    if path.suffix.lower() in DICOM:
        return True
    with path.open("rb") as file:
        head = file.read(MAGIC + 4)
    return head[MAGIC:] == b"DICM" or bool(BARE.match(head))


def dataset_of(path: Path, **options: Any) -> Any:
    """The data set of a DICOM file by pydicom, also of one without its first 132 bytes or its file
    meta information, as older archives store it.

    Raises:
        ImportError: pydicom is not installed.
        Refused: not DICOM, or cut short.
    """
    with file_errors(path, "cannot be read as DICOM"):
        pydicom = io_library("pydicom", path)
        with path.open("rb") as file:
            bare = bool(BARE.match(file.read(MAGIC)))
        dataset = pydicom.dcmread(path, force=bare, **options)
        if bare and not str(dataset.get("SOPClassUID")).startswith(SOP_CLASSES):
            raise Refused(f"{path}: expected DICOM with a SOPClassUID, got none")
        if "TransferSyntaxUID" not in dataset.file_meta:
            if "PixelData" in dataset and dataset["PixelData"].is_undefined_length:
                raise Refused(
                    f"{path}: expected a TransferSyntaxUID of compressed pixels, got none"
                )
            kind = "Implicit" if dataset.original_encoding[0] else "Explicit"
            syntax = getattr(pydicom.uid, f"{kind}VRLittleEndian")
            dataset.file_meta.TransferSyntaxUID = syntax
    return dataset


class DicomImage:
    """The attributes of a DICOM image of one grey value per pixel, for each frame.

    Attributes:
        dataset: the data set as pydicom reads it.
        frames: number of frames, by default 1.
        groups: number of functional groups of single frames: that of the frames, or 0.
        shape: rows and columns.

    Args:
        path: path of the file.
        pixels: whether to read its pixels as well.

    Raises:
        ImportError: pydicom is not installed.
        Refused: not DICOM, cut short, in colour, without an image, or with one of the `KEYS` to
            refuse.
    """

    def __init__(self, path: Path, pixels: bool = False):
        self.path = path
        with file_errors(path, "cannot be read as DICOM"):
            self.dataset = dataset = dataset_of(path, stop_before_pixels=not pixels)
            rows, columns = int(dataset.get("Rows") or 0), int(dataset.get("Columns") or 0)
            if not (0 < rows <= EDGE and 0 < columns <= EDGE):
                raise Refused(
                    f"{path}: expected a DICOM image, got {dataset.get('Modality') or 'one'} of "
                    f"{rows} x {columns} pixels; move structures, plans and reports to another "
                    f"folder"
                )
            self.shape, self.frames = (rows, columns), int(dataset.get("NumberOfFrames") or 1)
            if not 0 < self.frames <= FRAMES:
                raise Refused(f"{path}: expected NumberOfFrames 1 to {FRAMES}, got {self.frames}")
            own = dataset.get("PerFrameFunctionalGroupsSequence") or []
            if len(own) not in (0, self.frames):
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
            name: name of the attribute, such as RescaleSlope.
            frame: number of a frame, for the values of this frame alone: the image's, the shared
                and its own; None: those of all.
        """
        own = self._frames if frame is None else self._frames[frame : frame + 1]
        found = []
        with file_errors(self.path, f"has a {name} that cannot be read"):
            for place, holders in (*self._image, *own):
                found += [(place, _value(group[tag])) for group, tag in holders.get(name, ())]
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
            for name in key.names if key.use == "refused" else []:
                for place, value in self.stated(name):
                    where = f"{self.path}{'' if place == 'the image' else f', {place}'}"
                    check_keys(where, [key._replace(name=name)], {name: value}.get)

    def check_words(self, refused: Mapping[str, Collection[str]], expected: str) -> None:
        """Raise if an attribute contains one of its words to refuse anywhere in the file.

        Args:
            refused: words in capitals by the name of the attribute.
            expected: what is expected, for the message.
        """
        for name, words in refused.items():
            for _, value in self.stated(name):
                found = " ".join(map(str, np.atleast_1d(value))).upper().split()
                if wrong := sorted({*found} & {*words}):
                    raise Refused(
                        f"{self.path}: expected {expected}, got {name} with {', '.join(wrong)}"
                    )

    def derived(self) -> list[str]:
        """How the image says that its values were derived, but by compression, and what its
        comments state of them.
        """
        texts = [str(text) for _, text in self.stated("DerivationDescription")]
        codes = [code for _, items in self.stated("DerivationCodeSequence") for code in items]
        texts += [str(code.get("CodeMeaning", "")) for code in codes]
        found = [f"derivation {text!r}" for text in texts if text and not COMPRESSED.search(text)]
        return found + stated_effects(
            (name, str(text)) for name in TEXTS for _, text in self.stated(name)
        )

    def private(self) -> list[str]:
        """Private attributes with a name of pydicom's dictionary by which they may change the
        pixels (`EFFECTS`), with their creators and values.
        """
        found = []
        with file_errors(self.path, "has private attributes that cannot be read"):
            for _, holders in (*self._image, *self._frames):
                for group, tag in holders.get("", ()):
                    name = _private_name(group, tag)
                    value = group[tag].value if has_effect(name, np.nan, EFFECTS) else ()
                    stated = [] if _empty(value) else np.atleast_1d(value).tolist()
                    if any(has_effect(name, one, EFFECTS) for one in stated):
                        found.append(f"{name} {shown(value)} of {group[tag].private_creator}")
        return found

    def pixel_mm(self, *names: str) -> tuple[float, float] | None:
        """Size of a pixel (v, u) in mm by the first of some attributes that the file has; None if
        it has none. A name such as "A, B" is of two attributes, for v and u.

        Raises:
            Refused: several that differ, sizes that are no positive numbers, or a PixelAspectRatio
                that contradicts them.
        """
        stated = [(name, [self.value(part) for part in name.split(", ")]) for name in names]
        sizes = [(k, v[0] if len(v) == 1 else v) for k, v in stated if None not in v]
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

    def anywhere(self, name: str) -> list[Any]:
        """The values of an attribute that are not empty, in sequences of the image of any depth."""
        with file_errors(self.path, f"has a {name} that cannot be read"):
            held = _holders(self.dataset, {}).get(name, ())
            return [v for group, tag in held if not _empty(v := group[tag].value)]

    def units(self) -> set[str]:
        """Units that the values have by Units or by real world value mappings; empty if unknown."""
        codes = [code for _, items in self.stated("MeasurementUnitsCodeSequence") for code in items]
        stated = [value for _, value in self.stated("Units")]
        return {str(u) for u in (*stated, *(code.get("CodeValue") for code in codes)) if u}

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
    """The data sets with each attribute, and its tag: a functional group, and those nested in its
    sequences.

    Args:
        group: a data set of pydicom.
        held: is extended.
        inside: whether to enter a sequence; by default, if it does not describe other images.
    """
    from pydicom.datadict import keyword_for_tag

    for tag in list(group.keys()):
        name = _of_ct_pd(tag)[0] or keyword_for_tag(tag)  # "" of other private attributes
        held.setdefault(name, []).append((group, tag))
        enter = inside(name) if inside else not OTHERS.match(name)
        if name.endswith("Sequence") and enter:
            for item in group[tag].value or []:
                _holders(item, held)
    return held


def _of_ct_pd(tag: Any) -> tuple[str, str]:
    """The name and type of a private attribute in `PRIVATE`, whatever the number of its block."""
    block = tag.element >> 8  # 0 of the names of creators
    return PRIVATE.get(tag & 0xFFFF00FF | 0x1000 if block else tag, ("", ""))


def _private_name(group: Any, tag: Any) -> str:
    """The name of a private attribute in pydicom's dictionary, by its creator; "" of others."""
    from pydicom.datadict import private_dictionary_description

    creator = group.get((tag.group, tag.element >> 8))
    with suppress(KeyError, AttributeError):
        return private_dictionary_description(tag, str(creator.value))
    return ""


def _value(element: Any) -> Any:
    """The value of an attribute, decoded if it is one of `PRIVATE` of an unknown type."""
    value, (name, kind) = element.value, _of_ct_pd(element.tag)
    if not name or not isinstance(value, bytes):
        return value
    numbers = np.frombuffer(value, kind).tolist() if kind else [value.decode("ascii").strip(" \0")]
    return numbers[0] if len(numbers) == 1 else numbers


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
