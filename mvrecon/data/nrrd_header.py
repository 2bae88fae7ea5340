"""Headers of NRRD, checked before ITK reads the values."""

import re
from collections.abc import Mapping
from pathlib import Path

from mvrecon.core.files import checks
from mvrecon.core.files.keys import FREE_TEXT, Key, check_keys, check_unknown, warn_of_unknown
from mvrecon.core.files.prose import stated_effects
from mvrecon.data.itk_headers import (
    COPIED,
    COPIED_TEXTS,
    HEADER,
    META_EFFECTS,
    UNEVEN,
    Header,
    finite,
    unit_of_length,
)

#: Maximum characters of a line of an NRRD header, except comments and key/value pairs: ITK
#: overflows a buffer at 1000, which ends the process (SimpleITK 2.5.7; 500 are safe).
LINE = 500
#: Fields of NRRD, all applied by ITK but where noted. A key/value pair (key:=value) is no field.
NRRD_KEYS = (
    Key("dimension, sizes", "applied", "three axes; further ones of one voxel are dropped"),
    Key("type, endian", "applied"),
    Key("encoding", "refused", "", ("raw", "gzip", "gz", "hex", "ascii", "text", "txt")),
    Key("byte skip, line skip", "applied"),
    Key("space directions", "applied", "three vectors"),
    Key("space origin", "applied"),
    Key("spacings", "applied", "where there are no space directions"),
    Key(
        "space",
        "refused",
        "ITK takes other spaces for left-posterior-superior",
        (
            *("left-posterior-superior", "right-anterior-superior", "left-anterior-superior"),
            *("LPS", "RAS", "LAS", "3D-right-handed", "3DR"),
        ),
    ),
    Key("space dimension", "refused", "taken for left-posterior-superior, as by ITK", (2, 3, 4)),
    Key("space units, units", "applied", "by mvrecon, to mm"),
    Key(
        "sample units",
        "refused",
        "convert the values; units of views are compared with their kind",
        ("HU", "hounsfield", "hounsfield units", "1/mm", "mm^-1", "counts", "activity", "unknown"),
    ),
    Key("axis mins", "applied", "beside spacings, by centerings"),
    Key("axis maxs", "refused", "state the voxel size as space directions", ("nan",)),
    Key("old min", "refused", "store the values before they were quantized", ("nan",)),
    Key("old max", "refused", "store the values before they were quantized", ("nan",)),
    Key(
        "centerings, centers",
        "applied",
        "of axis mins: node, or else half a voxel before its centre",
    ),
    Key(
        "kinds",
        "compared",
        "an axis of time is refused unless of one voxel, or that of views: it has no length",
    ),
    Key("data file", "refused", "its values in the same file"),
    Key("measurement frame", "ignored", "of vectors"),
    Key("content", "ignored", FREE_TEXT),
    Key("number, labels", "ignored", "repeated by sizes, and texts"),
    Key("min, max, thicknesses", "ignored", "statistics, and extent of a voxel"),
    *COPIED,
)
#: All fields of NRRD without blanks, which ITK's reader accepts as well.
FIELDS = {name.replace(" ", "") for key in NRRD_KEYS if key not in COPIED for name in key.names}


def nrrd_header(path: Path, text: str, views: bool = False) -> Header:
    """Check the header of a volume, or of views, whose third axis has no length and whose unit is
    that of their kind.
    """
    entries, first = _nrrd_entries(path, text)
    lengths, unit = 2 if views else 3, _word(entries, "sample units")
    keys = [key for key in NRRD_KEYS if not (views and key.name == "sample units")]
    check_keys(path, keys, lambda key: _word(entries, key))
    _check_places(path, entries, lengths)
    kinds, sizes = (entries.get(name, "").lower().split() for name in ("kinds", "sizes"))
    timed = {n for n, kind in enumerate(kinds) if kind == "time"} - ({2} if views else set())
    if any(size != "1" for n, size in enumerate(sizes) if n in timed):
        raise checks.Refused(f"{path}: expected kinds of lengths, got {entries['kinds']}")
    lines, skip = (_whole(path, entries, name, 0) for name in ("line skip", "byte skip"))
    raw, encoding = text.encode("latin-1"), entries.get("encoding", "raw").lower()
    if lines < 0 or skip < (-1 if encoding == "raw" else 0):
        raise checks.Refused(
            f"{path}: expected a line skip and byte skip from 0 (or -1, of raw values), got "
            f"{lines} and {skip}"
        )
    for _ in range(lines):
        first = raw.find(b"\n", first) + 1
        if first == 0:
            raise checks.Refused(f"{path}: expected {lines} lines to skip, got fewer")
    units = [entries.get(name, "") for name in ("units", "spaceunits")]
    quoted = [unit for text in units for unit in re.findall(r'"([^"]*)"', text)[:lengths]]
    mm = unit_of_length(path, quoted or [""], "units and space units")
    names = {"raw": "raw", "gz": "gzip", "gzip": "gzip", "hex": "hex"}
    uneven = entries.get(UNEVEN, "0")
    encoding = names.get(encoding, "text")
    return Header(path, first, encoding, skip, mm, uneven=uneven, unit=unit)


