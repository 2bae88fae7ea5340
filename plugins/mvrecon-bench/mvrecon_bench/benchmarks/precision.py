"""`bench=precision`: error and run time of each precision for operators, a U-Net and the entire
model.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mvrecon_bench.benchmarks import report
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.columns import PRECISION, PRECISION_KEYS
from mvrecon_bench.benchmarks.measure import interleaved, load_average, once, threads, with_memory
from mvrecon_bench.benchmarks.precision_tasks import (
    PRECISIONS,
    Task,
    method_task,
    net_task,
    operator_tasks,
)
from mvrecon_bench.benchmarks.rows import Job, Row
from mvrecon_bench.benchmarks.trial import reason

NETS = ("unet", "cross_view")
#: Reference of all time ratios; errors refer to float64.
USUAL, TRUTH = "float32", "float64"


class Precision:
    """Every task in every precision, timed alternately.

    Args:
        tasks: "<method> forward", "<method> adjoint", "unet", "cross_view".
        precisions: names in `precision_tasks.PRECISIONS`.
        base: n (voxels along an edge, of operators), views, device (or auto), threads (0: all).
        unet: n, and options of the U-Net.
        cross_view: n, rig, and the method's name and options; or its trained `checkpoint`.
        repeats: minimum number of calls per median time.

    Raises:
        ValueError: an unknown task or precision.
    """

    columns: Mapping[str, str] = PRECISION
    keys: Sequence[str] = PRECISION_KEYS
    charts: Sequence[str] = ("ms", "error")

    def __init__(
        self,
        tasks: Sequence[str],
        precisions: Sequence[str],
        base: Mapping[str, Any],
        unet: Mapping[str, Any],
        cross_view: Mapping[str, Any],
        repeats: int = 5,
    ):
        case = Workload(
            n=base["n"], views=base["views"], device=base["device"], threads=base["threads"]
        )
        self.device, self.threads, self.repeats = case.device, case.threads, repeats
        self.made: dict[str, tuple[int, Callable[[], Task]]] = {
            name: (case.n, make) for name, make in operator_tasks(case).items()
        }
        for name, make, options in zip(
            NETS, (net_task, method_task), (unet, cross_view), strict=True
        ):
            self.made[name] = options["n"], partial(make, options, self.device)
        for what, names, known in (
            ("task", tasks, self.made),
            ("precision", precisions, PRECISIONS),
        ):
            if unknown := set(names) - set(known):
                raise ValueError(
                    f"Unknown {what} {', '.join(sorted(unknown))}. Known: {', '.join(known)}"
                )
        self.tasks, self.precisions = tasks, list(dict.fromkeys([TRUTH, USUAL, *precisions]))

    def groups(self) -> list[list[Job[str]]]:
        """Groups of jobs measured together: the precisions of a task; autocast does not affect
        operators.
        """
        where = {"device": self.device, "threads": self.threads}
        return [
            [
                Job({"task": task, "precision": precision, "n": self.made[task][0], **where}, task)
                for precision in self._of(task)
            ]
            for task in self.tasks
        ]

    def _of(self, task: str) -> list[str]:
        return [
            precision
            for precision in self.precisions
            if task in NETS or PRECISIONS[precision][1] is None
        ]

    def label(self, row: Row) -> str:
        """Short label of a row's task and precision."""
        return f"{row['task']} {row['precision']}"

    def measure(
        self, jobs: Sequence[Job[str]], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """The rows of a task; all of its precisions are timed, since only alternate timings are
        comparable.
        """
        task = jobs[0].subject
        say(task)
        common: Row = {"load": load_average()}
        with threads(self.threads), torch.no_grad():
            rows_of = self._compared(self.made[task][1](), self._of(task))
        for job in jobs:
            yield {**job.row, **common, **rows_of[job.row["precision"]]}

    def _compared(self, task: Task, precisions: Sequence[str]) -> dict[str, Row]:
        rows: dict[str, Row] = {}
        calls: dict[int, Callable[[], Tensor]] = {}
        first: dict[int, float] = {}
        truth = task.call(TRUTH)().double()
        for key, precision in enumerate(precisions):
            try:
                call = task.call(precision)
                answer, peak = with_memory(call, self.device)
                first[key], calls[key] = once(call, self.device)[1], call
                rows[precision] = {
                    "status": "ok",
                    "peak_mb": peak,
                    **_errors(answer.double(), truth),
                }
                if task.score is not None:
                    rows[precision]["psnr"] = task.score(answer)
            except Exception as error:  # such as an unsupported precision
                rows[precision] = {"status": f"skipped: {reason(error)}"}
        for key, timing in interleaved(calls, first, self.repeats, self.device).items():
            rows[precisions[key]] |= {"ms": timing.ms, "calls": timing.calls}
        usual = rows[USUAL].get("ms", float("nan"))
        for row in rows.values():
            if "ms" in row:
                row["ratio"] = row["ms"] / usual
        return rows

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """The table."""
        return {"table": table(rows, self.columns)}


def _errors(result: Tensor, truth: Tensor) -> dict[str, float]:
    gap = result - truth
    return {
        "error": (gap.norm() / truth.norm()).item(),
        "worst": (gap.abs().max() / truth.abs().max()).item(),
        "not_finite": float((~result.isfinite()).sum()),
    }


def table(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """Table of every task with its precisions side by side."""
    names = (
        "task",
        "precision",
        "n",
        "error",
        "worst",
        "not_finite",
        "ms",
        "ratio",
        "peak_mb",
        "psnr",
        "status",
    )
    lines = [[report.figure(row, name, ".3g") for name in names] for row in rows]
    return (
        "# Error and time against "
        f"precision\n\n{report.markdown(names, lines, 2)}{report.legend(columns)}"
    )
