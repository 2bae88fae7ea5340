"""A table on disk, written row by row, so that an interrupted benchmark can be resumed, and the
jobs that measure its rows.
"""

import csv
import io
import math
import os
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from mvrecon.training.run_folder import write

Row = dict[str, Any]
Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Job(Generic[Subject]):
    """A row to measure.

    Args:
        row: the columns that identify it.
        subject: what is measured.
    """

    row: Row
    subject: Subject

    @classmethod
    def of(cls, columns: Container[str], described: Mapping[str, Any], subject: Subject) -> Self:
        """The job whose row are the described values for which the table has a column."""
        return cls({name: v for name, v in described.items() if name in columns}, subject)


class Rows:
    """A CSV file with a fixed header.

    Args:
        path: path of the file, created if missing.
        columns: the header.
        keys: the columns that identify a row.

    Raises:
        ValueError: the file has another header.
    """

    def __init__(self, path: Path, columns: Sequence[str], keys: Sequence[str]):
        self.path, self.columns, self.keys = path, list(columns), list(keys)
        if not path.exists():
            write(path, _line(self.columns))
        check_header(path, self.columns)
        text = path.read_text(encoding="utf-8")
        if not text.endswith("\n"):  # truncated by a crash
            text = text[: text.rfind("\n") + 1]
            write(path, text)
        header, *lines = list(csv.reader(io.StringIO(text)))
        self._done = {self._key(dict(zip(header, line, strict=True))) for line in lines}
        self.rows: list[Row] = [
            {name: value(text) for name, text in zip(header, line, strict=True) if text}
            for line in lines
        ]

    def _key(self, row: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(cell(row.get(name)) for name in self.keys)

    def __contains__(self, row: Mapping[str, Any]) -> bool:
        """Whether the table contains a row with these keys."""
        return self._key(row) in self._done

    def append(self, row: Mapping[str, Any]) -> Row:
        """Append a row, flush it to disk, and return it as it is read back.

        Raises:
            KeyError: the table has no column for a figure.
        """
        if unknown := set(row) - set(self.columns):
            raise KeyError(f"{self.path.name} has no column {', '.join(sorted(unknown))}")
        cells = [cell(row.get(name)) for name in self.columns]
        with open(self.path, "a", encoding="utf-8", newline="") as file:
            file.write(_line(cells))
            file.flush()
            os.fsync(file.fileno())
        self._done.add(self._key(row))
        self.rows.append(
            {name: value(text) for name, text in zip(self.columns, cells, strict=True) if text}
        )
        return self.rows[-1]


def check_header(path: Path, columns: Sequence[str]) -> None:
    """Raise ValueError for a table with other columns."""
    with path.open(encoding="utf-8", newline="") as file:
        header = next(csv.reader(file), [])
    if header != list(columns):
        raise ValueError(
            f"{path} has the columns {header}, expected {list(columns)}; give another folder"
        )


def cell(figure: Any) -> str:
    """Format a figure: six digits, yes or no, an empty string for None."""
    if figure is None:
        return ""
    if isinstance(figure, bool):
        return "yes" if figure else "no"
    return f"{figure:.6g}" if isinstance(figure, float) else " ".join(str(figure).split())


def value(text: str) -> Any:
    """Parse a text as number, or return the text."""
    try:
        return float(text)
    except ValueError:
        return text


def number(row: Mapping[str, Any], name: str) -> float:
    """A figure of a row; NaN if missing."""
    figure = row.get(name)
    return figure if isinstance(figure, float) else math.nan


def _line(cells: Sequence[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()
