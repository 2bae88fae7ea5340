"""`bench=precision`: error and run time of forward and adjoint in each precision of volumes and
views.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor

from mvrecon.core.parts import PROJECTORS
from mvrecon.core.registry import check_choice
from mvrecon.data.scenes.solids import voxelise
from mvrecon.operators.ray_transform import RAY_METHODS
from mvrecon.testing.measures import gap
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.columns import PRECISION
from mvrecon_bench.measure import interleaved, load_average, once, threads, with_memory
from mvrecon_bench.rows import Bench, Job, Row, skipped

#: Name -> dtype of volumes and views.
PRECISIONS = {
    **{"float64": torch.float64, "float32": torch.float32},
    **{"bfloat16 stored": torch.bfloat16, "float16 stored": torch.float16},
}
#: Reference of all time ratios; errors refer to float64.
USUAL, TRUTH = "float32", "float64"
TASKS = [" ".join(task) for task in product(RAY_METHODS, ("forward", "adjoint"))]


class Precision(Bench):
    """Every task in every precision, timed alternately.

    Args:
        tasks: "<method> forward" or "<method> adjoint".
        precisions: names in `PRECISIONS`.
        base: n (voxels along an edge), views, device (or auto), threads (0: all).
        repeats: minimum number of calls per median time.

    Raises:
        ValueError: an unknown task or precision.
    """

    columns = PRECISION
    keys = ("task", "precision", "n", "device", "threads")
    charts = ("ms", "error")
    title = "Error and time against precision"
    shown = dict.fromkeys(("n", "error", "not_finite", "ms", "ratio", "peak_mb"), ".3g")

    def __init__(
        self,
        tasks: Sequence[str],
        precisions: Sequence[str],
        base: Mapping[str, Any],
        repeats: int = 5,
    ):
        for task in tasks:
            check_choice("task", task, TASKS)
        for precision in precisions:
            check_choice("precision", precision, PRECISIONS)
        self.case, self.tasks, self.repeats = Workload(**base), tasks, repeats
        self.precisions = list(dict.fromkeys([TRUTH, USUAL, *precisions]))

    def groups(self) -> list[list[Job]]:
        """Groups of jobs measured together: the precisions of a task."""
        where = {name: getattr(self.case, name) for name in ("n", "device", "threads")}
        return [
            [Job({"task": task, "precision": name, **where}, name) for name in self.precisions]
            for task in self.tasks
        ]

    def label(self, row: Row) -> str:
        return f"{row['task']} {row['precision']}"

    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """The rows of a task; all of its precisions are timed, since only alternate timings are
        comparable.
        """
        say(task := jobs[0].row["task"])
        load = load_average()
        with threads(self.case.threads), torch.no_grad():
            found = self._compared(task)
        for job in jobs:
            yield {**job.row, "load": load, **found[job.subject]}

    def _compared(self, task: str) -> dict[str, Row]:
        (method, direction), case, device = task.split(), self.case, self.case.device
        grid = case.grid()
        A = PROJECTORS.build("drr", grid=grid, cameras=case.cameras(), method=method).to(device)
        x = voxelise(case.phantom(), grid).double()[None, None].to(device)
        act, argument = (A, x) if direction == "forward" else (A.T, A(x))
        truth, rows = act(argument), {}
        calls: dict[str, Callable[[], Tensor]] = {}
        first: dict[str, float] = {}
        for name in self.precisions:
            call = partial(act, argument.to(PRECISIONS[name]))
            try:
                answer, memory = with_memory(call, device)
                first[name] = once(call, device)[1]
            except Exception as error:  # such as an unsupported precision
                rows[name] = skipped(error)
                continue
            bad = float((~answer.isfinite()).sum())
            rows[name] = {"error": gap(answer, truth), "not_finite": bad, "peak_mb": memory}
            rows[name]["status"], calls[name] = "ok", call
        times = interleaved(calls, first, self.repeats, device)
        for name, (ms, count) in times.items():
            ratio = ms / times[USUAL].ms if USUAL in times else None
            rows[name] |= {"ms": ms, "calls": count, "ratio": ratio}
        return rows