def _word(entries: Mapping[str, str], key: str) -> str:
    """The text of a field, without quotation marks."""
    return entries.get(key.replace(" ", ""), "").strip('"')


def _nrrd_entries(path: Path, text: str) -> tuple[dict[str, str], int]:
    """Fields and texts of an NRRD header up to an empty line, as ITK's C reader splits it (Python's
    `splitlines` also splits at other characters), and the bytes of the header.
    """
    lines = [line.removesuffix("\r") for line in text.split("\n")]
    if not lines[0].startswith("NRRD") or "" not in lines:
        raise checks.Refused(f"{path}: expected an NRRD header of at most {HEADER} bytes")
    count = lines.index("")
    entries: dict[str, str] = {}
    pairs: list[tuple[str, str]] = []
    for line in lines[1:count]:
        name, between, value = line.partition(": ")
        name = name.lower().replace(" ", "")
        free = line.startswith("#") or (":=" in line and ": " not in line)
        if len(line) > LINE and not free:
            raise checks.Refused(
                f"{path}: expected lines of at most {LINE} characters in its header, got "
                f"{checks.shown(line)}"
            )
        if between and name in FIELDS:  # ITK refuses unknown and repeated ones
            entries.setdefault(name, value.strip())
        elif ":=" in line and not line.startswith("#"):
            pairs.append((line.partition(":=")[0], line.partition(":=")[2]))
    alike = [pair for pair in pairs if pair[0].lower().replace(" ", "") in FIELDS]
    warn_of_unknown(path, [f"{name}:=" for name, _ in alike])  # no fields, whatever their names
    texts = [("content", entries.get("content", "")), *(p for p in pairs if p[0] in COPIED_TEXTS)]
    texts += [("#", line[1:]) for line in lines[1:count] if line.startswith("#")]
    others = [pair for pair in pairs if pair not in alike]
    check_unknown(path, others, NRRD_KEYS, META_EFFECTS, stated_effects(texts))
    entries |= {name: value.strip() for name, value in pairs if name == UNEVEN or "|" in name}
    return entries, sum(len(line) + 1 for line in text.split("\n")[: count + 1])


def _whole(path: Path, entries: Mapping[str, str], key: str, default: int) -> int:
    """The whole number of an NRRD's field, as both C and Python read it."""
    text = entries.get(key.replace(" ", ""), str(default))
    if not re.fullmatch("[+-]?[0-9]{1,15}", text):
        raise checks.Refused(f"{path}: expected a whole number as {key}, got {checks.shown(text)}")
    return int(text)


def _check_places(path: Path, entries: Mapping[str, str], lengths: int) -> None:
    """Check the numbers of an NRRD's places along the first axes, which have lengths: ITK ignores
    those that are not finite.
    """
    directions, spacings = entries.get("spacedirections"), entries.get("spacings", "")
    axes = int(entries.get("spacedimension", 3))  # one of those in NRRD_KEYS
    count = _whole(path, entries, "dimension", 3)
    for name, text, vectors in (
        ("space directions", directions, axes),
        ("space origin", entries.get("spaceorigin"), 1),
    ):
        found = re.findall(r"\(([^()]*)\)", text or "")
        rest = re.sub(r"\([^()]*\)|\bnone\b", "", text or "").strip()
        sizes = [len(finite([n.strip() for n in vector.split(",")])) for vector in found]
        if text is not None and (sizes != [axes] * vectors or rest):
            raise checks.Refused(
                f"{path}: expected {name} of {vectors} vectors of {axes} finite numbers, got "
                f"{checks.shown(text)}"
            )
    expected = 0 if directions is not None else min(lengths, count)
    found = [value for value in finite(spacings.split()[:lengths]) if value]
    words = [word for word in spacings.lower().split()[:lengths] if word != "nan"]
    if spacings and (len(found) != expected or len(words) != expected):
        raise checks.Refused(
            f"{path}: expected {expected or 'no'} finite spacings"
            f"{' beside space directions' if directions else ''}, got {checks.shown(spacings)}"
        )
    mins = [word for word in entries.get("axismins", "").lower().split() if word != "nan"][:lengths]
    if mins and not len(finite(mins)) == len(mins) == len(found):
        raise checks.Refused(
            f"{path}: expected axis mins of {lengths} finite numbers beside spacings, got "
            f"{checks.shown(entries['axismins'])}; state the first voxel's place as space origin"
        )
