"""Projections as TIFF, by tifffile, and imagecodecs for LZW, JPEG and packed bits."""

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mvrecon.core.files.checks import EDGE, Refused, shown, text_of
from mvrecon.core.files.keys import Key, check_keys, has_effect, unknown_names
from mvrecon.data.projections import descriptions
from mvrecon.data.projections.ordering import disordered
from mvrecon.data.projections.stack import VIEWS, Header, PlaceInSet

#: Tags of EXIF on which grey values depend, but not in a proportion that all cameras share.
EXIF_BEAM = ("ISOSpeedRatings", "ISOSpeed", "GainControl", "FNumber", "ExposureBiasValue")
#: Tags that are stored as numerator and denominator.
RATIOS = ("FNumber", "ExposureBiasValue", "Gamma", "BestQualityScale", "MDScalePixel")
#: Items of GDAL that scale values: the role, and the number.
SCALED = re.compile(r"<Item\b[^>]*\brole\s*=\s*[\"'](scale|offset)[\"'][^>]*>\s*([^<]*?)\s*<", re.I)
#: Tags of Andor on which grey values depend likewise, beside its ExposureTime.
ANDOR_BEAM = tuple(
    f"Andor{name}"
    for name in (
        *("Accumulations", "PhotonCounting", "EmDacLevel", "PreAmpSetting", "BaselineClamp"),
        *("BaselineOffset", "HorizontalFlip", "VerticalFlip", "Clockwise", "CounterClockwise"),
    )
)
#: Tags with texts of any program: tifffile writes two of the first, ImageJ keeps its Info in the
#: second.
TEXTS = ("ImageDescription", "IJMetadata", "GDAL_METADATA")
#: First tag of areaDetector's attributes, which are texts `name:value`.
AREA_DETECTOR = 65010
#: Tags of TIFF that change the pixels or their order, and those that ordinary files have; a warning
#: names all others.
TIFF_KEYS = (
    Key(
        "ImageWidth, ImageLength, StripOffsets, StripByteCounts, RowsPerStrip, TileWidth, "
        "TileLength, TileOffsets, TileByteCounts, PlanarConfiguration, JPEG*, LercParameters, "
        "YCbCr*, T4Options, T6Options",
        "applied",
    ),
    Key("BitsPerSample", "applied", "also gives the largest grey value"),
    Key("SampleFormat", "applied", "integers and floats of any width; one bit in masks alone"),
    Key("Compression", "applied"),
    Key("Predictor", "applied"),
    Key("FillOrder", "applied"),
    Key("SamplesPerPixel", "refused", "one grey value per pixel", (1,)),
    Key(
        "PhotometricInterpretation",
        "refused",
        "grey values as stored, colours converted to grey; WhiteIsZero (0) affects display alone",
        (0, 1),
    ),
    Key(
        "Orientation",
        "refused",
        "the first pixel is at the upper left; store it without that tag, and say views.flip_rows "
        "or flip_columns",
        (1,),
    ),
    Key("NewSubfileType", "refused", "full images, not thumbnails or masks", (0, 2)),
    Key("scaleoffset.json", "refused", "CIL's, beside the images: store the values that it gives"),
    Key("GrayResponseCurve", "refused", "store the values that the curve gives"),
    Key("TransferFunction", "refused", "store the values that the function gives"),
    Key("LinearizationTable", "refused", "store the values that the table gives"),
    Key("BlackLevel", "refused", "subtract it, or give it as views.dark", (0, (0, 1))),
    Key("WhiteLevel", "refused", "remove it, and give it as views.saturation"),
    Key("BlackLevelDeltaH", "refused", "subtract it"),
    Key("BlackLevelDeltaV", "refused", "subtract it"),
    Key("ReferenceBlackWhite", "refused", "store the values of its range"),
    Key("ActiveArea", "refused", "cut the images to it"),
    Key("DefaultScale", "refused", "square pixels", ((1, 1, 1, 1),)),
    Key(
        "ExposureTime",
        "compared",
        "of all views, also in EXIF, in ms as in DICOM; warned of, applied by views.exposure",
    ),
    Key("AndorExposureTime", "compared", "as ExposureTime, in s"),
    Key(", ".join(EXIF_BEAM), "compared", "of views and flat fields, also in EXIF; warned of"),
    Key(", ".join(ANDOR_BEAM), "compared", "of views and flat fields; warned of"),
    Key(
        "ImageDescription: ..., IJMetadata: Info ..., GDAL_METADATA: ..., areaDetector: ...",
        "ignored",
        "what other programs state; a warning names it, but entries of 0, off or nothing",
    ),
    Key(
        "areaDetector: ColorMode, areaDetector: BayerPattern, areaDetector: DriverFileName, "
        "areaDetector: Manufacturer, areaDetector: Model",
        "ignored",
        "of the camera",
    ),
    Key("Gamma", "refused", "linear values, also in EXIF", (1,)),
    Key("OpcodeList1", "refused", "store the values that its operations give"),
    Key("OpcodeList2", "refused", "store the values that its operations give"),
    Key("OpcodeList3", "refused", "store the values that its operations give"),
    Key("BestQualityScale", "refused", "store the image at this scale", (1,)),
    Key("RowInterleaveFactor", "refused", "rows in their order", (1,)),
    Key("ColumnInterleaveFactor", "refused", "columns in their order", (1,)),
    Key("SubTileBlockSize", "refused", "pixels in their order", ((1, 1),)),
    Key("StripRowCounts", "refused", "strips of equal heights, RowsPerStrip"),
    Key("Indexed", "refused", "grey values, not indices of colours", (0,)),
    Key("OPIProxy", "refused", "full images, not reduced ones", (0,)),
    Key("DataType", "refused", "state SampleFormat instead", (2,)),
    Key("AdventScale", "refused", "store the values that the factor gives"),
    Key("Decode", "refused", "store the values of its range"),
    Key("StoNits", "refused", "store the values that the factor gives", (1,)),
    Key("SubfileType", "refused", "full images, not reduced ones", (1, 3)),
    Key("MDFileTag", "refused", "linear values, not square roots", (128,)),
    Key("MDScalePixel", "refused", "store the values that the factor gives", (1,)),
    Key("GDAL_METADATA", "refused", "with a scale or an offset; store the values they give"),
    Key("GDAL_NODATA", "refused", "replace pixels without data, and remove the tag"),
    Key(
        "ImageDescription: cf",
        "refused",
        "ImageJ's calibration; store the calibrated values. That of 16 bits with a sign is applied",
        ("signed",),
    ),
    Key("ImageDescription: images", "compared", "with the number of pages"),
    Key(
        "ImageDescription: truncated",
        "compared",
        "tifffile's, with its shape: views of which no page has a directory",
    ),
    Key(
        "ImageDescription: TiffData",
        "compared",
        "OME's, with the order of the pages; of a set of files, it is their order",
    ),
    Key(
        "ImageDescription: channels, ImageDescription: slices, ImageDescription: frames, "
        "ImageDescription: SizeC, ImageDescription: SizeZ, ImageDescription: SizeT",
        "compared",
        "ImageJ's and OME's axes, of which one may run, over as many images as pages",
    ),
    Key("UIC2tag", "compared", "MetaMorph's, whose count is that of its images, with the pages"),
    Key("PageNumber", "compared", "with the order of the pages"),
    Key(
        "XResolution, YResolution, ResolutionUnit, ImageDescription: PhysicalSizeX",
        "ignored",
        "the camera has the pixel size",
    ),
    Key(
        "MinSampleValue, MaxSampleValue, SMinSampleValue, SMaxSampleValue", "ignored", "statistics"
    ),
    Key(
        "BaselineExposure, ColorMap, GrayResponseUnit, ColorResponseUnit, TransferRange, "
        "Thresholding, CellWidth, CellLength, HalftoneHints, WhitePoint, PrimaryChromaticities, "
        "InterColorProfile, ICCProfileDescriptor, SRGBRenderingIntent, ColorSpace",
        "ignored",
        "of the display",
    ),
    Key(
        "DocumentName, ImageDescription, Make, Model, PageName, Software, DateTime*, Artist, "
        "HostComputer, Copyright, IPTCNAA, ImageResources, ImageTitle, ImageID, "
        "ImageUniqueID, ImageSourceData, OriginalFileName, ProcessingSoftware, XPTitle, "
        "XPAuthor, XPKeywords, XPSubject, Rating*, Padding, OffsetSchema",
        "ignored",
        "texts",
    ),
    Key("FreeOffsets, FreeByteCounts, ExtraSamples, SubIFDs", "ignored", "no pixels of the image"),
    Key("Thumbnail*", "ignored", "reduced images"),
    Key(
        "XPosition, YPosition, ModelPixelScaleTag, ModelTiepointTag, ModelTransformationTag, Geo*, "
        "GEO_METADATA, RPCCoefficientTag, GPSTag",
        "ignored",
        "the camera decides",
    ),
    Key("BlackLevelRepeatDim, DNGVersion, DNGBackwardVersion", "ignored", "of BlackLevel, texts"),
    Key(
        "ExifTag, ExifVersion, Exposure*, Spectral*, SensitivityType, StandardOutputSensitivity, "
        "RecommendedExposureIndex, ISOSpeedLatitude*, OffsetTime*, SubsecTime*, "
        "ComponentsConfiguration, CompressedBitsPerPixel, ShutterSpeedValue, ApertureValue, "
        "BrightnessValue, MaxApertureValue, Subject*, MeteringMode, LightSource, Flash*, "
        "FocalLength*, FocalPlane*, SensingMethod, MakerNote, Temperature, Humidity, "
        "Pressure, PixelXDimension, PixelYDimension, Interoperability*, FileSource, Scene*, "
        "CustomRendered, WhiteBalance, Contrast, Saturation, Sharpness, "
        "DeviceSettingDescription, DigitalZoomRatio, CameraOwnerName, BodySerialNumber, Lens*, "
        "UniqueCameraModel, CameraSerialNumber, BatteryLevel, TimeZoneOffset, SelfTimerMode, "
        "Related*",
        "ignored",
        "of EXIF",
    ),
    Key(
        "IJMetadata, IJMetadataByteCounts, MicroManagerMetadata, UIC1tag, UIC3tag, UIC4tag, "
        "CZ_SEM, CZ_LSMINFO, FEI_*, FibicsXML, JEOL_Header, MM_*, OlympusINI, OlympusSIS*, "
        "PCO_RAW, Andor*, tag 65000, tag 65001, tag 65002, tag 65003",
        "ignored",
        "what the programs of microscopes and cameras store beside the pixels",
    ),
    *descriptions.KEYS,
    descriptions.TEXTS,
)


