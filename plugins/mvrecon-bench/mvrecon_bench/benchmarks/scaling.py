"""`bench=scaling`: time against the amount of work, with fitted exponents."""

import math
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from mvrecon.data.scenes.solids import voxelise
from mvrecon.geometry.cameras.rigs import circular
from mvrecon_bench.benchmarks import report, targets
from mvrecon_bench.benchmarks.cases import DTYPES, FIELD, Workload
from mvrecon_bench.benchmarks.columns import SCALING, SCALING_KEYS
from mvrecon_bench.benchmarks.measure import interleaved, load_average, threads
from mvrecon_bench.benchmarks.part import BenchmarkedPart
from mvrecon_bench.benchmarks.rows import Job, Row, number
from mvrecon_bench.benchmarks.trial import Trial, reason

#: Varied quantity -> setting, and the exponent of the setting in the amount of work.
AXES = {
    "voxels": ("n", 3),
    "rays": ("pixels", 2),
    "views": ("views", 1),
    "batch": ("batch", 1),
    "channels": ("channels", 1),
    "threads": ("threads", 1),
}
CALLS = ("forward", "adjoint")


@dataclass(frozen=True)
class Point:
    """A part with an amount of work."""

    part: BenchmarkedPart
    axis: str
    n: int
    pixels: int
    views: int
    batch: int
    channels: int
    threads: int
    device: str
    dtype: str

    def job(self, columns: Container[str]) -> Job["Point"]:
        """The job of measuring it; its row has the amount of work."""
        setting, power = AXES[self.axis]
        size = getattr(self, setting) ** power
        return Job.of(columns, {**vars(self), **self.part.row, "size": size}, self)

    def trial(self) -> Trial:
        """Trial of the part on its operands."""
        case = Workload(n=self.n)
        detector = {"pixels": [self.pixels] * 2, "pixel_mm": 1.536 * FIELD / self.pixels}
        rig = circular(self.views, 1000.0, 1536.0, detector, start_degrees=3.0)
        where = {"device": self.device, "dtype": DTYPES[self.dtype]}
        x = voxelise(case.phantom(), case.grid()).to(**where)
        x = x.expand(self.batch, self.channels, *x.shape).contiguous()
        rng = torch.Generator().manual_seed(0)
        y = torch.randn(self.batch, self.channels, self.views, *rig.shape, generator=rng).to(
            **where
        )
        return Trial(self.part, case.grid(), rig, x, y)


