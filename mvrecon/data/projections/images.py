"""Projections as images: a folder of TIFF, PNG, DICOM or RTK's files, or one file of several pages.

For TIFF see `mvrecon.data.projections.tiff`, for PNG `png`, for DICOM `dicom_views`, for RTK's
formats `rtk_images`.
"""

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from decimal import Decimal
from itertools import groupby, islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mvrecon.core.files.checks import Refused, check_file, check_link, file_errors, shown
from mvrecon.data.dicom_image import DICOM, DicomImage, dicom_file, same
from mvrecon.data.projections import exposures, rtk_images
from mvrecon.data.projections.descriptions import path_in_set
from mvrecon.data.projections.dicom_views import (
    ACQUIRED,
    ALIKE,
    CAMERA_PLACES,
    COMPARED,
    OBJECT_PLACES,
    dicom_header,
    dicom_pages,
)
from mvrecon.data.projections.ordering import check_steps, ordered
from mvrecon.data.projections.png import png_header, png_pages
from mvrecon.data.projections.stack import VIEWS, Header, PlaceInSet, ProjectionStack
from mvrecon.data.projections.tiff import tiff_header, tiff_pages

#: Formats of image files by their ending; others may be DICOM.
ENDINGS = {".tif": "TIFF", ".tiff": "TIFF", ".png": "PNG", **rtk_images.ENDINGS}
#: The file beside images in which CIL stores their scale and offset.
CIL_SCALES = "scaleoffset.json"
#: Files below a folder without images that are looked at, to name the folder that has some.
LOOKED_AT = 1000
#: Names of dark and flat fields among the views: Octopus numbers them as di0001 and io0001; the
#: ESRF has refHST0000.edf, dark.edf, and darkend0000.edf, a sum of images, which is no field.
FIELDS = {
    "dark": re.compile(r"dark(?!end\d+\.edf)|di\d+\.", re.IGNORECASE),
    "flat": re.compile(r"flat|refhst|io\d+\.", re.IGNORECASE),
}


class ImageFiles(ProjectionStack):
    """Views as images: one in each file, all in one file of several pages, or in an OME set.

    Args:
        files: the views' files, in their order, which for a set is that of its description.

    Warns:
        UserWarning: keys that the reader does not know.

    Raises:
        Refused: images of several sizes or types, colours, a file that is damaged, or one with a
            key to refuse (`TIFF_KEYS`, `PNG_KEYS`, `DICOM_KEYS`).
    """

    def __init__(self, files: Sequence[Path]):
        headers = [header(file) for file in files]
        if _ending(files[0]) == "DICOM" and any(head.dtype.kind == "f" for head in headers):
            headers = [h._replace(dtype=np.dtype("f4")) for h in headers]  # also of a slope of 1
        for file, other in zip(files, headers, strict=True):
            if other[:2] != headers[0][:2]:
                raise Refused(
                    f"{file}: expected {headers[0].words} as {files[0].name}, got {other.words}"
                )
            if len(files) > 1 and other.pages > 1 and not other.places:
                raise Refused(f"{file}: expected one image in each file, got {other.pages}")
            if len(files) > 1 and other.places != headers[0].places:
                raise Refused(
                    f"{file}: expected files of one set by OME's description, as {files[0].name} "
                    f"is, got another; choose by pattern=... (views.pattern)"
                )
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
        where = files[0] if len(files) == 1 else files[0].parent
        pages = [(f, k) for f, head in zip(files, headers, strict=True) for k in range(head.pages)]
        order = _order_of(where, [place for head in headers for place in head.own], len(pages))
        self.stated = {}
        for name in dict.fromkeys((*COMPARED, *(key for head in headers for key in head.stated))):
            own = [text for head in headers for text in head.stated.get(name, [""] * head.pages)]
            self.stated[name] = [own[k] for k in order]
        folder = files[0].parent
        places = {name: self.stated[name] for name in (*CAMERA_PLACES, *OBJECT_PLACES)}
        light = {name: texts for name, texts in self.stated.items() if name not in places}
        exposures.warn_of_several(folder, light)
        exposures.warn_of_several(folder, places, "which the camera must have")
        for name in OBJECT_PLACES:
            del self.stated[name]  # a flat field is taken without the object
        self.files, self.excluded = list(files), headers[0].excluded
        self.pixel_mm = headers[0].pixel_mm
        self.unknown = [name for head in headers for name in head.unknown]
        angles = [angle for head in headers for angle in head.angles]
        self.angles = [angles[k] for k in order] if len(angles) == len(order) else ()
        self.units = ", ".join(sorted({head.units for head in headers} - {""}))
        self._tops = frozenset().union(*(head.tops for head in headers))
        self.detector = {
            "ImagerPixelSpacing": self.pixel_mm,
            **dict(zip(ALIKE, headers[0].alike, strict=False)),
        }
        if all(head.linear for head in headers):
            self.kind = "intensities"
        self._pages = [pages[k] for k in order]
        alone = {file for file, head in zip(files, headers, strict=True) if head.pages == 1}
        names = [f.stem if f in alone else f"{f.stem} {k}" for f, k in self._pages]
        super().__init__(where, names, *headers[0][:2])

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

    def _block(self, first: int, last: int) -> np.ndarray:
        found: list[np.ndarray] = []
        pages = enumerate(self._pages[first:last])
        for (file, _), run in groupby(pages, key=lambda one: (one[1][0], one[1][1] - one[0])):
            numbers = [page for _, (_, page) in run]  # one after the other
            found += _pages(file, numbers[0], numbers[-1] + 1)
        return np.stack(found)


