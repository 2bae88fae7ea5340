"""The order of the files of a scan, by their numbers."""

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from decimal import Decimal
from itertools import product
from pathlib import Path

from mvrecon.files.checks import Refused, shown

#: A number in a name: a decimal such as 0.25, but no part of 1.2.3; and an integer.
DECIMAL, INTEGER = r"(?<![0-9.])[0-9]+\.[0-9]+(?![0-9.])", "[0-9]+"


def ordered(paths: Sequence[Path], gaps: bool = False) -> list[Path]:
    """Files in the order of the numbers in their names, so that view_10 follows view_9, and 0.5
    follows 0.25.

    Args:
        paths: of the files of one folder.
        gaps: allow numbers in unequal steps, where views were left out on purpose.

    Warns:
        UserWarning: names that differ in more than their numbers, which are then sorted as text.

    Raises:
        Refused: two names with the same numbers, or a number that is missing between others.
    """
    if len(paths) < 2:
        return list(paths)
    number = _number([path.stem for path in paths])
    parts = {path: re.split(f"({number})", path.stem.lower()) for path in paths}
    keys = {
        path: [Decimal(text) if k % 2 else text for k, text in enumerate(part)]
        for path, part in parts.items()
    }
    files = sorted(paths, key=lambda path: (keys[path], path.name))
    where = files[0].parent
    words = {tuple(part[::2]) for part in parts.values()}
    if len(words) > 1:
        names = ", ".join(path.name for path in files[:4])
        warnings.warn(
            f"{where}: names of the views differ in more than their numbers; they are in the order "
            f"of their text: {names}, ...",
            stacklevel=2,
        )
        return files
    for first, second in zip(files, files[1:], strict=False):
        if keys[first] == keys[second]:
            raise Refused(
                f"{where}: expected one file of every number, got {shown(first.name)} and "
                f"{shown(second.name)}"
            )
    if not gaps:
        _check_steps(where, [keys[path][1::2] for path in files])  # type: ignore[misc]
    return files


def by_number(numbers: Mapping[Path, int], gaps: bool = False) -> list[Path]:
    """Files in the order of the numbers that they hold, each its own.

    Args:
        numbers: of the files of one folder.
        gaps: allow numbers in unequal steps.

    Raises:
        Refused: a number that is missing between others.
    """
    files = sorted(numbers, key=lambda path: numbers[path])
    if not gaps:
        _check_steps(files[0].parent, [[Decimal(numbers[path])] for path in files])
    return files


def _number(names: Sequence[str]) -> str:
    """Pattern of a number in these names: integers alone where "1.9" goes on as "1.10", which as a
    decimal would come before it.
    """
    places = [text.partition(".")[2] for name in names for text in re.findall(DECIMAL, name)]
    counted = any(len(part) > 1 and part.endswith("0") for part in places)
    return INTEGER if counted and len({*map(len, places)}) > 1 else f"{DECIMAL}|{INTEGER}"


def _check_steps(where: Path, numbers: Sequence[Sequence[Decimal]]) -> None:
    """Refuse a view that is missing between others.

    A number that every file has for itself alone runs in equal steps, one of them if there are
    several (index and angle); else the files are a table, with one of each combination.
    """
    columns = [sorted(set(column)) for column in zip(*numbers, strict=True)]
    running = [column for column in columns if len(column) > 1]
    serial = [column for column in running if len(column) == len(numbers)]
    jumps = [jump for column in serial or running if (jump := _jump(column))]
    if jumps and len(jumps) >= len(serial):
        raise Refused(
            f"{where}: expected views numbered in equal steps, got {jumps[0][0]} and then "
            f"{jumps[0][1]}; is a file missing? Where views were left out on purpose: gaps=true"
        )
    if not serial and math.prod(map(len, columns)) > len(numbers):
        known = {tuple(row) for row in numbers}
        absent = next(row for row in product(*columns) if row not in known)
        raise Refused(
            f"{where}: expected a view of each combination of the numbers, got none of "
            f"{', '.join(map(str, absent))}; is a file missing? Where views were left out on "
            f"purpose: gaps=true"
        )


def _jump(line: Sequence[Decimal]) -> tuple[Decimal, Decimal] | None:
    """Two neighbours further apart than the closest are, by more than decimals are rounded."""
    pairs = list(zip(line, line[1:], strict=False))
    least = min(b - a for a, b in pairs)
    digit = Decimal(1).scaleb(min(int(number.as_tuple().exponent) for number in line))
    rounding = min(2 * digit, least / 2) if digit < 1 else 0
    return next(((a, b) for a, b in pairs if b - a > least + rounding), None)
