"""Projections as images: a folder of TIFF, PNG, DICOM or RTK's files, or one file of several pages.

Pillow reads PNG; for TIFF see `mvrecon.data.projections.tiff`, for RTK's formats `rtk_images`.
"""

import re
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from decimal import Decimal
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from mvrecon.core.files.checks import EDGE, Refused, check_file, check_link, file_errors, shown
from mvrecon.core.files.keys import Key, check_keys
from mvrecon.data.dicom_image import DICOM, ONE_FILE, DicomImage, dicom_file, same
from mvrecon.data.dicom_pixels import pixels_of, scales_of, stored_type
from mvrecon.data.projections import exposures, rtk_images
from mvrecon.data.projections.ordering import check_steps, ordered
from mvrecon.data.projections.stack import VIEWS, Header, ProjectionStack
from mvrecon.data.projections.tiff import tiff_header, tiff_pages

#: Formats of image files by their ending; others may be DICOM.
ENDINGS = {".tif": "TIFF", ".tiff": "TIFF", ".png": "PNG", **rtk_images.ENDINGS}
#: Files below a folder without images that are looked at, to name the folder that has some.
LOOKED_AT = 1000
#: Pixel types of a grey PNG by Pillow's mode.
MODES = {"L": "u1", "I;16": "u2", "I;16B": "u2", "I": "i4"}
#: Tag of EXIF for the order of rows and columns.
ORIENTATION = 274
#: Chunks and fields of PNG that change the pixels.
PNG_KEYS = (
    Key("bit depth", "refused", "Pillow rescales fewer bits", (8, 16)),
    Key("colour type", "refused", "grey values", (0,)),
    Key("interlace method", "applied"),
    Key("acTL", "refused", "one image in each file"),
    Key("pCAL", "refused", "store the values that the calibration gives"),
    Key("eXIf: Orientation", "refused", "the first pixel is at the upper left", (1,)),
    Key("gAMA, sRGB, iCCP, cICP, cHRM, tRNS", "ignored", "display alone"),
    Key("pHYs, oFFs, sCAL", "ignored", "origin and print size"),
    Key("sBIT", "ignored", "values of fewer bits are scaled to all bits"),
)
#: Attributes of DICOM projections that all views have in common.
ALIKE = (
    "FieldOfViewOrigin",
    "PixelDataAreaOriginRelativeToFOV",
    "FieldOfViewDimensions",
    "FieldOfViewDimensionsInFloat",
    "DetectorBinning",
    "RTImageOrientation",
    "RTImagePosition",
    "XRayImageReceptorTranslation",
    "XRayImageReceptorAngle",
    "DetectorActiveOrigin",
)
#: Attributes of DICOM projections that change grey values, but not in proportion.
BEAM = (
    *("KVP", "AnodeTargetMaterial", "HalfValueLayer", "XRayOutput", "RadiationMode"),
    *("RadiationSetting", "ExposureStatus", "Sensitivity", "DetectorMode"),
    *("FilterMaterial", "FilterType", "TypeOfFilters"),
    *("FilterThicknessMinimum", "FilterThicknessMaximum"),
    *("FilterBeamPathLengthMinimum", "FilterBeamPathLengthMaximum"),
    *("Grid", "GridID", "GridAbsorbingMaterial", "GridSpacingMaterial", "GridThickness"),
    *("GridPitch", "GridPeriod", "GridAspectRatio", "GridFocalDistance"),
)
#: Attributes of DICOM projections that say where a camera is.
CAMERA_PLACES = (
    "DistanceSourceToDetector",
    "DistanceSourceToPatient",
    "RTImageSID",
    "RadiationMachineSAD",
)
#: All that are compared between views with a warning.
COMPARED = (*exposures.DICOM, *BEAM, *CAMERA_PLACES)
#: Attributes of DICOM projections besides `dicom_image.KEYS`.
DICOM_KEYS = (
    Key(
        "PixelIntensityRelationship",
        "refused",
        "grey values in proportion to intensity; convert the images, and say kind=integrals "
        "(views.kind)",
        ("LIN",),
    ),
    Key(
        "PixelIntensityRelationshipSign",
        "refused",
        "grey values that rise with intensity; invert those that fall",
        (1,),
    ),
    Key("LUTFunction", "refused", "grey values in proportion to intensity", ("TO_LOG",)),
    Key("PresentationIntentType", "refused", "not processed for display", ("FOR PROCESSING",)),
    Key("RescaleType", "refused", "grey values; convert those of another unit", ("US",)),
    Key("FieldOfViewRotation", "refused", "pixels in the detector's order", (0,)),
    Key("FieldOfViewHorizontalFlip", "refused", "pixels in the detector's order", ("NO",)),
    Key("PixelDataAreaRotationAngleRelativeToFOV", "refused", "as FieldOfViewRotation", (0,)),
    *ONE_FILE,
    Key("AppliedMaskSubtractionFlag", "refused", "grey values, not differences", ("NO",)),
    Key("ImagerPixelSpacing", "compared", "with the cameras' pixel size"),
    Key("NominalScannedPixelSpacing", "compared", "as ImagerPixelSpacing, and with it"),
    *(Key(name, "compared", "one of all views") for name in ALIKE),
    Key(
        ", ".join(exposures.DICOM),
        "compared",
        "of views and flat fields; warned of, applied by views.exposure, where others must agree",
    ),
    Key(", ".join(BEAM), "compared", "of views and flat fields; warned of"),
    Key("ExposureIndex, DeviationIndex", "ignored", "of the grey values, also of the object"),
    Key("ImageAndFluoroscopyAreaDoseProduct", "ignored", "may be a sum over images"),
    Key("InstanceNumber", "applied", "order of the views in files of their own"),
    Key("FrameAcquisitionNumber", "compared", "with the order of the frames"),
    Key("PixelSpacing, ImagePlanePixelSpacing", "ignored", "may be that of the object"),
    Key("DetectorElementSpacing", "ignored", "ImagerPixelSpacing is that of binned pixels"),
    Key(", ".join(CAMERA_PLACES), "compared", "of all views; warned of, as the camera decides"),
    Key(
        "PositionerPrimaryAngle, PositionerSecondaryAngle, "
        "EstimatedRadiographicMagnificationFactor, ImagePositionPatient, PatientPosition",
        "ignored",
        "the camera decides",
    ),
)
#: Passes of a plain and of an interlaced PNG: first column and row, and their steps.
PLAIN, INTERLACED = (
    [(0, 0, 1, 1)],
    [
        (0, 0, 8, 8),
        (4, 0, 8, 8),
        (0, 4, 4, 8),
        (2, 0, 4, 4),
        (0, 2, 2, 4),
        (1, 0, 2, 2),
        (0, 1, 1, 2),
    ],
)
#: Names of dark and flat fields among the views: Octopus numbers them as di0001 and io0001; the
#: ESRF has refHST0000.edf, dark.edf, and darkend0000.edf, a sum of images, which is no field.
FIELDS = {
    "dark": re.compile(r"dark(?!end\d+\.edf)|di\d+\.", re.IGNORECASE),
    "flat": re.compile(r"flat|refhst|io\d+\.", re.IGNORECASE),
}