def _order_of(where: Path, own: Sequence[PlaceInSet], pages: int) -> list[int]:
    """The numbers of pages in the order of their places in a set; without a set, as they are."""
    if not own:
        return [*range(pages)]
    counts = [len({*column}) for column in zip(*own, strict=True)]
    names = zip(("images", "C", "Z", "T"), counts, strict=True)
    axes = [f"{count} along {name}" for name, count in names if count > 1]
    if len(axes) > 1 or len({*own}) < len(own):
        raise Refused(
            f"{where}: expected images along one axis of OME's description, got "
            f"{' and '.join(axes) or 'two at one place'}; choose by pattern=... (views.pattern), "
            f"or save the views as a stack of their own"
        )
    return sorted(range(len(own)), key=own.__getitem__)


def view_files(
    folder: Path, pattern: str | None = None, gaps: bool = False, fields: Sequence[Path] = ()
) -> list[Path]:
    """The images of a folder without dark and flat fields, sorted by the InstanceNumber of DICOM
    images, by OME's description of a set of TIFF files, or else by the numbers in their names.

    Args:
        folder: folder of the images; names of `FIELDS` are excluded, unless all are. Other files
            are ignored.
        pattern: pattern of the views' names, such as "scan_*.tif"; None: all images.
        gaps: see `ordered`.
        fields: files of dark and flat fields, which are excluded.

    Warns:
        UserWarning: DICOM images without InstanceNumbers, with equal ones, or acquired in another
            order; see `ordered`.

    Raises:
        Refused: no image, too many, or of several formats; DICOM images of several series, or only
        some with their own InstanceNumber; CIL's scale beside them; see `ordered`.
    """
    excluded = {field.resolve() for field in fields}
    images = [file for file in _images(folder, pattern) if file.resolve() not in excluded]
    views = [f for f in images if not any(x.match(f.name) for x in FIELDS.values())] or images
    _check_kind(folder, views, f" named {pattern}" if pattern else "")
    if _ending(views[0]) == "DICOM":
        stated = _by_instance(views, gaps)
    else:
        stated = _of_set(views, gaps, chosen=pattern is not None)
    return stated or ordered(views, gaps, mixed=pattern is not None)


def field_files(folder: Path, field: str) -> list[Path]:
    """The images of a folder with names of the "dark" or of the "flat" field; may be empty.

    Raises:
        Refused: they are of several formats.
    """
    files = [file for file in _images(folder) if FIELDS[field].match(file.name)]
    if files:
        _check_kind(folder, files, f" of the {field} field")
    return files


