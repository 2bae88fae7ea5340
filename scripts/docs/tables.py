"""Writes the tables of the pages from their CSV files: `python scripts/docs/tables.py`.

With `--check` it writes nothing, prints the pages that differ and exits with 1.

A page has the query behind a table in a comment, and the table below it:

    <!-- table
    select method, printf('%.1f', avg(psnr)) as [PSNR dB]
    from [experiments/21_faults/results.csv] where views = 8 group by method order by avg(psnr)
    -->

    | method | PSNR dB |
    ...

    <!-- end table -->

A long query may be a file, whose path in the repository is in the comment instead:
`<!-- table experiments/21_faults/methods.sql -->`.

Numbers in sentences have a query as well, `<!-- says` in place of `<!-- table`. It returns the
words with the numbers, such as `from 26.4 to 29.0 dB`; a page without them is an error.

Queries are SQLite's. A file is named by its path in the repository. Such a path, and the name of a
column that is not a plain word, stand in brackets. Numbers are float64; an empty cell and `nan` are
null, of which `printf` (Python's `%`) makes an empty cell. `stdev` is the sample standard deviation
of a group.
"""

import argparse
import csv
import math
import re
import sqlite3
import statistics
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("*.md", "docs/**/*.md", "experiments/**/*.md", "plugins/**/*.md")
OPENING = re.compile(r"^ *<!-- (?:table|says)\b", re.M)
QUERY = r"(?: (?P<file>[^\s>]+\.sql) |\n(?P<query>(?:(?!-->).)*)\n)-->"
TABLE = re.compile(
    rf"^(?P<opening><!-- table{QUERY})\n"
    r"(?:\|[^\n]*\n|\n)*<!-- end table -->$",
    re.M | re.S,
)
SAYS = re.compile(rf"^<!-- says{QUERY}$", re.M | re.S)
COMMENT = re.compile(r"<!--.*?-->", re.S)
FILE = re.compile(r"\[([^\[\]]+\.csv)\]")
#: A cell that is set to the right.
NUMBER = re.compile(r"[-+]?\d.*")


class Mean:
    """The mean of a group, rounded once: that of SQLite depends on its version."""

    of, fewest = statistics.fmean, 1

    def __init__(self) -> None:
        self.values: list[float] = []

    def step(self, value: float | None) -> None:
        if value is not None:
            self.values.append(value)

    def finalize(self) -> float | None:
        return type(self).of(self.values) if len(self.values) >= self.fewest else None


class Deviation(Mean):
    """The sample standard deviation of a group."""

    of, fewest = statistics.stdev, 2


def value_of(cell: str) -> float | str | None:
    """A cell of a CSV file as a number, a text, or null."""
    try:
        number = float(cell)
    except ValueError:
        return cell or None
    return None if math.isnan(number) else number


def printf(form: str, *values: float | str | None) -> str | None:
    """In place of SQLite's, which makes 0 of null and of a text."""
    return None if None in values else form % values


def load(database: sqlite3.Connection, name: str, file: Path) -> None:
    """Copy a CSV file into a table of the database."""
    with file.open(newline="", encoding="utf-8") as lines:
        head, *rows = csv.reader(lines)
    database.execute(f"create table [{name}] ({', '.join(f'[{column}]' for column in head)})")
    marks = ", ".join("?" * len(head))
    cells = ([value_of(cell) for cell in row] for row in rows)
    database.executemany(f"insert into [{name}] values ({marks})", cells)


def answer(query: str, root: Path) -> tuple[list[str], list[tuple[Any, ...]]]:
    """The names of the columns and the rows that a query returns.

    Raises:
        ValueError: a file or a column is not there, the query is not SQLite's, or it finds no row.
    """
    if '"' in query:  # an unknown column in these is a text for SQLite
        raise ValueError('write the name of a column in brackets, not in "')
    database = sqlite3.connect(":memory:")
    database.create_function("printf", -1, printf)
    database.create_aggregate("avg", 1, Mean)  # pyrefly: ignore[bad-argument-type]
    database.create_aggregate("stdev", 1, Deviation)  # pyrefly: ignore[bad-argument-type]
    try:
        for name in dict.fromkeys(FILE.findall(query)):
            load(database, name, root / name)
        found = database.execute(query)
        head, rows = [column[0] for column in found.description], found.fetchall()
    except (sqlite3.Error, OSError) as error:
        raise ValueError(f"{error} in the query\n{query}") from None
    finally:
        database.close()
    if not rows:
        raise ValueError(f"no row is found by the query\n{query}")
    return head, rows


def markdown(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table; columns of numbers are set to the right."""

    def text(cell: Any) -> str:
        shown = f"{cell:.12g}" if isinstance(cell, float) else "" if cell is None else str(cell)
        return shown.replace("|", r"\|")

    body = [[text(cell) for cell in row] for row in rows]
    columns = list(zip(*body, strict=True))
    right = [all(NUMBER.match(cell) for cell in cells if cell) for cells in columns]
    lines = [head, ["---:" if one else "---" for one in right], *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def written(page: str, root: Path = ROOT) -> str:
    """A page with all its tables made anew.

    Raises:
        ValueError: a table without its end, a query that fails, or words that one returns and the
            page does not have.
        OSError: a query's file cannot be read.
    """

    def found(place: re.Match[str]) -> tuple[list[str], list[tuple[Any, ...]]]:
        file, query = place["file"], place["query"]
        return answer(query if file is None else (root / file).read_text(encoding="utf-8"), root)

    tables, sentences = [*TABLE.finditer(page)], [*SAYS.finditer(page)]
    if len(OPENING.findall(page)) != len(tables) + len(sentences):
        raise ValueError("a table is not followed by <!-- end table -->, or has other lines in it")
    prose = " ".join(COMMENT.sub("", page).split())
    for words in (cell for place in sentences for row in found(place)[1] for cell in row):
        if words is None or str(words) not in prose:
            raise ValueError(f"no sentence has the words {words!r}, which a query returns")
    return TABLE.sub(lambda t: f"{t['opening']}\n\n{markdown(*found(t))}\n<!-- end table -->", page)


def differing(root: Path = ROOT) -> dict[Path, str]:
    """The pages that differ from what their CSV files say, with the text that they should have."""
    pages = sorted({page for pattern in PAGES for page in root.glob(pattern)})
    found = {}
    for page in pages:
        old = page.read_text(encoding="utf-8")
        try:
            new = written(old, root)
        except (ValueError, OSError) as error:
            raise ValueError(f"{page.relative_to(root)}: {error}") from None
        if new != old:
            found[page] = new
    return found


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Write the tables of the pages from CSV files.")
    parser.add_argument("--check", action="store_true", help="write nothing; 1 on a difference")
    check = parser.parse_args().check
    try:
        pages = differing()
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    for page, text in pages.items():
        print(f"{page.relative_to(ROOT)} {'differs from its CSV' if check else 'is written'}")
        if not check:
            page.write_text(text, encoding="utf-8")
    return int(check and bool(pages))


if __name__ == "__main__":
    sys.exit(main())
