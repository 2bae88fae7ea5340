"""A benchmark's rows as Markdown."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mvrecon_bench.benchmarks.part import BenchmarkedPart
from mvrecon_bench.benchmarks.rows import Row, number

#: Columns of the tables of `bench=operators`, and their formats.
SHOWN = {
    "error_thin": ".4f",
    "error_pixel": ".4f",
    "forward_ms": ".4g",
    "adjoint_ms": ".4g",
    "volume_grad_ms": ".4g",
    "pose_grad_ms": ".4g",
    "forward_ratio": ".3g",
    "adjoint_ratio": ".3g",
    "peak_mb": ".1f",
    "adjoint_peak_mb": ".1f",
    "adjointness": ".1e",
    "repeatable": "",
    "nans": ".0f",
    "pose_cosine": ".3f",
}
CASE = ("scene", "camera", "n", "ratio", "views", "dtype", "threads", "device")


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]], texts: int = 1) -> str:
    """A table; all columns but the first `texts` are right-aligned."""
    rows = [head, ["---"] * texts + ["---:"] * (len(head) - texts), *lines]
    return "".join(
        f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in row)} |\n" for row in rows
    )


def part_label(row: Mapping[str, Any]) -> str:
    """Short label of a row's part."""
    return BenchmarkedPart(
        row["part"], json.loads(row["options"]) if row.get("options") else {}
    ).label


def case_label(row: Mapping[str, Any]) -> str:
    """Short label of a row's case."""
    n, views, threads = (int(row[name]) for name in ("n", "views", "threads"))
    what = f"{row['scene']}, {row['camera']}, {n}^3, {views} views, pixel {row['ratio']:g} voxels"
    return f"{what}, {row['dtype']}, {row['device']}, {threads} thread{'s' * (threads > 1)}"


def case_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """The columns that identify the case of a row."""
    return tuple(row[name] for name in CASE)


def operators_table(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """All measured rows by case, sorted by forward time; then skipped rows and the legend of
    columns.
    """
    cases: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row["status"] == "ok":
            cases.setdefault(case_of(row), []).append(row)
    text = "# Run time against error\n"
    for members in cases.values():
        thin, pixel = (number(members[0], f"floor_{name}") for name in ("thin", "pixel"))
        ordered = sorted(members, key=lambda row: number(row, "forward_ms"))
        lines = [(part_label(row), *(figure(row, name) for name in SHOWN)) for row in ordered]
        text += (
            f"\n## {case_label(members[0])}\n\nFloors of the errors: thin {thin:.4f}, pixel "
            f"{pixel:.4f}.\n\n"
        )
        text += markdown(("part", *SHOWN), lines)
    return text + left_out(rows) + legend(columns)


def left_out(rows: Sequence[Row]) -> str:
    """Skipped parts: each reason once, with its number of cases."""
    counts: dict[tuple[str, str], int] = {}
    for row in rows:
        if row["status"] != "ok":
            key = part_label(row), row["status"]
            counts[key] = counts.get(key, 0) + 1
    lines = [(part, status, str(count)) for (part, status), count in counts.items()]
    return f"\n## Left out\n\n{markdown(('part', 'status', 'cases'), lines, 2)}" if lines else ""


def legend(columns: Mapping[str, str]) -> str:
    """Legend of all columns."""
    return f"\n## Columns of results.csv\n\n{markdown(('column', 'meaning'), columns.items(), 2)}"


def figure(row: Row, name: str, form: str | None = None) -> str:
    """Format a number for the tables."""
    value = row.get(name, "")
    return (
        format(value, SHOWN.get(name, ".4g") if form is None else form)
        if isinstance(value, float)
        else str(value)
    )


def panel(
    rows: Sequence[Row], base: Mapping[str, Any], truth: str
) -> tuple[dict[str, list[tuple[float, float]]], dict[int, float]]:
    """Results of the base case at all sizes against one truth, "thin" or "pixel".

    By part (forward time, error), small volumes first; and the error floor by volume size.
    """
    fixed = {name: value for name, value in base.items() if name != "n"}
    same = [
        row
        for row in rows
        if row["status"] == "ok" and all(row[name] == value for name, value in fixed.items())
    ]
    curves: dict[str, list[tuple[float, float]]] = {}
    for row in sorted(same, key=lambda row: row["n"]):
        point = number(row, "forward_ms"), number(row, f"error_{truth}")
        if not math.isnan(sum(point)):
            curves.setdefault(part_label(row), []).append(point)
    return curves, {int(row["n"]): number(row, f"floor_{truth}") for row in same}
