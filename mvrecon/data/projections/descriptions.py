"""What programs describe in an image beside its tags: OME (Goldberg and others, Genome Biology 6,
2005), Micro-Manager, and the detectors of Dectris, whose negative pixels are bad ones; and what
other texts state.
"""

import math
import posixpath
import re
from bisect import bisect_right
from collections.abc import Container, Mapping, Sequence
from functools import lru_cache
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

from mvrecon.core.files.checks import Refused, millimetres, shown
from mvrecon.core.files.keys import (
    IMAGE_EFFECTS,
    Key,
    has_effect,
    unknown_entries,
    unknown_names,
)
from mvrecon.core.files.prose import brief, statements
from mvrecon.data.projections.exposures import in_base_units, number_of, unneeded
from mvrecon.data.projections.stack import VIEWS, Header, PlaceInSet

#: OME's types of pixels.
TYPES = {f"int{bits}": f"i{bits // 8}" for bits in (8, 16, 32)}
TYPES |= {f"u{name}": f"u{kind[1:]}" for name, kind in TYPES.items()}
TYPES |= {"float": "f4", "double": "f8"}
#: OME's elements with attributes on which grey values depend in a way that is not stated.
OME_BEAM = {
    "DetectorSettings": ("Gain", "Offset", "Binning", "Integration"),
    "LightSourceSettings": ("Attenuation",),
}
#: Entries of Micro-Manager on which grey values depend in a way that is not stated, beside those
#: with a word of `IMAGE_EFFECTS`, such as `Camera-Gain`.
MANAGER_BEAM = ("Binning", "ROI")
#: Entries of Dectris on which grey values depend in a way that is not stated.
DECTRIS_BEAM = (
    *("Tau", "Ratecorr_lut_directory", "Retrigger_mode", "Flat_field"),
    *("Threshold_setting", "Gain_setting", "Energy_range"),
)
KEYS = (
    Key(
        "OME: Plane ExposureTime, Micro-Manager: Exposure-ms, Dectris: Exposure_time",
        "compared",
        "as ExposureTime, in their units",
    ),
    Key("Dectris: Filter_transmission", "compared", "as ExposureTime, under its own name"),
    Key(
        ", ".join(
            [f"OME: {name} {key}" for name, own in OME_BEAM.items() for key in own]
            + [f"Micro-Manager: {name}" for name in (*MANAGER_BEAM, "*Gain*", "*Mirror*")]
            + [f"Dectris: {name}" for name in DECTRIS_BEAM]
        ),
        "compared",
        "of views and flat fields; warned of",
    ),
    Key(
        "OME: SignificantBits, Micro-Manager: BitDepth, Dectris: Count_cutoff",
        "applied",
        "the greatest grey value",
    ),
    Key("OME: Type, OME: SizeX, OME: SizeY", "compared", "with the type and the number of pixels"),
    Key(
        "Dectris: N_excluded_pixels",
        "compared",
        "with the number of negative pixels, which are bad ones; warned of if there are fewer",
    ),
    Key("Dectris: Pixel_size", "compared", "with the cameras' pixel size"),
    Key(
        "Dectris: Start_angle, Dectris: Angle_increment, Dectris: Detector_distance, "
        "Dectris: Beam_xy, Dectris: Detector_Voffset",
        "ignored",
        "the camera decides",
    ),
    Key(
        ", ".join(
            f"Dectris: {name}"
            for name in (
                *("Detector", "Silicon*", "thickness", "Exposure_period", "Excluded_pixels"),
                *("Trim_*", "Image_path", "Wavelength", "Detector_2theta", "Flux", "Polarization"),
                *("Alpha", "Kappa", "Phi*", "Chi*", "Oscillation_axis", "N_oscillations"),
                *("Start_position", "Position_increment", "Shutter_time", "CBF_Template_file"),
            )
        ),
        "ignored",
        "of the scan and the detector",
    ),
    Key(
        "ImageJ: ImageJ, ImageJ: images, ImageJ: channels, ImageJ: slices, ImageJ: frames, "
        "ImageJ: cf, ImageJ: c0, ImageJ: c1, SCIFIO: SCIFIO, SCIFIO: axes, SCIFIO: lengths, "
        "SCIFIO: images, SCIFIO: channels, SCIFIO: slices, SCIFIO: frames, tifffile: shape, "
        "tifffile: axes, tifffile: truncated",
        "compared",
        "the axes and the calibration, as ImageDescription's",
    ),
    Key(
        "ImageJ: unit, ImageJ: ?unit, ImageJ: spacing, ImageJ: ?origin, ImageJ: min, ImageJ: max, "
        "ImageJ: mode, ImageJ: loop, ImageJ: hyperstack, ImageJ: finterval, ImageJ: fps, "
        "SCIFIO: unit*, SCIFIO: scales, SCIFIO: bitsPerPixel, SCIFIO: mode, SCIFIO: hyperstack",
        "ignored",
        "of the pixel size, the display, and the name of values that cf calibrates",
    ),
)
#: Texts that any program writes, unless they state more, such as "Title: scaled by 2".
TEXTS = Key(
    "*: date, *: date.create, *: date.modify, *: date.timestamp, *: date?time, *: datetime, "
    "*: timestamp, *: creation?time, *: title, *: author, *: artist, *: operator, "
    "*: user, *: copyright, *: software, *: software?version, *: softwareversion, *: version, "
    "*: make, *: model, *: host, *: hostname, *: host?computer, *: hostcomputer, "
    "*: file?name, *: filename",
    "ignored",
    "texts of any program, unless they contain other entries or words such as scaled",
)
#: A date or a time of day, as the value of an entry of any name.
DATED = re.compile(
    r"(?=.*\d[-/.:]\d)(\d{2,4}[-/.:]\d\d?[-/.:]\d{2,4})?[T ]*(\d\d?:\d\d(:\d\d([.,]\d+)?)?)?"
    r" *(Z|[+-]\d\d:?\d\d|am|pm)?",
    re.IGNORECASE,
)
#: Programs that describe images in lines of a name and a value, and marks of their texts.
MARKS = {
    "ImageJ": r"^ImageJ=",
    "SCIFIO": r"^SCIFIO=",
    "Dectris": r"^# *(Exposure_time|Count_cutoff|N_excluded_pixels)\b",
    "tifffile": r"^\{\"shape\": ",
}
#: The root of OME's description, an attribute of its elements, and a line and a number of Dectris.
OME, ATTRIBUTE = re.compile(r"<(\w+:)?OME\b"), re.compile(r"([\w-]+)\s*=\s*[\"']([^\"']*)[\"']")
#: Parts of OME's description that may quote its elements: comments, and what other programs wrote.
QUOTED = re.compile(
    r"<!--.*?-->|<(?:\w+:)?(StructuredAnnotations|OriginalMetadata)\b[^>]*(?<!/)>"
    r".*?</(?:\w+:)?\1\s*>",
    re.DOTALL,
)
#: The identifier of a file in the root of OME's description.
OWN_ID = re.compile(r"(?<=[\s\"'])UUID\s*=\s*(\"[^\"]*\"|'[^']*')")
#: An element of OME's description that says which page of a file is which image.
PLACED = re.compile(r"<(?:\w+:)?TiffData\b([^>]*?)(?:/>|>(.*?)</(?:\w+:)?TiffData\s*>)", re.DOTALL)
LINE = re.compile(r"^[ \t]*# *(\w+)[ =:]+(.*?)\s*$", re.MULTILINE)
NUMBER = re.compile(r"([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*([^\W\d]*)")
#: OME's description, and the texts of its authors in it.
OF_OME = re.compile(r"<(\w+:)?OME\b.*", re.DOTALL)
AUTHORS = re.compile(r"<(?:\w+:)?Description>([^<]*)<")
#: A comma between thousands.
THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")


