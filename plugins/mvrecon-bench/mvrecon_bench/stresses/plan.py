"""The stress plan: every case with every applicable part, run row by row as a benchmark."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from mvrecon.core.parts import REGISTRIES, required
from mvrecon.core.registry import hint
from mvrecon.operators.ray_transform import RAY_METHODS
from mvrecon.report.comparison import Cells, markdown
from mvrecon_bench.benchmarks.cases import DTYPES
from mvrecon_bench.rows import Bench, Job, Row, figure
from mvrecon_bench.stresses.case import KINDS, Case
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.subjects import subject_of
from mvrecon_bench.stresses.verdict import COLUMNS, FAIL, LEFT_OUT, LIMIT, PASS, identity, judge

#: Modules of cases.
FILES = (
    *("rays", "scales", "algebra", "derivatives", "cameras", "scenes", "heads", "methods"),
    *("counts", "tensors", "values", "sizes", "repeatability"),
)
SHOWN = dict.fromkeys(("case", "holds", "measured", "tolerance", "verdict", "note"), ".3g")


def cases() -> list[Case]:
    """All cases, sorted by number."""
    modules = (import_module(f"mvrecon_bench.stresses.cases.{file}") for file in FILES)
    found = (getattr(one, "case", None) for module in modules for one in vars(module).values())
    return sorted((one for one in found if isinstance(one, Case)), key=lambda case: case.number)


def subjects(parts: str | Sequence[Any], device: str, dtypes: Sequence[str]) -> list[Subject]:
    """Build the subjects of a plan.

    Args:
        parts: "all", or names and mappings `{kind: ..., name: ..., **options}`; a bare name is
            looked up in all kinds.
        device: device of the tests.
        dtypes: names in `DTYPES`.

    Raises:
        LookupError: an unknown part, kind or dtype.
    """
    for dtype in dtypes:
        if dtype not in DTYPES:
            raise LookupError(f"No dtype is named {dtype!r}{hint(dtype, DTYPES)}")
    listed = [parts] if isinstance(parts, str) else parts
    named = every_part() if parts == "all" else map(_part, listed)
    return [subject_of(*part, device, DTYPES[dtype]) for part in named for dtype in dtypes]


def every_part() -> list[tuple[str, str, dict[str, Any]]]:
    """Kind, name and options of all registered parts, including plugins, and of mvrecon itself.

    mvrecon's own projectors are included with each of their methods.
    """
    parts: list[tuple[str, str, dict[str, Any]]] = []
    for kind in KINDS[:-1]:
        for name in REGISTRIES[kind].names():
            projector = kind == "projector"
            if projector and required(kind, name):
                continue  # such as a projector defined by a file, which is tested with that file
            ours = projector and REGISTRIES[kind].origin(name).startswith("mvrecon.")
            choices = [{"method": method} for method in RAY_METHODS] if ours else [{}]
            parts += [(kind, name, options) for options in choices]
    return [*parts, ("mvrecon", "", {})]


def jobs(subjects: Iterable[Subject], chosen: Sequence[int] = ()) -> Iterator[tuple[Case, Subject]]:
    """All pairs of case and applicable subject, optionally restricted to some case numbers."""
    every = [case for case in cases() if not chosen or case.number in chosen]
    for subject in subjects:
        for case in every:
            if case.kind == subject.kind and subject.dtype in case.dtypes:
                yield case, subject


def _part(config: str | Mapping[str, Any]) -> tuple[str, str, dict[str, Any]]:
    """Kind, name and options of one part."""
    config = {"name": config} if isinstance(config, str) else config
    options = {key: value for key, value in config.items() if key not in ("kind", "name")}
    name = config.get("name", "")
    if config.get("kind", name) == "mvrecon":
        return "mvrecon", "", {}
    having = [kind for kind in KINDS[:-1] if name in REGISTRIES[kind].names()]
    kinds = [config["kind"]] if "kind" in config else having
    if not kinds or kinds[0] not in KINDS:
        known = [part for kind in KINDS[:-1] for part in REGISTRIES[kind].names()]
        raise LookupError(f"No part to stress is {dict(config)}{hint(name, known)}")
    REGISTRIES[kinds[0]].origin(name)
    return kinds[0], name, options


class Stress(Bench):
    """The plan for some parts.

    Args:
        parts, device, dtypes: see `subjects`.
        cases: numbers in the plan; none: all.
        limit_s: time limit of a case in seconds.

    Raises:
        LookupError: an unknown part, or an unknown dtype.
    """

    columns = COLUMNS
    keys = ("number", "part", "case", "device", "dtype")
    charts = ("measured",)
    title, sections, shown = "Stress plan", ("part", "dtype", "device"), SHOWN

    def __init__(
        self,
        parts: str | Sequence[str | Mapping] = "all",
        cases: Sequence[int] = (),
        device: str = "cpu",
        dtypes: Sequence[str] = ("float64", "float32"),
        limit_s: float = LIMIT,
    ):
        self.subjects, self.cases = subjects(parts, device, dtypes), cases
        self.limit_s = limit_s

    def groups(self) -> list[list[Job]]:
        """The jobs, grouped by subject."""
        return [
            [Job(identity(*pair), pair) for pair in jobs([subject], self.cases)]
            for subject in self.subjects
        ]

    def label(self, row: Row) -> str:
        return f"{row['number']:.0f} {row['part']} {row['dtype']}"

    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """Yield a verdict for each job."""
        for job in jobs:
            case, subject = job.subject
            say(f"{subject.label}: {case.name}")
            yield judge(case, subject, self.limit_s)

    def summary(self, rows: Sequence[Row], folder: Path) -> str:
        """The verdicts on each part, and the failures."""
        groups: dict[tuple[str, ...], list[Row]] = {}
        for row in rows:
            groups.setdefault(tuple(row[name] for name in self.sections), []).append(row)
        lines = [(*key, *map(str, counts(members).values())) for key, members in groups.items()]
        text = f"\n{markdown(Cells((*self.sections, *counts(rows)), lines), 3)}"
        failed = [row for row in rows if row["verdict"] == FAIL]
        cells = [[self.label(row), *(figure(row, *one) for one in SHOWN.items())] for row in failed]
        return text + (
            f"\n## Failed\n\n{markdown(Cells(('', *SHOWN), cells), 7)}" if failed else ""
        )


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Number of rows per verdict."""
    numbers = Counter(str(row["verdict"]) for row in rows)
    return {verdict: numbers[verdict] for verdict in (PASS, FAIL, LEFT_OUT)}
