"""The order of images by the numbers in their names."""

import math
import re
import warnings
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise, product, zip_longest
from pathlib import Path
from typing import Any

from mvrecon.core.files.checks import Refused, shown

#: A number in a name: a decimal such as 0.25, or .5 behind a separator, but not part of 1.2.3; and
#: an integer.
DECIMAL = r"(?:(?<![0-9.])[0-9]+|(?<![^-+_ =]))\.[0-9]+(?![0-9.])"
INTEGER = "[0-9]+"
#: A number with an exponent, 5e-1 or 1.5e2; and one that may be two numbers, 1e2. Not behind a
#: letter of any alphabet: bone2e-001 is the first image of bone2e.
APART = r"(?<![0-9a-z.]|[^ -~])"
SCIENTIFIC = rf"{APART}(?:[0-9]+(?:\.[0-9]+)?e[-+]|[0-9]+\.[0-9]+e)[0-9]{{1,3}}(?![0-9.a-z])"
EXPONENT = rf"{APART}[0-9]+e[0-9]{{1,3}}(?![0-9.a-z])"
#: A decimal with a comma, which may be two numbers.
COMMA = r"(?<![0-9.,])[0-9]+,[0-9]+(?![0-9.,])"
#: A separator and a minus before a number, which is a sign; and an integer with leading zeros, a
#: serial number, before which it is none.
NEGATIVE, PADDED = re.compile("[_= ]-$"), re.compile("0[0-9]+")
#: A number in a label of an image, with its sign; and labels of images that are no views.
SIGNED = r"(?:(?<=[_= ])-)?\d+(?:\.\d+)?"
FIELD_LABEL = re.compile(r"(?<![a-z])(dark|flat)", re.IGNORECASE)


def ordered(paths: Sequence[Path], gaps: bool = False, mixed: bool = False) -> list[Path]:
    """Sort files by the numbers in their names, so that view_10 follows view_9, and 0.5 follows
    0.25.

    Args:
        paths: paths of the files of one folder.
        gaps: allow unequal steps, as of views left out on purpose.
        mixed: allow several kinds of names, as chosen on purpose.

    Warns:
        UserWarning: names that differ in more than their numbers; they are sorted as text. Or all
            numbers are negative, or decimals that may be several integers have unequal steps.

    Raises:
        Refused: two names with the same numbers, a missing number, numbers that may be read in two
            ways of another order (1e2, 0,5, but not a series with 2,9 and 2,10), or several kinds
            of names, one of which is numbered: some may be references or previews.
    """
    if len(paths) < 2:
        return list(paths)
    where, stems = paths[0].parent, [re.sub(SCIENTIFIC, "x", path.stem.lower()) for path in paths]
    signed = any(re.search(SCIENTIFIC, path.stem.lower()) for path in paths)
    exponents = f"{SCIENTIFIC}|{EXPONENT}|" if signed else f"{SCIENTIFIC}|"  # 1e-1 and 1e0
    number = exponents + (INTEGER if _counted(DECIMAL, stems) else f"{DECIMAL}|{INTEGER}")
    files, parts, keys = _sorted(paths, number)
    rows = [keys[path][1::2] for path in files]
    alike = len({tuple(part[::2]) for part in parts.values()}) == 1
    pairs = alike and _counted(COMMA, stems) and not _missing(rows)  # 2,10 is no 2.1
    readings = [rows]
    for other in (EXPONENT,) if pairs else (EXPONENT, COMMA):
        found = filter(None, (re.search(other, path.stem.lower()) for path in files))
        if (such := next(found, None)) is None:
            continue
        sequence, _, values = _sorted(paths, f"{other}|{number}")
        readings.append([values[path][1::2] for path in files])
        if sequence != files:
            raise Refused(
                f"{where}: expected names whose numbers can be read in one way, got {such[0]}, "
                f"which may be one number or two, in another order; rename the files: decimals "
                f"with a point and without exponents, other numbers with equally many digits "
                f"(2,05) or another sign between them (2_5)"
            )
    columns = zip(*(part[1::2] for part in parts.values()), strict=False)
    if any(len({*texts}) > 1 and all(text[0] == "-" for text in texts) for texts in columns):
        warnings.warn(
            f"{where}: the numbers in the names of all views are taken to be negative: "
            f"{files[0].name}, {files[1].name}, ...",
            stacklevel=2,
        )
    if not alike:
        _check_kinds(where, files, [tuple(parts[path][::2]) for path in files], mixed)
        return files
    for first, second in zip(files, files[1:], strict=False):
        if keys[first] == keys[second]:
            raise Refused(
                f"{where}: expected one file of every number, got {shown(first.name)} and "
                f"{shown(second.name)}"
            )
    sequence, _, values = _sorted(paths, exponents + INTEGER)
    whole = [values[path][1::2] for path in files]
    if sequence == files and all(map(_by_one, zip(*whole, strict=False))):  # 1.1 to 1.9, 2.1 to 2.9
        readings.append(whole)
    _check_counters(where, files, rows)
    if all(map(_missing, readings)):
        if not gaps:
            check_steps(where, rows)
        if sequence != files:  # and no steps decide between them
            warnings.warn(
                f"{where}: the numbers in the names of the views are taken for decimals: "
                f"{', '.join(path.name for path in files[:4])}, ...",
                stacklevel=2,
            )
    return files


