"""Rows of benchmarks and of the stress plan: what measures them, a table on disk that grows row by
row, and Markdown.
"""

import csv
import io
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from mvrecon.core.files.atomic import write_text

Row = dict[str, Any]


class Job(NamedTuple):
    """A row to measure.

    Args:
        row: the columns that identify it.
        subject: what is measured.
    """

    row: Row
    subject: Any


class Bench(ABC):
    """One kind of benchmark.

    `columns`: name -> meaning and unit. `keys`: columns that identify a row. `charts`: columns
    plotted in TensorBoard. `title`, `shown` (column -> format) and `sections` (columns whose values
    have a table each): of `table.md`.
    """

    columns: ClassVar[Mapping[str, str]]
    keys: ClassVar[Sequence[str]]
    charts: ClassVar[Sequence[str]]
    title: ClassVar[str]
    shown: ClassVar[Mapping[str, str]]
    sections: ClassVar[Sequence[str]] = ()

    @abstractmethod
    def groups(self) -> Sequence[Sequence[Job]]:
        """The jobs, in groups that are measured together."""

    @abstractmethod
    def label(self, row: Row) -> str:
        """Short label of a row's part."""

    @abstractmethod
    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """Yield a row for each job of a group; `say` reports progress."""

    def summary(self, rows: Sequence[Row], folder: Path) -> str:
        """Write the plots (PNG) to the folder and return what precedes the tables, in Markdown."""
        return ""

    def job(self, described: Mapping[str, Any], subject: Any) -> Job:
        """The job whose row are the described values for which the table has a column."""
        return Job({name: v for name, v in described.items() if name in self.columns}, subject)


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
            write_text(path, _line(self.columns))
        check_header(path, self.columns)
        text = path.read_text(encoding="utf-8")
        if not text.endswith("\n"):  # truncated by a crash
            text = text[: text.rfind("\n") + 1]
            write_text(path, text)
        lines = list(csv.DictReader(io.StringIO(text)))
        self._done = {self._key(line) for line in lines}
        self.rows: list[Row] = [_parsed(line) for line in lines]

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
        cells = {name: cell(row.get(name)) for name in self.columns}
        with open(self.path, "a", encoding="utf-8", newline="") as file:
            file.write(_line(cells.values()))
            file.flush()
            os.fsync(file.fileno())
        self._done.add(self._key(row))
        self.rows.append(_parsed(cells))
        return self.rows[-1]


def check_header(path: Path, columns: Iterable[str]) -> None:
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


def figure(row: Row, name: str, form: str = ".4g") -> str:
    """A cell of a table, with numbers in a format."""
    one = row.get(name, "")
    return format(one, form) if isinstance(one, float) else str(one)


def reason(error: BaseException) -> str:
    """Format an exception in one short line."""
    text = next((line for line in str(error).splitlines() if line.strip()), "no message")
    return f"{type(error).__name__}: {text.strip()}"[:240]


def skipped(error: BaseException) -> Row:
    """The status of a row whose part raised an error."""
    return {"status": f"skipped: {reason(error)}"}


def measured(rows: Iterable[Row]) -> list[Row]:
    """The rows without an error."""
    return [row for row in rows if row["status"] == "ok"]


def _parsed(line: Mapping[str, str]) -> Row:
    return {name: value(text) for name, text in line.items() if text}


def _line(cells: Iterable[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()
