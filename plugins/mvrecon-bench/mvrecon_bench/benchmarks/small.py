"""`bench=small`: SIRT on a small volume, ratio of the time of an iteration to that of its
arithmetic.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mvrecon.methods.classical.sirt import sirt
from mvrecon_bench.benchmarks import report
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.columns import SMALL, SMALL_KEYS
from mvrecon_bench.benchmarks.measure import interleaved, load_average, once, threads
from mvrecon_bench.benchmarks.part import BenchmarkedPart
from mvrecon_bench.benchmarks.rows import Job, Row, number
from mvrecon_bench.benchmarks.scaling import Point
from mvrecon_bench.benchmarks.trial import Trial, reason

#: Factor for the number of views from which the time per additional view is determined.
MORE = 4


class Small:
    """SIRT with each part on a small volume, which shows the overhead of a call best.

    Args:
        parts: the projectors, `{name: ..., **options}`.
        base: n, pixels, views, device (or auto), dtype.
        n_threads: numbers of threads (0: all threads of torch), one row each.
        iterations: iterations of SIRT.
        repeats: minimum number of calls per median time.
    """

    columns: Mapping[str, str] = SMALL
    keys: Sequence[str] = SMALL_KEYS
    charts: Sequence[str] = ("iteration_ms", "over_arithmetic")

    def __init__(
        self,
        parts: Sequence[Mapping[str, Any]],
        base: Mapping[str, Any],
        n_threads: Sequence[int] = (1, 0),
        iterations: int = 50,
        repeats: int = 5,
    ):
        self.parts = [BenchmarkedPart.of(config) for config in parts]
        self.iterations, self.repeats = iterations, repeats
        self.n_threads = sorted({Workload(threads=n).threads for n in n_threads})
        self.base: dict[str, Any] = {**base, "device": Workload(device=base["device"]).device}

    def groups(self) -> list[list[Job[Point]]]:
        """Groups of jobs measured together: all parts with the same number of threads."""
        one: dict[str, Any] = {**self.base, "batch": 1, "channels": 1}
        return [
            [Point(part, "views", **one, threads=n).job(self.columns) for part in self.parts]
            for n in self.n_threads
        ]

    def label(self, row: Row) -> str:
        """Short label of a row's part and threads."""
        return f"{report.part_label(row)}, {row['threads']:.0f} threads"

    def measure(
        self, jobs: Sequence[Job[Point]], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """Yield the rows of jobs with the same number of threads."""
        for job in jobs:
            say(self.label(job.row))
            point, row = job.subject, {**job.row, "load": load_average()}
            try:
                with threads(point.threads):
                    wide = replace(point, views=MORE * point.views)
                    row |= self._times(point.trial(), wide.trial())
            except Exception as error:  # an error of a part becomes the status of its row
                yield {**row, "status": f"skipped: {reason(error)}"}
            else:
                yield {**row, "status": "ok"}

    def _times(self, trial: Trial, wide: Trial) -> Row:
        """Trials of SIRT, and of forward and adjoint with the rig's views and with `MORE` times as
        many.
        """
        for run in (trial, wide):  # no voxel is zero, as in an iterate of SIRT
            run.x = torch.rand(run.x.shape, generator=torch.Generator().manual_seed(0)).to(run.x)
        views = trial.forward()
        calls = {
            0: lambda: sirt(trial.A, views, self.iterations),
            **dict(enumerate((trial.forward, trial.adjoint, wide.forward, wide.adjoint), start=1)),
        }
        first = {
            key: [once(call, trial.device) for _ in range(2)][1][1] for key, call in calls.items()
        }
        timings = interleaved(calls, first, self.repeats, trial.device)
        whole, forward, adjoint, *more = (timings[key].ms for key in calls)
        arithmetic = (sum(more) - forward - adjoint) / (MORE - 1)
        return {
            "backend": trial.backend,
            "iteration_ms": whole / self.iterations,
            "forward_ms": forward,
            "adjoint_ms": adjoint,
            "arithmetic_ms": arithmetic,
            "over_arithmetic": whole / self.iterations / arithmetic,
            "calls": timings[0].calls,
        }

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """The table by name."""
        names = ("threads", *(n for n in SMALL if n.endswith("_ms")), "over_arithmetic")
        done = sorted(
            (row for row in rows if row["status"] == "ok"), key=lambda r: number(r, "iteration_ms")
        )
        lines = [
            (report.part_label(row), *(report.figure(row, name) for name in names)) for row in done
        ]
        text = f"# SIRT on a small volume\n\n{report.markdown(('part', *names), lines)}"
        return {"table": text + report.left_out(rows) + report.legend(self.columns)}
