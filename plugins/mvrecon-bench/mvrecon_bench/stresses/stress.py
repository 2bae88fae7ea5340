"""The stress plan as a benchmark, run row by row, with report and TensorBoard logs."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mvrecon.training import run_folder
from mvrecon_bench.benchmarks.report import legend, markdown
from mvrecon_bench.benchmarks.rows import Row
from mvrecon_bench.stresses import plan
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.verdict import COLUMNS, FAIL, LEFT_OUT, PASS, identity, judge
from mvrecon_bench.stresses.watchdog import LIMIT

SHOWN = ("number", "case", "holds", "measured", "tolerance", "verdict", "note")
KEYS = ("number", "part", "case", "device", "dtype")


@dataclass(frozen=True)
class StressJob:
    """A case with its subject."""

    case: Case
    subject: Subject

    @property
    def row(self) -> Row:
        """The columns that identify the job."""
        return identity(self.case, self.subject)


class Stress:
    """The plan for some parts.

    Args:
        parts: "all", or a list of names and of mappings `{kind: ..., name: ..., **options}`.
        cases: numbers in the plan; none: all.
        device: device of the tests.
        dtypes: dtypes of volumes and views.
        limit_s: time limit of a case in seconds.

    Raises:
        LookupError: an unknown part, or an unknown dtype.
    """

    columns: Mapping[str, str] = COLUMNS
    keys: Sequence[str] = KEYS
    charts: Sequence[str] = ("measured",)

    def __init__(
        self,
        parts: str | Sequence[str | Mapping] = "all",
        cases: Sequence[int] = (),
        device: str = "cpu",
        dtypes: Sequence[str] = ("float64", "float32"),
        limit_s: float = LIMIT,
    ):
        self.subjects, self.cases, self.limit_s = (
            plan.subjects(parts, device, dtypes),
            cases,
            limit_s,
        )

    def groups(self) -> list[list[StressJob]]:
        """The jobs, grouped by subject."""
        return [
            [StressJob(*pair) for pair in plan.jobs([subject], self.cases)]
            for subject in self.subjects
        ]

    def label(self, row: Row) -> str:
        """Short label of a row's part and case."""
        return f"{row['number']:.0f} {row['part']} {row['dtype']}"

    def measure(
        self, jobs: Sequence[StressJob], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """Yield a verdict for each job."""
        for job in jobs:
            say(f"{job.subject.label}: {job.case.name}")
            yield judge(job.case, job.subject, self.limit_s)

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """The table, and all rows as JSON."""
        run_folder.write(folder / "verdicts.json", json.dumps(list(rows), indent=1) + "\n")
        return {"table": table(rows)}


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Number of rows per verdict."""
    numbers = Counter(str(row["verdict"]) for row in rows)
    return {verdict: numbers[verdict] for verdict in (PASS, FAIL, LEFT_OUT)}


def table(rows: Sequence[Row]) -> str:
    """All rows as Markdown: failures first, then part by part."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["part"], row["dtype"], row["device"]), []).append(row)
    summary = [(*key, *map(str, counts(members).values())) for key, members in groups.items()]
    text = "# Stress plan\n\n" + markdown(("part", "dtype", "device", *counts(rows)), summary, 3)
    failed = [[row["part"], row["dtype"], *_cells(row)] for row in rows if row["verdict"] == FAIL]
    if failed:
        text += f"\n## Failed\n\n{markdown(('part', 'dtype', *SHOWN), failed, len(SHOWN) + 2)}"
    for key, members in groups.items():
        text += f"\n## {', '.join(key)}\n\n{markdown(SHOWN, map(_cells, members), len(SHOWN))}"
    return text + legend(COLUMNS)


def _cells(row: Row) -> list[str]:
    return [
        format(value, ".3g") if isinstance(value := row.get(name, ""), float) else value
        for name in SHOWN
    ]