class ImageFiles(ProjectionStack):
    """Views as images, one in each file, or all in one file of several pages.

    Args:
        files: the views' files, in their order.

    Raises:
        Refused: images of several sizes or types, colours, a file that is damaged, or one with a
            key to refuse (`TIFF_KEYS`, `PNG_KEYS`, `DICOM_KEYS`).
    """

    def __init__(self, files: Sequence[Path]):
        headers = [header(file) for file in files]
        for file, other in zip(files, headers, strict=True):
            if other[:2] != headers[0][:2]:
                raise Refused(
                    f"{file}: expected {headers[0].words} as {files[0].name}, got {other.words}"
                )
            if len(files) > 1 and other.pages > 1:
                raise Refused(f"{file}: expected one image in each file, got {other.pages}")
            if other.pixel_mm != headers[0].pixel_mm:
                raise Refused(
                    f"{file}: expected the ImagerPixelSpacing {headers[0].pixel_mm} of "
                    f"{files[0].name}, got {other.pixel_mm}"
                )
            for name, value, first in zip(ALIKE, other.alike, headers[0].alike, strict=False):
                if not same(value, first):
                    raise Refused(
                        f"{file}: expected the {name} {first} of {files[0].name}, got {value}; "
                        f"choose views of one detector by pattern=... (views.pattern)"
                    )
        self.stated = {
            name: [text for head in headers for text in head.stated.get(name, [""] * head.pages)]
            for name in dict.fromkeys(
                (*COMPARED, *(key for head in headers for key in head.stated))
            )
        }
        for name, texts in self.stated.items():
            cure = "which the camera must have" if name in CAMERA_PLACES else ""
            exposures.warn_of_several(files[0].parent, name, texts, cure)
        self.files, self._excluded = list(files), headers[0].excluded
        self.negative_is_bad = self._excluded is not None
        self.pixel_mm, self._tops = (
            headers[0].pixel_mm,
            frozenset().union(*(head.tops for head in headers)),
        )
        self.detector = {
            "ImagerPixelSpacing": self.pixel_mm,
            **dict(zip(ALIKE, headers[0].alike, strict=False)),
        }
        if all(head.linear for head in headers):
            self.kind = "intensities"
        single = len(files) == 1
        names = [f"{files[0].stem} {k}" for k in range(headers[0].pages)] if single else []
        names = names if len(names) > 1 else [file.stem for file in files]
        super().__init__(files[0] if single else files[0].parent, names, *headers[0][:2])

    @property
    def top(self) -> float | None:
        """Greatest grey value of the stored bits, scaled; none for floats.

        Raises:
            Refused: it differs between views.
        """
        if len(self._tops) > 1:
            raise Refused(
                f"{self.path}: expected one greatest grey value of all views, by which saturated "
                f"pixels are found, got {shown(sorted(map(str, self._tops)))} by BitsStored and "
                f"RescaleSlope; give saturation=<grey value> (views.saturation)"
            )
        return next(iter(self._tops))

    @cached_property
    def marked(self) -> Bool[Tensor, "v u"] | None:
        """Negative pixels of the first view, where these are no counts.

        Warns:
            UserWarning: the file states more.
        """
        if self._excluded is None:
            return None
        marked = torch.from_numpy(self._block(0, 1)[0] < 0)
        if marked.sum() < self._excluded:
            warnings.warn(
                f"{self.path}: expected as many negative pixels as N_excluded_pixels states, "
                f"{self._excluded}, got {int(marked.sum())}; give the others as views.bad_pixels",
                stacklevel=2,
            )
        return marked

    def _block(self, first: int, last: int) -> np.ndarray:
        if len(self.files) == 1:
            return np.stack(list(_pages(self.files[0], first, last)))
        return np.stack([next(_pages(file, 0, 1)) for file in self.files[first:last]])