class Scaling:
    """Parts with increasing amounts of work, along one axis at a time; all points of an axis are
    timed alternately.

    Args:
        parts: the projectors, `{name: ..., **options}`.
        base: n, pixels, views, batch, channels, threads (0: all), device (or auto), dtype.
        vary: axis -> values of its setting; see `AXES`.
        repeats: minimum number of calls per median time.

    Raises:
        ValueError: an unknown axis.
    """

    columns: Mapping[str, str] = SCALING
    keys: Sequence[str] = SCALING_KEYS
    charts: Sequence[str] = ("forward_ms", "adjoint_ms")

    def __init__(
        self,
        parts: Sequence[Mapping[str, Any]],
        base: Mapping[str, Any],
        vary: Mapping[str, Sequence[int]],
        repeats: int = 5,
    ):
        if unknown := set(vary) - set(AXES):
            raise ValueError(f"Unknown axis {', '.join(sorted(unknown))}. Known: {', '.join(AXES)}")
        self.parts, self.vary, self.repeats = (
            [BenchmarkedPart.of(config) for config in parts],
            vary,
            repeats,
        )
        settled = Workload(device=base["device"], dtype=base["dtype"], threads=base["threads"])
        self.base: dict[str, Any] = {**base, "device": settled.device, "threads": settled.threads}

    def groups(self) -> list[list[Job[Point]]]:
        """Groups of jobs measured together: one axis."""
        return [
            [
                Point(part, axis, **(self.base | {AXES[axis][0]: value})).job(self.columns)
                for part in self.parts
                for value in values
            ]
            for axis, values in self.vary.items()
        ]

    def label(self, row: Row) -> str:
        """Short label of a row's part and axis."""
        return f"{report.part_label(row)}, {row['axis']}"

    def measure(
        self, jobs: Sequence[Job[Point]], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """Yield the rows of the points on one axis."""
        first = jobs[0].subject
        say(first.axis)
        trials: list[tuple[Point, Trial, Row]] = []
        for job in jobs:
            row = {**job.row, "load": load_average()}
            try:
                trials.append((job.subject, job.subject.trial(), row))
            except Exception as error:  # an error of a part becomes the status of its row
                yield {**row, "status": f"skipped: {reason(error)}"}
        for call in CALLS:
            say(f"{first.axis}: {call}")
            self._time(trials, call, first.device)
        for _, trial, row in trials:
            note = "; ".join(trial.notes)
            status = "ok" if "forward_ms" in row else f"skipped: {note}"
            yield {**row, "backend": trial.backend, "status": status, "note": note}

    def _time(self, trials: Sequence[tuple[Point, Trial, Row]], call: str, device: str) -> None:
        calls, first = {}, {}
        for key, (point, trial, _) in enumerate(trials):
            with threads(point.threads):
                if trial.attempt(call, 0.0, math.inf, math.inf) is not None:
                    calls[key] = threads(point.threads)(getattr(trial, call))
                    first[key] = trial.seconds[call]
        for key, timing in interleaved(calls, first, self.repeats, device).items():
            row = trials[key][2]
            row |= {
                f"{call}_ms": timing.ms,
                "calls": min(row.get("calls", timing.calls), timing.calls),
            }

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """Write `scaling.png` if matplotlib is installed; return the tables by name."""
        if find_spec("matplotlib"):
            from mvrecon_bench.benchmarks import plots  # part of the optional extra `bench`

            panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
            for (label, axis, call), points in series(rows).items():
                panels.setdefault(axis, {})[f"{label} {call}"] = points
            plots.scaling(panels, folder / "scaling.png")
        names = ("device", "dtype", "threads")
        base = {
            name: self.base[name]
            for name in names
            if name != "threads" or "threads" not in self.vary
        }
        return {
            "table": table(rows, self.columns),
            "targets": targets.table(targets.SCALING, rows, base),
        }


def series(rows: Sequence[Row]) -> dict[tuple[str, str, str], list[tuple[float, float]]]:
    """(part, axis, call) -> (amount of work, ms), by increasing amount."""
    curves: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for row in sorted(rows, key=lambda row: row["size"]):
        for call in CALLS:
            if (ms := number(row, f"{call}_ms")) == ms:
                curves.setdefault((report.part_label(row), row["axis"], call), []).append(
                    (row["size"], ms)
                )
    return curves


def exponent(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Fit time = c * work^p by least squares in the logarithms; return p and its standard error.

    NaN for too few points: p requires two different amounts of work, its error three.
    """
    x, y = (torch.tensor(values, dtype=torch.float64).log() for values in zip(*points, strict=True))
    x, y = x - x.mean(), y - y.mean()
    spread = x.square().sum()
    if not spread > 0:
        return math.nan, math.nan
    p = (x * y).sum() / spread
    left = (y - p * x).square().sum() / max(len(points) - 2, 1)
    return p.item(), (left / spread).sqrt().item() if len(points) > 2 else math.nan


def table(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """Exponents, all times, skipped rows, and the legend of columns."""
    fits = []
    for (label, axis, call), points in series(rows).items():
        p, error = exponent(points)
        span = f"{points[0][0]:g} to {points[-1][0]:g}"
        fits.append((label, axis, call, span, f"{p:.2f}", f"{error:.2f}" if error == error else ""))
    head = ("part", "axis", "call", "work", "exponent", "standard error")
    names = (
        "axis",
        "size",
        "n",
        "pixels",
        "views",
        "batch",
        "channels",
        "threads",
        "forward_ms",
        "adjoint_ms",
    )
    good = [row for row in rows if row["status"] == "ok"]
    done = [
        (report.part_label(row), *(report.figure(row, name, ".6g") for name in names))
        for row in good
    ]
    text = f"# Time against work\n\nTime = c * work^exponent.\n\n{report.markdown(head, fits, 4)}"
    text += f"\n## Times\n\n{report.markdown(('part', *names), done, 2)}"
    return text + report.left_out(rows) + report.legend(columns)