def _check_kinds(
    where: Path, files: Sequence[Path], words: Sequence[tuple[str, ...]], mixed: bool
) -> None:
    """Warn of files whose names differ in more than their numbers, by the words of each name; raise
    if some of the names are numbered, unless these are mixed on purpose.
    """
    kinds: dict[tuple[str, ...], list[Path]] = {}
    for path, own in zip(files, words, strict=True):
        kinds.setdefault(own, []).append(path)
    examples = [f"{len(kind)} such as {kind[0].name}" for kind in kinds.values()]
    got = " and ".join([*examples[:4], *(["others"] if len(kinds) > 4 else [])])
    if len(kinds) < len(files) and not mixed:
        raise Refused(
            f"{where}: expected views whose names differ in their numbers alone, got {got}; "
            f"choose the views by pattern=... (views.pattern), such as scan_*.tif, or * for "
            f"all, and give dark and flat fields by dark and flat (views.dark, views.flat)"
        )
    warnings.warn(
        f"{where}: names of the views differ in more than their numbers; they are in the order of "
        f"their text: {', '.join(path.name for path in files[:4])}, ...; there are {got}",
        stacklevel=3,
    )


def _sorted(
    paths: Sequence[Path], number: str
) -> tuple[list[Path], dict[Path, list[str]], dict[Path, list[str | Decimal]]]:
    """Files by the numbers in their names, the words and numbers of each name, and as sorted.

    Args:
        paths: paths of the files.
        number: pattern of numbers.
    """
    splits = {path: re.split(f"({number})", path.stem.lower()) for path in paths}
    parts = {  # without the blanks that align numbers: image   9, image  10
        path: [text if k % 2 else text.rstrip() for k, text in enumerate(split)]
        for path, split in splits.items()
    }
    _move_signs(list(parts.values()))
    keys = {
        path: [Decimal(text.replace(",", ".")) if k % 2 else text for k, text in enumerate(part)]
        for path, part in parts.items()
    }
    return sorted(paths, key=lambda path: (keys[path], path.name)), parts, keys


def _move_signs(parts: Sequence[list[str]]) -> None:
    """Move the + or - before a number to it, where some names have it and others do not, or
    another, or where a separator comes before it: in tilt_-10 and tilt_0 it is a sign, and in
    tilt_-10 and tilt_-20; in scan-1 and scan-2 a dash, and in scan_-001 and scan_-002.
    """
    if len({len(part) for part in parts}) > 1:
        return
    for k in range(0, len(parts[0]) - 1, 2):
        words, numbers = ({part[place] for part in parts} for place in (k, k + 1))
        signs = len(words) > 1 and len({re.sub("[-+]$", "", word) for word in words}) == 1
        negative = all(NEGATIVE.search(word) or word == "-" and k == 0 for word in words)
        serial = len(numbers) == 1 or any(map(PADDED.fullmatch, numbers))
        if signs or (negative and not serial):
            for part in (part for part in parts if part[k][-1:] in ("+", "-")):
                part[k], part[k + 1] = part[k][:-1], part[k][-1] + part[k + 1]