def view_files(
    folder: Path, pattern: str | None = None, gaps: bool = False, fields: Sequence[Path] = ()
) -> list[Path]:
    """The images of a folder without dark and flat fields, sorted by the InstanceNumber of DICOM
    images, else by the numbers in their names.

    Args:
        folder: folder of the images; names of `FIELDS` are excluded, unless all are. Other files
            are ignored.
        pattern: pattern of the views' names, such as "scan_*.tif"; None: all images.
        gaps: see `ordered`.
        fields: files of dark and flat fields, which are excluded.

    Warns:
        UserWarning: DICOM images without InstanceNumbers, or with equal ones; see `ordered`.

    Raises:
        Refused: no image, too many, or of several formats; DICOM images of several series, or only
        some with their own InstanceNumber; see `ordered`.
    """
    excluded = {field.resolve() for field in fields}
    images = [file for file in _images(folder, pattern) if file.resolve() not in excluded]
    views = [f for f in images if not any(x.match(f.name) for x in FIELDS.values())] or images
    _check_kind(folder, views, f" named {pattern}" if pattern else "")
    by_instance = _by_instance(views, gaps) if _ending(views[0]) == "DICOM" else []
    return by_instance or ordered(views, gaps, mixed=pattern is not None)


def field_files(folder: Path, field: str) -> list[Path]:
    """The images of a folder with names of the "dark" or of the "flat" field; may be empty.

    Raises:
        Refused: they are of several formats.
    """
    files = [file for file in _images(folder) if FIELDS[field].match(file.name)]
    if files:
        _check_kind(folder, files, f" of the {field} field")
    return files