def without_own_id(text: str) -> str:
    """OME's description without the identifier of its own file, so that all files of a set have one
    text, which is parsed once.
    """
    return OWN_ID.sub("", text, count=1)


@lru_cache(maxsize=32)
def unknown_parts(text: str) -> list[str]:
    """What a text states beside the entries of `KEYS` and `TEXTS`, but no entry whose value is
    zero, empty or a word such as "off". Of OME's text these are the parts of its authors'
    descriptions; that of MetaMorph has none.
    """
    if text.startswith("<MetaData"):
        return []
    text = OF_OME.sub(lambda found: "\n".join(AUTHORS.findall(found[0])), text)
    program = next((name for name, mark in MARKS.items() if re.search(mark, text, re.M)), "text")
    if program == "Dectris":
        text = LINE.sub(r"\1: \2", text)
    parts = {
        f"{program}: {name}": (name, *found)
        for name, found in statements(text).items()
        if not DATED.fullmatch(found[0].strip())
    }
    unknown = unknown_entries({key: value for key, (_, value, _) in parts.items()}, KEYS)
    others = {*unknown_names(map(str.lower, unknown), [TEXTS])}
    shown = {key: brief(*parts[key]) for key in unknown}
    return [text for key, text in shown.items() if key.lower() in others or text != parts[key][0]]


