"""VGStudio's volumes: the text .vgi, and the raw values .vol beside it."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from mvrecon.core.files.checks import (
    SPACING_MM,
    Refused,
    check_declared,
    check_file,
    file_errors,
    millimetres,
    plain_name,
    shown,
)
from mvrecon.core.files.keys import (
    EFFECTS,
    Key,
    check_keys,
    check_unknown,
    has_effect,
    section_entries,
)
from mvrecon.data.resample import Slab, Slabs, planes
from mvrecon.geometry.grid import Grid

#: Types of values, and the bits that they have.
TYPES = {"unsigned integer": "u", "signed integer": "i", "float": "f"}
BITS = {"u": (8, 16, 32, 64), "i": (8, 16, 32, 64), "f": (32, 64)}
KEYS = (
    Key("size, name, datatype, bitsperelement, skipheader", "applied", "of [file1]"),
    Key("resolution, unit", "applied", "of [geometry]; the volume's centre is the origin"),
    Key("representation.size, representation.datatype", "compared", "with those of [file1]"),
    Key("representation.bitsperelement", "compared", "with that of [file1]"),
    Key(
        "datarange",
        "compared",
        "with that of [file1], unless of floats and 0 -1, and with all values, unless 0 -1 or 0 0",
    ),
    Key("regionofinterestend", "compared", "with size of [file1]: the last voxel"),
    Key("fileformat", "refused", "plain numbers, little endian", ("raw",)),
    *(
        Key(name, "refused", "the volume's centre is the origin", ("0 0 0",))
        for name in ("relativeposition", "position")
    ),
    *(
        Key(name, "refused", "all voxels, in the order of the values", ("0 0 0", "0 0 0 0"))
        for name in ("regionofintereststart", "mirror")
    ),
    Key("samplingdistance", "refused", "each voxel of the file", ("1 1 1", 1)),
    Key("resamplemode", "refused", "each voxel of the file", ("not activated",)),
    Key("filerange", "refused", "store the values that it gives", ("0 -1",)),
    Key("rotate", "refused", "axes are those of the values", ("1 0 0 0 1 0 0 0 1",)),
    Key("scale", "refused", "resolution is that of the voxels", ("1 1 1",)),
    Key("file2.name", "refused", "all values in one file"),
    Key("center", "ignored", "of the rotation"),
    Key("status, text, clipbox", "ignored", "of the display"),
    Key(
        "[volume*], [description*], [version], [view*], [perspective*], [light*], [angle*], "
        "[resolution*], [rendering*], [section*], [segment*], [histogram*], [scalebar*], [scene*], "
        "[camera*], [clip*]",
        "ignored",
        "sections of the display",
    ),
    Key("[calibration], [mapping]", "refused", "and sections of the like: apply what they state"),
)

#: Sections whose unknown keys are checked, known keys, and the words of unknown ones.
SECTIONS = ("[representation]", "[file1]", "[geometry]")
KNOWN = {name for key in KEYS for name in key.names}
#: Ranges that state none.
NO_RANGE = ("", "0 -1", "0 0")
#: Values of an entry that states nothing, and the share of a range that its text rounds.
NOTHING, ROUNDING = ("", "none", "no", "false", "off", "not activated", "invisible"), 1e-5
VGI_EFFECTS = {**EFFECTS, "mapping|swap|origin|translat|transform|shear|header.?size": None}


def _plain(text: str) -> str:
    """Numbers of a list in their shortest form; other texts as they are."""
    try:
        return " ".join(f"{float(word) + 0.0:g}" for word in text.split())
    except ValueError:
        return text


def _entries(path: Path) -> dict[str, str]:
    """The entries of a .vgi by their sections, as `file1.size`.

    Warns:
        UserWarning: other unknown entries, and sections.

    Raises:
        Refused: several volumes, unknown entries that change values or geometry, or two sections
            that state other values.
    """
    entries: dict[str, str] = {}
    pairs: list[tuple[str, str]] = []
    for section, name, value in section_entries(path):
        name = f"{section.strip('[]')}.{name}"
        alone = section == "[file1]" or name in ("geometry.resolution", "geometry.unit")
        if entries.setdefault(name, value) != value and alone:
            raise Refused(f"{path}: expected one volume, got the {name} {shown(value)} as well")
        if section not in SECTIONS:
            if _plain(value).lower() not in NOTHING:
                effect = has_effect(section, "", VGI_EFFECTS)  # [calibration] and the like
                pairs.append((name if effect or not section else section, value))
        elif name not in KNOWN and name.partition(".")[2] not in KNOWN:
            pairs.append((name, value))
    check_unknown(path, pairs, KEYS, VGI_EFFECTS)
    floats = entries.get("file1.datatype", "").lower() == "float"  # are not mapped to a range
    for name in ("size", "datarange", "datatype", "bitsperelement"):
        pair = [entries.get(f"{place}.{name}", "") for place in ("representation", "file1")]
        if name == "datarange" and floats and _plain(pair[0]) in NO_RANGE:
            continue
        if pair[0] and " ".join(pair[0].lower().split()) != " ".join(pair[1].lower().split()):
            raise Refused(
                f"{path}: expected the {name} {shown(pair[0])} of [representation] in [file1], got "
                f"{shown(pair[1])}"
            )
    return entries


def _range(path: Path, text: str, dtype: np.dtype) -> tuple[float, float]:
    """The range of values, infinite unless it is stated, and larger by its rounding.

    Raises:
        Refused: no range, or one that integers of this type cannot have.
    """
    if _plain(text) in NO_RANGE:
        return -math.inf, math.inf
    with file_errors(path, "has no datarange", "expected two numbers"):
        low, high = (float(word) for word in text.split())
        share = ROUNDING * max(abs(low), abs(high))
        below, above = (share + _half_a_digit(word) for word in text.split())
        ends = (-math.inf, math.inf)
        if dtype.kind != "f":
            ends = (float(np.iinfo(dtype).min), float(np.iinfo(dtype).max))
        if not math.isfinite(high - low):
            raise Refused(
                f"{path}: expected a datarange of finite values, or 0 -1, which states none, got "
                f"{text}; correct it where the values are stored as they are"
            )
        if not (ends[0] <= low + below and low <= high and high - above <= ends[1]):
            raise Refused(
                f"{path}: expected a datarange of values of {dtype.name} as they are stored, got "
                f"{text}; store the values that it gives"
            )
        return low - below, high + above


def _half_a_digit(word: str) -> float:
    """Half a unit of the last digit of a number as it is written, by which it may be rounded."""
    digits, _, exponent = word.lower().partition("e")
    return float(f"0.5e{int(exponent or 0) - len(digits.partition('.')[2])}")


def open_vgi(path: str | Path) -> tuple[Slabs, Grid]:
    """Open a volume: values as stored, and a grid in mm whose centre is the origin; the axes x, y
    and z are those of the file, x the fastest.

    Args:
        path: path of the .vgi.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: a missing entry, one to refuse (`KEYS`), or a .vol of another length.
    """
    path = Path(path).expanduser()
    check_file(path, "VGStudio's .vgi")
    entries = _entries(path)

    def numbers(name: str, count: int) -> list[float]:
        with file_errors(path, f"has no {name}", "expected numbers"):
            found = [float(word) for word in entries[name].split()]
        if len(found) != count or not all(0 < x < math.inf for x in found):
            raise Refused(f"{path}: expected {count} positive {name}, got {shown(entries[name])}")
        return found

    for start in (*(f"{section.strip('[]')}." for section in SECTIONS), ""):
        own = {n.removeprefix(start): _plain(v) for n, v in entries.items() if n.startswith(start)}
        check_keys(path, KEYS, own.get)
    x, y, z = (int(n) for n in numbers("file1.size", 3))
    end = _plain(entries.get("file1.regionofinterestend", ""))
    if end not in ("", f"{x - 1} {y - 1} {z - 1}", f"{x} {y} {z}"):
        raise Refused(f"{path}: expected RegionOfInterestEnd of all {x} {y} {z} voxels, got {end}")
    kind, bits = entries.get("file1.datatype", "").lower(), numbers("file1.bitsperelement", 1)[0]
    unit = millimetres(path, entries.get("geometry.unit", ""))
    with file_errors(path, "has no known type of values"):
        if bits not in BITS[TYPES[kind]]:
            raise Refused(f"{path}: expected BitsPerElement {BITS[TYPES[kind]]}, got {bits:g}")
        dtype = np.dtype(f"<{TYPES[kind]}{int(bits) // 8}")
        mm = [size * unit for size in numbers("geometry.resolution", 3)]
        skip = int(entries.get("file1.skipheader", "0") or 0)
    if not all(SPACING_MM[0] <= size <= SPACING_MM[1] for size in mm):
        raise Refused(f"{path}: expected voxels within {SPACING_MM} mm, got {mm}")
    data = path.with_name(plain_name(entries.get("file1.name", "").removeprefix("./"), path))
    check_file(data, f"the values of {path.name}")
    check_declared(path, (z, y, x), dtype.itemsize, data, skip)
    if (got := data.stat().st_size) != skip + x * y * z * dtype.itemsize:
        raise Refused(f"{path}: expected {skip + x * y * z * dtype.itemsize} bytes, got {got}")
    low, high = _range(path, entries.get("file1.datarange", ""), dtype)

    def passes() -> Iterator[Slab]:
        step = planes(y * x)
        with file_errors(data, "cannot be read"), data.open("rb") as file:
            file.seek(skip)  # no memory map: a file cut short meanwhile would end the process
            for first in range(0, z, step):
                shape = (min(step, z - first), y, x)
                values = np.fromfile(file, dtype, math.prod(shape)).reshape(shape)
                slab = torch.from_numpy(values.astype("float32"))
                if not slab.isfinite().all():
                    raise Refused(f"{data}: expected finite values, got NaN or infinite ones")
                if (least := slab.min().item()) < low or (most := slab.max().item()) > high:
                    got = f"{least:g}" if least < low else f"{most:g}"
                    raise Refused(
                        f"{path}: expected values within the datarange "
                        f"{entries['file1.datarange']}, got {got}; store the values that it gives"
                    )
                yield first, slab

    grid = Grid.centred(size=(x, y, z), spacing=(mm[0], mm[1], mm[2]))
    return Slabs((z, y, x), 0, passes), grid
