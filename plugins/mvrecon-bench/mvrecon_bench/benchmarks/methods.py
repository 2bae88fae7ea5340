"""`bench=methods`: run time, memory and error of the reconstruction methods."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.data.scenes.solids import voxelise
from mvrecon.methods.method import build_method
from mvrecon.operators.ray_transform import RayTransform
from mvrecon_bench.benchmarks import report
from mvrecon_bench.benchmarks.cases import Workload, expand
from mvrecon_bench.benchmarks.columns import METHODS, METHODS_KEYS
from mvrecon_bench.benchmarks.measure import interleaved, load_average, once, threads, with_memory
from mvrecon_bench.benchmarks.part import BenchmarkedPart
from mvrecon_bench.benchmarks.rows import Job, Row, number
from mvrecon_bench.benchmarks.shortened import shortened
from mvrecon_bench.benchmarks.trial import reason
from mvrecon_bench.benchmarks.truth import pixel_mean

#: Voxels and views of the warm-up call, in which a part imports and compiles.
TINY = 16
#: A method on a case.
Placed = tuple[BenchmarkedPart, Workload]


@dataclass(frozen=True, eq=False)
class MethodInputs:
    """The inputs of the methods, and the truth."""

    A: RayTransform
    views: Float[Tensor, "1 1 m v u"]
    volume: Float[Tensor, "d h w"]
    inside: Bool[Tensor, "d h w"]

    def error(self, volume: Float[Tensor, "1 1 d h w"]) -> float:
        """|x - truth| / |truth| over the voxels of the object."""
        truth = self.volume[self.inside]
        return ((volume[0, 0][self.inside] - truth).norm() / truth.norm()).item()


@lru_cache(maxsize=2)
def measurement_of(case: Workload, rays: int) -> MethodInputs:
    """Views as means of rays x rays exact integrals per pixel, and the truth of a case."""
    grid, rig, phantom = case.grid(), case.cameras(), case.phantom()
    views = pixel_mean(phantom, rig, rays)[None, None].float()
    volume = voxelise(phantom, grid).float()
    inside = volume > 0
    return MethodInputs(RayTransform(grid, rig), views, volume, inside)


class Methods:
    """Every method on every case of a plan; the methods on a case are timed alternately.

    Args:
        parts: the methods `{name: ..., peer: ..., **options}`, see `BenchmarkedPart.of`; `peer` is
            the name of the reference part for time ratios.
        base: first case of the plan, options of `Workload`.
        plan: blocks `{about: {...}, vary: {axis: [values]}}`, see `cases.expand`.
        rays: a pixel is the mean of rays x rays exact integrals.
        repeats: minimum number of calls per median time.
        once_s: longer calls, in seconds, are timed once.
        limit_s: time limit of a method in seconds; the time of slower methods is extrapolated from
            one and two iterations.
    """

    columns: Mapping[str, str] = METHODS
    keys: Sequence[str] = METHODS_KEYS
    charts: Sequence[str] = ("error", "ms", "peak_mb")

    def __init__(
        self,
        parts: Sequence[Mapping[str, Any]],
        base: Mapping[str, Any],
        plan: Mapping[str, Mapping[str, Any]],
        rays: int = 2,
        repeats: int = 3,
        once_s: float = 20.0,
        limit_s: float = 300.0,
    ):
        peers = [str(config.get("peer", "")) for config in parts]
        plain = [{key: v for key, v in config.items() if key != "peer"} for config in parts]
        self.parts = list(zip(map(BenchmarkedPart.of, plain), peers, strict=True))
        self.plan, self.rays = expand(base, plan), rays
        self.repeats, self.once_s, self.limit_s = repeats, once_s, limit_s

    def groups(self) -> list[list[Job[Placed]]]:
        """Groups of jobs measured together: one case with all methods that support it."""
        return [
            [
                Job.of(self.columns, {**part.row, **asdict(case), "peer": peer}, (part, case))
                for part, peer in self.parts
                if part.takes(case.n, False, settings["block"])
            ]
            for case, settings in self.plan
        ]

    def label(self, row: Row) -> str:
        """Short label of a row's method."""
        return report.part_label(row)

    def measure(
        self, jobs: Sequence[Job[Placed]], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """Yield the rows of jobs on one case."""
        case = jobs[0].subject[1]
        with threads(case.threads):
            say(f"{report.case_label(jobs[0].row)}: exact views")
            data = measurement_of(case, self.rays)
            calls: dict[int, Callable[[], Tensor]] = {}
            done: dict[int, Row] = {}
            for key, job in enumerate(jobs):
                say(job.subject[0].label)
                call = self._call(job.subject, data)
                try:
                    self._call(job.subject, measurement_of(replace(case, n=TINY, views=TINY), 1))()
                    figures = self._short(job.subject, data) or self._first(call, data, case)
                    done[key] = {**job.row, "load": load_average(), **figures}
                except Exception as error:  # an error of a part becomes the status of its row
                    yield {**job.row, "load": load_average(), "status": f"skipped: {reason(error)}"}
                else:
                    calls[key] = call
            say("times")
            yield from self._timed(calls, done, case)

    def _call(
        self, placed: Placed, data: MethodInputs, iterations: int | None = None
    ) -> Callable[[], Tensor]:
        part, case = placed
        A, views = data.A.to(case.device), data.views.to(case.device)
        fewer = {} if iterations is None else {"iterations": iterations}
        method = build_method({"name": part.name, **part.options, **fewer})

        def call() -> Tensor:
            with torch.no_grad():
                return method(views, A).volume

        return call

    def _short(self, placed: Placed, data: MethodInputs) -> Row | None:
        """Extrapolated time and memory of a method that exceeds the limit; None if it does not."""
        if (iterations := placed[0].options.get("iterations")) is None:
            return None
        device = placed[1].device

        def run(count: int) -> float:
            return once(self._call(placed, data, count), device)[1]

        timed, peak = with_memory(lambda: shortened(run, iterations, self.limit_s), device)
        if timed is None:
            return None
        return {"ms": 1e3 * timed.seconds, "iterations_timed": timed.iterations, "peak_mb": peak}

    def _first(self, call: Callable[[], Tensor], data: MethodInputs, case: Workload) -> Row:
        """Error, memory and time of a call; for a short call, of the second one, with filled
        caches.
        """
        for _ in range(2):
            (volume, seconds), peak = with_memory(lambda: once(call, case.device), case.device)
            if seconds > self.once_s:
                break
        return {"error": data.error(volume.cpu()), "peak_mb": peak, "ms": 1e3 * seconds}

    def _timed(
        self, calls: Mapping[int, Callable[[], Tensor]], done: Mapping[int, Row], case: Workload
    ) -> Iterator[Row]:
        seconds = {key: row["ms"] / 1e3 for key, row in done.items()}
        whole = [key for key, row in done.items() if "iterations_timed" not in row]
        short = {key: calls[key] for key in whole if seconds[key] < self.once_s}
        times = interleaved(short, seconds, self.repeats, case.device)
        ms = {key: times[key].ms if key in times else row["ms"] for key, row in done.items()}
        names = {row["part"]: ms[key] for key, row in done.items()}
        for key, row in done.items():
            n_calls = times[key].calls if key in times else 1
            over = ms[key] / names.get(row["peer"], math.nan)
            yield {**row, "ms": ms[key], "calls": n_calls, "over_peer": over, "status": "ok"}

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """The table by name."""
        names = ("n", "views", "error", "ms", "iterations_timed", "peak_mb", "peer", "over_peer")
        done = [row for row in rows if row["status"] == "ok"]
        done.sort(key=lambda row: (number(row, "n"), number(row, "views")))
        lines = [
            (report.part_label(row), *(report.figure(row, name) for name in names)) for row in done
        ]
        text = f"# Reconstruction methods\n\n{report.markdown(('part', *names), lines, 1)}"
        return {"table": text + report.left_out(rows) + report.legend(self.columns)}