@lru_cache(maxsize=4)
def images(text: str) -> list[str]:
    """OME's description in parts: up to the first image, and from each image to the next; no part
    of other texts.
    """
    text = QUOTED.sub("", text)
    return re.split(r"<(?:\w+:)?Image\b", text) if OME.search(text) else []


@lru_cache(maxsize=32)
def elements(text: str, name: str) -> list[tuple[int, dict[str, str]]]:
    """The elements of a name in OME's description: the number of its image, and its attributes."""
    found = [re.findall(rf"<(?:\w+:)?{name}\b([^>]*)>", part) for part in images(text)]
    return [(n, dict(ATTRIBUTE.findall(one))) for n, part in enumerate(found) for one in part]


@lru_cache(maxsize=4)
def places_in_set(text: str) -> dict[str, list[PlaceInSet]]:
    """The places of the pages of each file of a set, by the file's path, as OME's description
    states them; empty where it names fewer than two files.
    """
    pages: dict[str, list[tuple[int, PlaceInSet]]] = {}
    sizes = dict(elements(text, "Pixels"))
    for number, image in enumerate(images(text)):
        axes = _axes(sizes.get(number, {}))
        found = [[dict(ATTRIBUTE.findall(part)) for part in one] for one in PLACED.findall(image)]
        starts = sorted(_index(own, axes) for own, _ in found)
        for own, name in found:
            if "FileName" not in name:
                continue
            first, start = int(own.get("IFD", 0)), _index(own, axes)
            count = int(own.get("PlaneCount", 1))
            if not {"IFD", "PlaneCount"} & {*own}:  # all pages of the file
                after = starts[bisect_right(starts, start) :]
                count = (after[0] if after else math.prod(n for _, n in axes)) - start
            run = [(number, *_at(start + k, axes)) for k in range(1, min(count, VIEWS))]
            path = posixpath.normpath(unescape(name["FileName"]).replace("\\", "/"))
            those = pages.setdefault(path, [])
            those += enumerate([_place(number, own, "First"), *run], first)
    if len(pages) < 2:
        return {}
    return {name: [place for _, place in sorted(those)] for name, those in pages.items()}


def path_in_set(file: Path, places: Container[str]) -> str | None:
    """The longest of the paths of a set in which that of a file ends; None of others."""
    parts = file.absolute().parts
    tails = ("/".join(parts[k:]) for k in range(1, len(parts)))
    return next((tail for tail in tails if tail in places), None)


def _axes(pixels: Mapping[str, str]) -> list[tuple[str, int]]:
    """The axes of OME's pixels with their sizes; planes run along the first of them first."""
    order = pixels.get("DimensionOrder", "XYCZT")[2:]
    return [(axis, max(int(pixels.get(f"Size{axis}", 1)), 1)) for axis in order]