def tiff_header(file: Path) -> Header:
    with _tiff(file) as (pages, images):
        if not 0 < len(pages) <= VIEWS:
            raise Refused(f"{file}: expected 1 to {VIEWS} pages, got {len(pages)}")
        if images != len(pages) and not _behind(pages, images):
            raise Refused(
                f"{file}: expected as many pages as its description states images, {images}, "
                f"got {len(pages)}; save the stack as an image sequence"
            )
        first, numbers, stated = _page_header(file, pages[0], images), [], []
        found: set[str] = set()
        for page in pages:
            _check_tags(file, page)
            found |= _names(page)
            head = _page_header(file, page, images)
            stated.append({name: texts[0] for name, texts in head.stated.items()})
            if head._replace(stated=first.stated) != first:
                name = next(
                    name
                    for name in ("words", *Header._fields)
                    if name != "stated" and getattr(head, name) != getattr(first, name)
                )
                wanted, got = (getattr(one, name) for one in (first, head))
                what = "" if name == "words" else f"{name} "
                raise Refused(
                    f"{file}: expected {what}{wanted} on every page, got {got} on page {page.index}"
                )
            numbers.append(page.tags.valueof("PageNumber"))
        if len(stated) != len(pages):  # iteration ends where a page is not readable
            raise Refused(
                f"{file}: expected {len(pages)} pages, one after the other, got {len(stated)}; is "
                f"it cut short or damaged?"
            )
        text = _description(file, descriptions.without_own_id(pages[0].description))
        places = descriptions.places_in_set(text)
        own = places.get(descriptions.path_in_set(file, places) or "", ())
        _check_order(file, text, numbers, images, places, own)
        stated *= images // len(pages)
        names = dict.fromkeys(name for one in stated for name in one)
        texts = {name: [one.get(name, "") for one in stated] for name in names}
        head = first._replace(stated=texts)
        first = descriptions.of_file(file, head, text, own)._replace(places=places, own=own)
        unknown = unknown_names(sorted(found), TIFF_KEYS)
        others = [*_check_axes(file, pages[0]), *disordered(_labels(pages))]
        first = first._replace(unknown=[*unknown, *others])
    if _offset(pages[0]):
        return first._replace(dtype=np.dtype("i2"), tops=frozenset([2.0**15 - 1]))
    return first