def _images(folder: Path, pattern: str | None = None) -> list[Path]:
    files = []
    with file_errors(folder, f"has no names like {pattern!r}", "expected such as scan_*.tif"):
        inside = sorted(folder.glob(pattern or "*"))
    for file in inside:
        if file.name.startswith("."):
            continue
        if file.suffix.lower() in (*ENDINGS, *DICOM):
            check_link(file)
        if file.is_file() and _ending(file):
            files.append(file)
        if len(files) > VIEWS:
            raise Refused(f"{folder}: expected at most {VIEWS} images, got more")
    return files


def _check_kind(folder: Path, files: Sequence[Path], what: str) -> None:
    """Raise for no images, or images of several formats."""
    kinds = sorted({_ending(file) for file in files})
    if len(kinds) != 1:
        others = sorted(
            {item.suffix for item in folder.iterdir() if item.suffix and item.is_file()}
        )
        none = f"none, but {', '.join(others[:8])}" if others else "none"
        inside = islice(folder.rglob("*"), LOOKED_AT)
        if below := sorted({str(f.parent) for f in inside if f.is_file() and _ending(f)}):
            none += f"; there are images in {' and '.join(below[:3])}"
        choose = f"those of {' and '.join(kinds)}; choose by pattern=... (views.pattern)"
        got = choose if kinds else none
        raise Refused(
            f"{folder}: expected images{what} (TIFF, PNG, DICOM or of RTK: "
            f"{', '.join(rtk_images.ENDINGS)}), got {got}"
        )


def _by_instance(files: Sequence[Path], gaps: bool) -> list[Path]:
    """DICOM images of one series sorted by InstanceNumber; empty if these are missing or
    all equal.
    """
    numbers: dict[Path, int | None] = {}
    series = set()
    for file in files:
        with file_errors(file, "has an InstanceNumber that cannot be read"):
            dataset = DicomImage(file).dataset
            number = dataset.get("InstanceNumber")
            numbers[file] = None if number is None else int(number)
            series.add(dataset.get("SeriesInstanceUID"))
    folder = files[0].parent
    if 1 < len(series) < len(files):  # some detectors store each exposure as its own series
        raise Refused(
            f"{folder}: expected DICOM projections of one series, got {len(series)} series in "
            f"{len(files)} files; choose by pattern=... (views.pattern)"
        )
    counts = Counter(numbers.values())
    if len(counts) == 1 and len(files) > 1:
        warnings.warn(
            f"{folder}: DICOM projections have no InstanceNumbers of their own; they are in the "
            f"order of the numbers in their names",
            stacklevel=2,
        )
        return []
    if None in counts or max(counts.values()) > 1:
        number, count = max(counts.items(), key=lambda item: (item[0] is None, item[1]))
        raise Refused(
            f"{folder}: expected an InstanceNumber of its own for each view, got {number} in "
            f"{count} files"
        )
    known = {file: number for file, number in numbers.items() if number is not None}
    in_order = sorted(known, key=lambda file: known[file])
    if not gaps:
        check_steps(folder, [[Decimal(known[file])] for file in in_order])
    return in_order


def _ending(file: Path) -> str:
    """TIFF, PNG, DICOM or a format of RTK; empty for other files."""
    return ENDINGS.get(file.suffix.lower()) or ("DICOM" if dicom_file(file) else "")


def header(file: Path) -> Header:
    """Read an image's header, checked on every page, without pixels.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: not such an image, in colour, with pages of several sizes, or with a key to refuse.
    """
    check_file(file, "an image (TIFF, PNG, DICOM or a format of RTK)")
    with file_errors(file, "cannot be read as an image"):
        return HEADERS.get(_ending(file), _dicom_header)(file)


def _pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    with file_errors(file, f"pages {first} to {last - 1} cannot be read"):
        yield from PAGES.get(_ending(file), _dicom_pages)(file, first, last)


