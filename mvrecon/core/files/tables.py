"""Tables of figures as CSV files."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mvrecon.core.files.atomic import written_whole


def write_rows(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file, whole or not at all; the names of the first row are its header.

    Raises:
        ValueError: a row with a name that the first does not have.
    """
    with written_whole(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def renewed(
    path: str | Path, rows: Sequence[Mapping[str, Any]], keys: Sequence[str]
) -> list[Mapping[str, Any]]:
    """The rows of a CSV file with those of the same keys replaced by new ones, and the others of
    these behind them.
    """
    stored = {tuple(str(row[key]) for key in keys): row for row in (*read_rows(path), *rows)}
    return list(stored.values())


def read_rows(path: str | Path) -> list[dict[str, Any]]:
    """Read the rows of a CSV file with texts as values; none of a file that is not there."""
    if not Path(path).exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