def _index(own: Mapping[str, str], axes: Sequence[tuple[str, int]]) -> int:
    """The number of the first plane of an element, in the order of the axes."""
    index, step = 0, 1
    for axis, size in axes:
        index, step = index + step * int(own.get(f"First{axis}", 0)), step * size
    return index


def _at(index: int, axes: Sequence[tuple[str, int]]) -> PlaceInSet:
    """The plane of a number, along C, Z and T."""
    place: dict[str, int] = {}
    for axis, size in axes:
        index, place[axis] = divmod(index, size)
    return tuple(place.get(axis, 0) for axis in "CZT")


@lru_cache(maxsize=4)
def _planes(text: str) -> dict[PlaceInSet, list[dict[str, str]]]:
    """The planes of OME's description by their places."""
    planes: dict[PlaceInSet, list[dict[str, str]]] = {}
    for number, plane in elements(text, "Plane"):
        planes.setdefault(_place(number, plane, "The"), []).append(plane)
    return planes


def _place(number: int, attributes: Mapping[str, str], start: str) -> PlaceInSet:
    """The place of an image by its attributes TheC .. or FirstC .."""
    return number, *(int(attributes.get(f"{start}{axis}", 0)) for axis in "CZT")


def of_page(file: Path, head: Header, text: str, manager: Any) -> Header:
    """The header of one page with what Micro-Manager and Dectris state of it.

    Args:
        file: path of the file, for messages.
        head: the header by the tags of the page.
        text: the description of the page.
        manager: metadata of Micro-Manager, None of others.

    Warns:
        UserWarning: entries that are no numbers, or more bits than pixels have; they are not used.
    """
    stated = {name: list(texts) for name, texts in head.stated.items()}
    if isinstance(manager, dict):
        bits, ms = (_of_manager(file, name, manager) for name in ("BitDepth", "Exposure-ms"))
        if bits is not None:
            with unneeded():
                head = head._replace(tops=_tops(file, "BitDepth", bits, head))
        if ms is not None:
            _add(stated, "ExposureTime", 0, milliseconds(file, ms, "ms"))
        for name, value in manager.items():
            if name in MANAGER_BEAM or has_effect(name, "", IMAGE_EFFECTS):
                value = value.get("PropVal") if isinstance(value, dict) else value
                _add(stated, f"Micro-Manager {name}", 0, str(value))
    head = head._replace(stated=stated)
    if re.search(MARKS["Dectris"], text, re.M):
        return _of_dectris(file, head, dict(LINE.findall(text)))
    return head


def _of_dectris(file: Path, head: Header, entries: Mapping[str, str]) -> Header:
    """The header of a page with the entries of a detector of Dectris, as texts by name."""
    stated = {name: list(texts) for name, texts in head.stated.items()}

    def numbers(name: str, count: int = 1) -> tuple[list[float], str]:
        text = THOUSANDS.sub("", entries[name]) if name == "Count_cutoff" else entries[name]
        found = NUMBER.findall(text)
        if len(found) < count or re.search(r"\d,\d", text):
            raise Refused(f"{file}: expected {name} as {count} numbers, got {shown(entries[name])}")
        return [float(number) for number, _ in found[:count]], found[0][1]

    for name in {*DECTRIS_BEAM} & {*entries}:
        _add(stated, name, 0, entries[name])
    if "Exposure_time" in entries:
        with unneeded():
            (time,), unit = numbers("Exposure_time")
            _add(stated, "ExposureTime", 0, milliseconds(file, time, unit))
    if "Filter_transmission" in entries:
        with unneeded():
            _add(stated, "Filter_transmission", 0, f"{numbers('Filter_transmission')[0][0]:g}")
    if "Count_cutoff" in entries:
        with unneeded():
            ((top,), _) = numbers("Count_cutoff")
            if top > 0:  # -1: none
                (of_type,) = head.tops  # which clips counts as well
                head = head._replace(tops=frozenset([min(top, of_type or top)]))
    if "Pixel_size" in entries:
        with unneeded():
            (right, down), unit = numbers("Pixel_size", 2)
            mm = millimetres(file, unit)
            head = head._replace(pixel_mm=(down * mm, right * mm))
    if head.dtype.kind == "i":
        head = head._replace(excluded=0)
        with unneeded():
            if "N_excluded_pixels" in entries:
                head = head._replace(excluded=int(numbers("N_excluded_pixels")[0][0]))
    return head._replace(stated=stated)