def in_field(folder: Path, field: str) -> list[Path]:
    """The images of a folder that is given as the "dark" or the "flat" field, in any order: those
    with its name, else those with the name of neither field, else all.

    Raises:
        Refused: some with its name beside others with the name of neither, no images, or images of
            several formats.
    """
    files, images = field_files(folder, field), _images(folder)
    others = [f for f in images if not any(x.match(f.name) for x in FIELDS.values())]
    if files and others:
        raise Refused(
            f"{folder}: expected images of the {field} field alone, got {files[0].name} and "
            f"{others[0].name}; move them to a folder of their own"
        )
    _check_kind(folder, files or others or images, f" of the {field} field")
    return files or others or images


def _images(folder: Path, pattern: str | None = None) -> list[Path]:
    if (scales := folder / CIL_SCALES).exists():
        raise Refused(
            f"{scales}: expected images with their own values, got CIL's scale and offset; write "
            f"the images without compression, or remove the file if they were applied"
        )
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
    acquired: dict[Path, tuple[Any, ...]] = {}
    series = set()
    for file in files:
        with file_errors(file, "has an InstanceNumber or AcquisitionNumber that cannot be read"):
            dataset = DicomImage(file).dataset
            number = dataset.get("InstanceNumber")
            numbers[file] = None if number is None else int(number)
            series.add(dataset.get("SeriesInstanceUID"))
            first, *times = ("" if v is None else str(v) for v in map(dataset.get, ACQUIRED))
            acquired[file] = first and int(first), times[0] or times[1] + times[2]
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
    for what, one in (("AcquisitionNumber", 0), ("acquisition time", 1)):
        stated = [acquired[file][one] for file in in_order]
        if "" not in stated and any(later < earlier for earlier, later in pairwise(stated)):
            warnings.warn(
                f"{folder}: DICOM projections are in the order of InstanceNumber, but not in that "
                f"of their {what}; are the cameras in this order?",
                stacklevel=2,
            )
    return in_order


def _of_set(files: Sequence[Path], gaps: bool, chosen: bool) -> list[Path]:
    """TIFF files of one set by OME's description, which states their order; no files of others.

    Args:
        files: views in a folder.
        gaps: allow a set with any files missing.
        chosen: allow a set without its first or last files, as chosen by a pattern.
    """
    places = header(files[0]).places if _ending(files[0]) == "TIFF" else {}
    if not places:
        return []
    paths = [path_in_set(file, places) or file.name for file in files]
    names = {*paths}
    if absent := sorted(places.keys() - names if not (gaps or chosen) else []):
        raise Refused(
            f"{files[0].parent}: expected in it the {len(places)} files of the set that OME "
            f"describes in {files[0].name}, got {len(names)} without {shown(absent)}; where views "
            f"were left out on purpose: gaps=true, or pattern=... (views.pattern)"
        )
    if others := sorted(names - places.keys()):
        raise Refused(
            f"{files[0].parent}: expected the files of the set that OME describes in "
            f"{files[0].name}, got {shown(others)} as well; choose by pattern=... (views.pattern); "
            f"a file that was renamed needs its name back"
        )
    if not gaps:
        numbers = [place for path in paths for place in places[path]]
        check_steps(files[0].parent, [[*map(Decimal, place)] for place in numbers])
    return [*files]


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
        return HEADERS.get(_ending(file), dicom_header)(file)


def _pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    with file_errors(file, f"pages {first} to {last - 1} cannot be read"):
        yield from PAGES.get(_ending(file), dicom_pages)(file, first, last)


RTK = rtk_images.ENDINGS.values()
#: Readers of a header and of pages by format; those of others are DICOM's.
HEADERS = {"TIFF": tiff_header, "PNG": png_header, **dict.fromkeys(RTK, rtk_images.rtk_header)}
PAGES = {"TIFF": tiff_pages, "PNG": png_pages, **dict.fromkeys(RTK, rtk_images.rtk_pages)}