def _labels(pages: Any) -> list[str]:
    """Labels of ImageJ, or names of pages."""
    labels = (pages[0].tags.valueof("IJMetadata") or {}).get("Labels")
    return [str(x or "") for x in labels or [page.tags.valueof("PageName") for page in pages]]


def _check_axes(file: Path, page: Any) -> list[str]:
    """Check that the columns of images are tifffile's axis X; return axes whose rows are not Y, as
    those of sinograms.
    """
    found = [one.get("axes", "YX").rstrip("S") for one in page.parent.shaped_metadata or ()]
    if wrong := [axes for axes in found if not axes.endswith("X")]:
        raise Refused(
            f"{file}: expected images of rows and columns, tifffile's axes YX last, got "
            f"{shown(wrong[0])}; transpose the array"
        )
    return [f"axes={axes}" for axes in found if not axes.endswith("YX")]


def _description(file: Path, text: str) -> str:
    """The description of a file, or that of the file beside it to which OME's text refers."""
    for _, stated in descriptions.elements(text, "BinaryOnly"):
        other = file.with_name(Path(stated.get("MetadataFile", "")).name or file.name)
        if other != file and other.is_file():
            if other.suffix.lower() not in (".tif", ".tiff"):
                return text_of(other)
            with _tiff(other) as (pages, _):
                return descriptions.without_own_id(pages[0].description)
    return text


