"""The order of the files of a scan, by their numbers."""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

from mvrecon.files.checks import Refused, shown


def ordered(paths: Sequence[Path], gaps: bool = False) -> list[Path]:
    """Files in the order of the numbers in their names, so that view_10 follows view_9.

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
    parts = {path: re.split(r"([0-9]+)", path.stem.lower()) for path in paths}
    keys = {
        path: [int(text) if k % 2 else text for k, text in enumerate(part)]
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
    """Files in the order of the numbers that they hold; none where two have the same.

    Args:
        numbers: of the files of one folder.
        gaps: allow numbers in unequal steps.

    Raises:
        Refused: a number that is missing between others.
    """
    if len({*numbers.values()}) < len(numbers):
        return []
    files = sorted(numbers, key=lambda path: numbers[path])
    if not gaps and len(files) > 1:
        _check_steps(files[0].parent, [[numbers[path]] for path in files])
    return files


def _check_steps(where: Path, numbers: list[list[int]]) -> None:
    """Refuse one running number that does not run in equal steps."""
    running = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1]
    if len(running) != 1:
        return
    line = running[0]
    steps = [b - a for a, b in zip(line, line[1:], strict=False)]
    least = min(steps)
    if max(steps) > least:
        place = next(k for k, step in enumerate(steps) if step > least)
        raise Refused(
            f"{where}: expected views numbered in equal steps, got {line[place]} and then "
            f"{line[place + 1]}; is a file missing? Where views were left out on purpose: gaps=true"
        )