def _counted(pattern: str, stems: Sequence[str]) -> bool:
    """Whether what matches a pattern of decimals in names, at one of its places, are pairs of
    integers: after "1.9" comes "1.10", which is the smaller decimal.
    """
    for column in zip_longest(*(re.findall(pattern, stem) for stem in stems)):
        places = [re.split("[.,]", text)[1] for text in column if text]
        if len({*map(len, places)}) > 1 and any(re.fullmatch(".+0", part) for part in places):
            return True
    return False


def _by_one(column: Sequence[Any]) -> bool:
    """Whether a number of the names takes all values from its least to its greatest."""
    return max(column) - min(column) < len({*column})


def _check_counters(where: Path, files: Sequence[Path], numbers: Sequence[Sequence[Any]]) -> None:
    """Warn of files that a later number counts in another order, as in angle_index; the first one
    of index_angle is a counter itself.
    """
    columns = [column for column in zip(*numbers, strict=True) if len({*column}) > 1]
    counters = [c for c in columns if len({*c}) == len(c) and _by_one(c)]
    if any([*c] != sorted(c) for c in counters) and columns[0] not in counters:
        warnings.warn(
            f"{where}: the views are in the order of the first number in their names, in which a "
            f"later one does not run: {', '.join(path.name for path in files[:4])}, ...; where "
            f"that one counts the views, remove the first from the names",
            stacklevel=3,
        )


def check_steps(where: Path, numbers: Sequence[Sequence[Any]]) -> None:
    """Raise if a view is missing between others.

    A number that is unique to every file must have equal steps, or one of several such numbers
    (index and angle); else the files must be a complete table of combinations.
    """
    if got := _missing(numbers):
        raise Refused(
            f"{where}: expected {got}; is a file missing? Where views were left out on purpose: "
            f"gaps=true"
        )


def _missing(numbers: Sequence[Sequence[Any]]) -> str:
    """What a complete series with the numbers of these names would have; empty if it is one."""
    if len({*map(len, numbers)}) > 1:
        return "equally many numbers in every name"
    columns = [sorted(set(column)) for column in zip(*numbers, strict=True)]
    running = [column for column in columns if len(column) > 1]
    serial = [column for column in running if len(column) == len(numbers)]
    jumps = []
    for column in serial or running:  # neighbours further apart than the closest are, by more
        pairs = list(zip(column, column[1:], strict=False))  # than decimals are rounded
        least = min(b - a for a, b in pairs)
        digit = Decimal(1).scaleb(min(int(n.as_tuple().exponent) for n in column))
        rounding = min(2 * digit, least / 2) if digit < 1 else 0
        jumps += [(a, b) for a, b in pairs if b - a > least + rounding][:1]
    if jumps and len(jumps) >= len(serial):
        return f"views numbered in equal steps, got {jumps[0][0]} and then {jumps[0][1]}"
    if not serial and math.prod(map(len, columns)) > len(numbers):
        known = {tuple(row) for row in numbers}
        absent = next(row for row in product(*columns) if row not in known)
        return (
            f"a view of each combination of the numbers, got none of {', '.join(map(str, absent))}"
        )
    return ""


def disordered(labels: Sequence[str]) -> list[str]:
    """How labels of images, which differ in numbers alone, count them in another order than theirs;
    else labels that call an image a field.
    """
    if len({re.sub(SIGNED, "0", label) for label in labels}) != 1:
        return [f"image {label!r}" for label in labels if FIELD_LABEL.search(label)]
    counts = [[*map(float, re.findall(SIGNED, label))] for label in labels]
    wrong = (k for k, (one, other) in enumerate(pairwise(counts)) if other < one)
    return [f"order of images, {labels[k]!r} before {labels[k + 1]!r}" for k in wrong][:1]