def _check_tags(file: Path, page: Any) -> None:
    """Raise for tags that are cut short, which tifffile leaves out."""
    handle, form = page.parent.filehandle, page.parent.tiff
    handle.seek(page.offset)
    (tags,) = struct.unpack(form.tagnoformat, handle.read(form.tagnosize))
    ends = [tag.valueoffset + tag.valuebytecount for tag in page.tags]
    if len(ends) != tags or max(ends, default=0) > handle.size:
        raise Refused(
            f"{file}: expected {tags} tags of page {page.index} within {handle.size} bytes, got "
            f"{len(ends)} up to byte {max(ends, default=0)}; is it cut short?"
        )


def _names(page: Any) -> set[str]:
    """Names of the tags of a page and of its EXIF, and what its texts state."""
    names = {str(name) for name in page.tags.valueof("ExifTag") or ()}
    for tag in page.tags:
        of_camera = tag.code >= AREA_DETECTOR and isinstance(tag.value, str)
        where = "areaDetector" if of_camera else tag.name
        if not of_camera:
            names.add(f"tag {tag.name}" if tag.name.isdigit() else tag.name)
        if of_camera or tag.name in TEXTS:
            text = tag.value.get("Info", "") if isinstance(tag.value, dict) else tag.value
            text = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)
            names |= {f"{where}: {part}" for part in descriptions.unknown_parts(text)}
    return names


def _described(page: Any) -> dict[str, str]:
    """Entries of ImageJ's description of a page; empty without one."""
    lines = [line.split("=", 1) for line in page.description.split("\n") if "=" in line]
    entries = {name.strip(): value.strip() for name, value in lines}
    line = [float(entries.get(name) or "nan") for name in ("cf", "c0", "c1")]
    if line == [0, -(2**15), 1] and page.dtype in ("i2", "u2"):
        entries["cf"] = "signed"
    return entries if "ImageJ" in entries else {}


def _offset(page: Any) -> bool:
    """Whether 2^15 is to be subtracted from stored numbers: ImageJ has no others of 16 bits."""
    return _described(page).get("cf") == "signed" and page.dtype == "u2"


#: Axes of a stack by the description of ImageJ and SCIFIO.
AXES = re.compile(r"^[ \t]*(channels|slices|frames)[ \t]*=[ \t]*(\d+)", re.MULTILINE)


def _behind(pages: Any, images: int) -> bool:
    """Whether plain images follow the one of a single page without pages of their own, as in
    stacks of ImageJ above 4 GiB.
    """
    page = pages[0]
    room = page.parent.filehandle.size - page.dataoffsets[0]
    plain = page.is_memmappable and "UIC2tag" not in page.tags
    return bool(len(pages) == 1 < images <= VIEWS and plain and images * page.nbytes <= room)