def of_file(file: Path, head: Header, text: str, own: Sequence[PlaceInSet]) -> Header:
    """The header of all pages, in the order of the images, with what OME states of them.

    Args:
        file: path of the file, for messages.
        head: the header by the tags of the pages.
        text: the description of the first page.
        own: places of the pages in a set of files; none of a file alone.

    Raises:
        Refused: another type of pixels than it states, or more bits than they have.
    """
    stated = {name: list(texts) for name, texts in head.stated.items()}
    for _, pixels in elements(text, "Pixels"):
        size = tuple(int(pixels.get(f"Size{a}", n)) for a, n in zip("YX", head.shape, strict=True))
        if size != head.shape:
            raise Refused(
                f"{file}: expected {size[0]} x {size[1]} pixels by OME's SizeY and SizeX, got "
                f"{head.shape[0]} x {head.shape[1]}; were the images cut or turned? Save them "
                f"without that description"
            )
        kind = pixels.get("Type", "")
        if np.dtype(TYPES.get(kind, head.dtype)) != head.dtype.newbyteorder("="):
            raise Refused(f"{file}: expected pixels of OME's Type {kind}, got {head.dtype}")
        if (bits := pixels.get("SignificantBits")) is not None:
            head = head._replace(tops=_tops(file, "SignificantBits", bits, head))
    for name, keys in OME_BEAM.items():
        for key in keys:
            found = sorted({one[key] for _, one in elements(text, name) if key in one})
            for page in range(head.pages if found else 0):
                _add(stated, f"{name} {key}", page, " or ".join(found), head.pages)
    planes = _planes(text)
    pages = [(sum(place[1:]), place) for place in planes]  # one of C, Z and T runs
    for page, place in enumerate(own) if own else pages:
        for plane in planes.get(place, ()):
            if "ExposureTime" in plane and page < head.pages:
                unit = plane.get("ExposureTimeUnit", "s")
                if (time := number_of(plane["ExposureTime"], f"{file}: ExposureTime")) is not None:
                    _add(stated, "ExposureTime", page, milliseconds(file, time, unit), head.pages)
    return head._replace(stated=stated)


def _of_manager(file: Path, name: str, entries: dict[str, Any]) -> float | None:
    """A number of Micro-Manager, also in a property map; None of other entries."""
    value = entries.get(name)
    value = value.get("PropVal") if isinstance(value, dict) else value
    return None if value is None else number_of(value, f"{file}: {name}")


def milliseconds(file: Path, time: float, unit: str) -> str:
    """An exposure time in ms, as in DICOM; "" of an unknown unit."""
    seconds = float(in_base_units(np.array(time), "ExposureTime", unit, file))
    return "" if math.isnan(seconds) else f"{1000 * seconds:.6g}"


def _add(stated: dict[str, list[str]], name: str, page: int, text: str, pages: int = 1) -> None:
    """Add what a page states by a name; both where the page states something else already."""
    texts = stated.setdefault(name, [""] * pages)
    texts[page] = " or ".join(sorted({texts[page], text} - {""}))


def _tops(file: Path, name: str, bits: Any, head: Header) -> frozenset[float | None]:
    """The greatest grey value of so many bits; none of floats."""
    if head.dtype.kind == "f":
        return head.tops
    if not 0 < int(bits) <= 8 * head.dtype.itemsize:
        most = 8 * head.dtype.itemsize
        raise Refused(f"{file}: expected {name} from 1 to {most} bits, got {bits}")
    return frozenset([2.0 ** (int(bits) - (head.dtype.kind == "i")) - 1])