def _dicom_header(file: Path) -> Header:
    """Integers if values are stored numbers; else floats, whose largest value is that of the
    stored bits, scaled.
    """
    image = DicomImage(file)
    if image.value("Modality") == "NM" and image.frames > 1:
        raise Refused(
            f"{file}: expected projections in the order of the file, got frames of NM, which is to "
            f"be sorted by its vectors; the plugin mvrecon-spect reads such a file (views.path)"
        )
    image.check(DICOM_KEYS)
    numbers = [int(n) for n in image.values("FrameAcquisitionNumber") if n is not None]
    if len({*numbers}) > 1 and numbers != sorted(numbers):
        raise Refused(
            f"{file}: expected frames in the order of their FrameAcquisitionNumber, got "
            f"{shown(numbers)}; sort the frames"
        )
    (kind, ends), scales = stored_type(image), {scale[:2] for scale in scales_of(image)}
    tops = {max(slope * end + d for end in ends) if ends else None for slope, d in scales}
    return Header(
        image.shape,
        kind if scales == {(1.0, 0.0)} else np.dtype("f4"),
        image.frames,
        frozenset(tops),
        image.pixel_mm("ImagerPixelSpacing", "NominalScannedPixelSpacing"),
        tuple(map(image.value, ALIKE)),
        {name: _texts(image, name) for name in COMPARED},
        image.value("PixelIntensityRelationship") == "LIN",
    )


def _texts(image: DicomImage, name: str) -> list[str]:
    """What an image states by a name of each frame; "" of none."""
    single = image.groups and image.stated(name)
    found = (
        {str(value) for _, value in image.stated(name, k)}
        for k in range(image.frames if single else 1)
    )
    texts = [" or ".join(sorted(values)) for values in found]
    return texts if single else texts * image.frames


def _dicom_pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    values = pixels_of(file)
    yield from values.reshape(-1, *values.shape[-2:])[first:last]


def _png_header(file: Path) -> Header:
    with _png(file) as image:
        columns, rows = image.size
        with file.open("rb") as raw:
            bits, colours = struct.unpack_from("BB", raw.read(26), 24)
        chunks = dict.fromkeys((name for name, _ in _chunks(file)), "one")
        stated = {"bit depth": bits, "colour type": colours, **chunks}
        stated["eXIf: Orientation"] = image.getexif().get(ORIENTATION) if "eXIf" in chunks else None
        check_keys(file, PNG_KEYS, stated.get)
        kind = MODES.get(image.mode)
        if kind is None or max(rows, columns) > EDGE:
            raise Refused(
                f"{file}: expected grey values of at most {EDGE} x {EDGE} pixels, got {rows} x "
                f"{columns} of the type {image.mode}"
            )
        return Header((rows, columns), np.dtype(kind), 1, frozenset([2.0**bits - 1]))


def _png_pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    _check_rows(file)
    with _png(file) as image:
        yield np.asarray(image).astype(MODES[image.mode], copy=False)


def _check_rows(file: Path) -> None:
    """Raise for a truncated grey PNG: Pillow leaves missing rows zero."""
    data = file.read_bytes()
    columns, rows, bits, interlaced = struct.unpack_from(">IIB3xB", data, 16)
    sizes = [
        (len(range(y, rows, down)), len(range(x, columns, right)))
        for x, y, right, down in (INTERLACED if interlaced else PLAIN)
    ]
    needed = sum(m * (1 + (n * bits + 7) // 8) for m, n in sizes if n)  # a byte before each row
    stream, got = zlib.decompressobj(), 0
    for name, part in _chunks(file):
        if name == "IDAT" and got < needed:
            got += len(stream.decompress(data[part], needed - got))
    if got < needed:
        raise Refused(f"{file}: expected {needed} bytes of {rows} x {columns} pixels, got {got}")


def _chunks(file: Path) -> Iterator[tuple[str, slice]]:
    """Names of the chunks of a PNG, and the bytes of their contents."""
    with file.open("rb") as raw:
        raw.seek(8)
        while len(head := raw.read(8)) == 8:
            size, name = struct.unpack(">I4s", head)
            yield name.decode("latin-1"), slice(raw.tell(), raw.tell() + size)
            raw.seek(size + 4, 1)


@contextmanager
def _png(file: Path) -> Iterator[Any]:
    from PIL import Image as Pillow

    with Pillow.open(file, formats=["PNG"]) as image:
        yield image


RTK = rtk_images.ENDINGS.values()
#: Readers of a header and of pages by format; those of others are DICOM's.
HEADERS = {"TIFF": tiff_header, "PNG": _png_header, **dict.fromkeys(RTK, rtk_images.rtk_header)}
PAGES = {"TIFF": tiff_pages, "PNG": _png_pages, **dict.fromkeys(RTK, rtk_images.rtk_pages)}