def _check_order(
    file: Path,
    text: str,
    numbers: Sequence[tuple[int, ...] | None],
    images: int,
    places: Mapping[str, Sequence[PlaceInSet]],
    own: Sequence[PlaceInSet],
) -> None:
    """Raise for pages that are not in the order of one axis, by the description of the first and
    the PageNumbers of all; for a file of a set, if its pages are not those with places in it.
    """
    known = [number[0] for number in numbers if number]
    if known != sorted(known):
        raise Refused(f"{file}: expected pages in the order of PageNumber, got {shown(known)}")
    if places:
        if len(own) != images:
            raise Refused(
                f"{file}: expected a place of each of its {images} images in the set of "
                f"{len(places)} files that its ImageDescription names ({min(places)}, ...), got "
                f"{len(own)}; was it renamed, moved or cut? Where its name has the right order, "
                f"save it without that description"
            )
        return
    order = re.search(r"^axes=(?!X,Y\b)(.*)", text, re.MULTILINE)
    if "SCIFIO=" in text and order:
        raise Refused(
            f"{file}: expected SCIFIO's axes X,Y first, got {shown(order[1])}; transpose the images"
        )
    axes = AXES.findall(text) if "ImageJ" in text or "SCIFIO" in text else []
    ome = descriptions.elements(text, "Pixels")
    sizes = [(f"Size{axis}", own.get(f"Size{axis}", 1)) for _, own in ome for axis in "CZT"]
    axes = [(name, int(size)) for name, size in (*axes, *sizes)]
    running = [f"{name} {size}" for name, size in axes if size > 1]
    if len(running) > 1:
        raise Refused(
            f"{file}: expected images along one axis, got {' and '.join(running)} in its "
            f"ImageDescription; save the views as a stack of their own"
        )
    stated = max([len(ome), *(size for _, size in axes)])
    if (running or ome) and stated != images:
        raise Refused(
            f"{file}: expected as many pages as its ImageDescription states, "
            f"{running[0] if running else stated}, got {images}; are the others in further files?"
        )
    planes = sorted(
        (int(place.get("IFD", 0)), n, sum(int(place.get(f"First{axis}", 0)) for axis in "ZCT"))
        for n, place in descriptions.elements(text, "TiffData")
    )
    if planes != sorted(planes, key=lambda plane: plane[1:]):
        order = [n - 1 if len(ome) > 1 else k for _, n, k in planes]
        raise Refused(
            f"{file}: expected pages in the order of TiffData in its ImageDescription, got the "
            f"images {shown(order)}; sort the pages, and save them again"
        )


def _number(tag: str, value: Any) -> Any:
    """The number of a tag that is stored as a ratio; the value of others."""
    ratio = tag in RATIOS and isinstance(value, tuple) and len(value) == 2 and value[1]
    return value[0] / value[1] if ratio else value


def _page_header(file: Path, page: Any, pages: int) -> Header:
    described, exif = _described(page), page.tags.valueof("ExifTag") or {}

    def value_of(name: str) -> Any:
        tag, _, entry = name.partition(": ")
        if entry:
            return described.get(entry)
        found = _number(tag, page.tags.valueof(tag, exif.get(tag)))
        if tag == "GDAL_METADATA":
            items = SCALED.findall(str(found or ""))
            return [f"{role} {value}" for role, value in items if has_effect(role, value)]
        return int(found) if isinstance(found, int) else found  # tifffile's are enumerations

    check_keys(file, TIFF_KEYS, value_of)
    kind, (rows, columns) = page.dtype, page.shape if len(page.shape) == 2 else (0, 0)
    if kind is None or kind.kind not in "biuf" or not 0 < rows <= EDGE or not 0 < columns <= EDGE:
        raise Refused(
            f"{file}: expected grey values of at most {EDGE} x {EDGE} pixels, got "
            f"{' x '.join(map(str, page.shape))} of the type {kind}"
        )
    segments = math.prod(page.chunked)
    if max(page.chunks) > EDGE or len(page.dataoffsets) != segments or not all(page.databytecounts):
        raise Refused(
            f"{file}: expected {segments} strips or tiles of at most {EDGE} x {EDGE} pixels, got "
            f"{sum(map(bool, page.databytecounts))} with data; is it cut short?"
        )
    _check_words(file, page)
    bits = page.bitspersample - (kind.kind == "i")
    top = None if kind.kind == "f" else float(2**bits - 1)
    exposed = [page.tags.valueof(name) for name in ("ExposureTime", "AndorExposureTime")]
    exposed.append(exif.get("ExposureTime"))
    ratios = [s if isinstance(s, tuple) else (s, 1) for s in exposed if s is not None]
    times = {descriptions.milliseconds(file, s / unit, "s") for s, unit in ratios if unit}
    stated = {"ExposureTime": [" or ".join(sorted(times))]}
    for name in (*EXIF_BEAM, *ANDOR_BEAM):
        if (value := exif.get(name, page.tags.valueof(name))) is not None:
            number = _number(name, value)
            stated[name] = [f"{number:g}" if isinstance(number, float) else str(number)]
    head = Header((rows, columns), kind, pages, frozenset([top]), stated=stated)
    manager = page.tags.valueof("MicroManagerMetadata")
    return descriptions.of_page(file, head, page.description, manager)


