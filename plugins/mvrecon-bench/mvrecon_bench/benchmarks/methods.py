"""`bench=methods`: run time, memory and error of the reconstruction methods."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.data.scenes.solids import voxelise
from mvrecon.methods.method import build_method
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.testing.measures import gap
from mvrecon_bench.benchmarks.cases import Workload, case_label, expand
from mvrecon_bench.benchmarks.columns import METHODS
from mvrecon_bench.benchmarks.trial import Part, part_label
from mvrecon_bench.measure import interleaved, load_average, once, threads, with_memory
from mvrecon_bench.rows import Bench, Job, Row, skipped

#: Voxels and views of the warm-up call, in which a part imports and compiles.
TINY = 16


class MethodInputs(NamedTuple):
    """The inputs of the methods, and the truth."""

    A: RayTransform
    views: Float[Tensor, "1 1 m v u"]
    volume: Float[Tensor, "d h w"]
    inside: Bool[Tensor, "d h w"]


@lru_cache(maxsize=2)
def measurement_of(case: Workload, rays: int) -> MethodInputs:
    """Views as means of rays x rays exact integrals per pixel, and the truth of a case."""
    grid, rig, phantom = case.grid(), case.cameras(), case.phantom()
    views = phantom.views(rig, rays)[None, None].float()
    volume = voxelise(phantom, grid).float()
    return MethodInputs(RayTransform(grid, rig), views, volume, volume > 0)


class Methods(Bench):
    """Every method on every case of a plan; the methods on a case are timed alternately.

    Args:
        parts: the methods `{name: ..., peer: ..., **options}`, see `Part.of`.
        base: first case of the plan, options of `Workload`.
        plan: blocks `{about: {...}, vary: {axis: [values]}}`, see `cases.expand`.
        rays: a pixel is the mean of rays x rays exact integrals.
        repeats: minimum number of calls per median time.
        once_s: longer calls, in seconds, are timed once.
    """

    columns = METHODS
    keys = (
        *("part", "options", "scene", "camera", "n", "slices", "ratio", "views"),
        *("device", "threads"),
    )
    charts = ("error", "ms", "peak_mb")
    title, sections = "Reconstruction methods", ("n", "views")
    shown = dict.fromkeys((*charts, "peer", "over_peer"), ".4g")

    def __init__(
        self,
        parts: Sequence[Mapping[str, Any]],
        base: Mapping[str, Any],
        plan: Mapping[str, Mapping[str, Any]],
        rays: int = 2,
        repeats: int = 3,
        once_s: float = 20.0,
    ):
        self.parts, self.plan, self.rays = list(map(Part.of, parts)), expand(base, plan), rays
        self.repeats, self.once_s = repeats, once_s

    def groups(self) -> list[list[Job]]:
        """Groups of jobs measured together: one case with all methods that support it."""
        return [
            [
                self.job({**part.row, **asdict(case)}, (part, case))
                for part in self.parts
                if part.takes(case.n, False, settings["block"])
            ]
            for case, settings in self.plan
        ]

    def label(self, row: Row) -> str:
        return part_label(row)

    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """Yield the rows of jobs on one case."""
        case = jobs[0].subject[1]
        with threads(case.threads):
            say(f"{case_label(jobs[0].row)}: exact views")
            data = measurement_of(case, self.rays)
            tiny = measurement_of(replace(case, n=TINY, views=TINY), 1)
            calls: dict[int, Callable[[], Tensor]] = {}
            done: dict[int, Row] = {}
            for key, job in enumerate(jobs):
                say(job.subject[0].label)
                row = {**job.row, "load": load_average()}
                try:
                    call = _call(job.subject[0], case, data)
                    _call(job.subject[0], case, tiny)()
                    done[key], calls[key] = row | self._first(call, data, case), call
                except Exception as error:  # an error of a part becomes the status of its row
                    yield row | skipped(error)
            say("times")
            yield from self._timed(calls, done, case)

    def _first(self, call: Callable[[], Tensor], data: MethodInputs, case: Workload) -> Row:
        """Error, memory and time of a call; for a short call, of the second one, with filled
        caches.
        """
        for _ in range(2):
            (volume, seconds), memory = with_memory(lambda: once(call, case.device), case.device)
            if seconds > self.once_s:
                break
        error = gap(volume.cpu()[0, 0][data.inside], data.volume[data.inside])
        return {"error": error, "peak_mb": memory, "ms": 1e3 * seconds}

    def _timed(
        self, calls: Mapping[int, Callable[[], Tensor]], done: Mapping[int, Row], case: Workload
    ) -> Iterator[Row]:
        seconds = {key: row["ms"] / 1e3 for key, row in done.items()}
        short = {key: call for key, call in calls.items() if seconds[key] < self.once_s}
        times = interleaved(short, seconds, self.repeats, case.device)
        ms = {key: times[key].ms if key in times else row["ms"] for key, row in done.items()}
        names = {row["part"]: ms[key] for key, row in done.items()}
        for key, row in done.items():
            over = ms[key] / names.get(row["peer"], math.nan)
            count = times[key].calls if key in times else 1
            yield {**row, "ms": ms[key], "calls": count, "over_peer": over, "status": "ok"}


def _call(part: Part, case: Workload, data: MethodInputs) -> Callable[[], Tensor]:
    A, views = data.A.to(case.device), data.views.to(case.device)
    method = build_method({"name": part.name, **part.options})

    def call() -> Tensor:
        with torch.no_grad():
            return method(views, A).volume

    return call