def _check_words(file: Path, page: Any) -> None:
    """Raise for numbers that programs read differently, as other values than were written."""
    bits, (*_, rows, columns) = page.bitspersample, page.chunks
    room = len(page.databytecounts) * (1 + rows * math.ceil(columns * bits / 8))
    if page.compression == 1 and bits % 8 and sum(page.databytecounts) > room:
        raise Refused(
            f"{file}: expected at most {room} bytes of pixels of {bits} packed bits "
            f"(BitsPerSample), got {sum(page.databytecounts)}; state the bits of the words that "
            f"contain them, and give the greatest value as views.saturation"
        )
    if bits == 24 and page.dtype.kind in "iu":
        raise Refused(f"{file}: expected integers of 8, 16 or 32 bits, got 24, of either order")
    if page.predictor != 1 and page.compression in (1, 32773):
        raise Refused(
            f"{file}: expected no Predictor without LZW or another compression to which it "
            f"belongs, got {int(page.predictor)}, which some programs apply; store the values"
        )


def tiff_pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    with _tiff(file) as (pages, images):
        offset = np.int32(2**15 if _offset(pages[0]) else 0)
        for k in range(first, last):
            try:
                values = _image_behind(pages[0], k) if images > len(pages) else pages[k].asarray()
            except ValueError as error:
                if "imagecodecs" in str(error):
                    raise ImportError(f"{file}: {error}: pip install 'mvrecon[io]'") from error
                raise
            yield values - offset if offset else values


def _image_behind(page: Any, k: int) -> np.ndarray:
    """The k-th image of those that follow that of a page; see `_behind`."""
    handle = page.parent.filehandle
    handle.seek(page.dataoffsets[0] + k * page.nbytes)
    kind = page.dtype.newbyteorder(page.parent.byteorder)
    return handle.read_array(kind, page.size).reshape(page.shape)


@contextmanager
def _tiff(file: Path) -> Iterator[tuple[Any, int]]:
    """The pages of a TIFF, read on access, whose chain is whole, and the number of images as
    ImageJ, tifffile or MetaMorph state it, else that of the pages.
    """
    import tifffile  # takes a tenth of a second

    with tifffile.TiffFile(file) as image:
        pages: Any = image.pages
        count, handle, form = len(pages), image.filehandle, image.tiff
        handle.seek(pages.next_page_offset)
        rest = handle.read(form.offsetsize)
        if any(rest) or len(rest) != form.offsetsize:
            raise Refused(
                f"{file}: expected a directory of pages to its end, got {count} pages and no valid "
                f"place of another; is it cut short?"
            )
        images = (image.imagej_metadata or {}).get("images", count)
        if planes := pages[0].tags.get("UIC2tag"):  # MetaMorph's, behind one page
            images = planes.count
        for described in image.shaped_metadata or ():
            leading = [*described["shape"]]
            while leading and math.prod(described["shape"][len(leading) :]) < pages[0].size:
                leading.pop()
            if len(running := [size for size in leading if size > 1]) > 1:
                raise Refused(
                    f"{file}: expected images along one axis, got {' x '.join(map(str, running))} "
                    f"by tifffile's shape; save the views as a stack of their own"
                )
            if described.get("truncated"):  # an array without directories of its views
                images += math.prod(described["shape"]) // math.prod(pages[0].shape) - 1
        yield pages, int(images)
