"""`bench=skip`: speed-up by skipping over the full cube and over the cropped volume, and its
error.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Box
from mvrecon_bench.benchmarks import skip_report, targets
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.columns import SKIP, SKIP_KEYS
from mvrecon_bench.benchmarks.measure import load_average, threads
from mvrecon_bench.benchmarks.rows import Job, Row
from mvrecon_bench.benchmarks.skip_measure import compared
from mvrecon_bench.benchmarks.skip_model import CROSS_VIEW, Learned
from mvrecon_bench.benchmarks.skip_scenes import Filled, cube, edge, filled, rig
from mvrecon_bench.benchmarks.skip_tasks import DENSE, TASKS, Bed, SkipTrial, reconstruction
from mvrecon_bench.benchmarks.trial import reason


class SkipJob(NamedTuple):
    """A task for a scene and a rig, whose modes are measured together.

    Args:
        n: voxels along each edge; None: those of a checkpoint.
    """

    scene: str
    rig: str
    method: str
    task: str
    n: int | None


class Skip:
    """Every task on every scene; the modes of a task are timed alternately.

    Args:
        scenes: name -> `{volume, rigs, ...}`, see `skip_scenes.filled`; `rigs` are names of `rigs`.
        rigs: name -> cameras, see `skip_scenes.rig`.
        tasks: name of `skip_tasks.TASKS` -> methods of the projector.
        modes: values of the projector's `skip`, besides off and cropped.
        base: n, device (or auto), threads (0: all).
        cross_view: method, n, rig, modes (kinds of support), `checkpoints` (scene -> file), `cases`
            over which a trained model's PSNR is averaged; null omits the model.
        repeats: minimum number of calls per median time.

    Raises:
        ValueError: an unknown task, rig or scene.
    """

    columns: Mapping[str, str] = SKIP
    keys: Sequence[str] = SKIP_KEYS
    charts: Sequence[str] = ("ms", "over_full", "over_crop")

    def __init__(
        self,
        scenes: Mapping[str, Mapping[str, Any]],
        rigs: Mapping[str, Mapping[str, Any]],
        tasks: Mapping[str, Sequence[str]],
        modes: Sequence[str],
        base: Mapping[str, Any],
        cross_view: Mapping[str, Any] | None = None,
        repeats: int = 5,
    ):
        asked = {name for scene in scenes.values() for name in scene["rigs"]}
        trained = {
            name
            for name, path in (cross_view or {}).get("checkpoints", {}).items()
            if path is not None
        }
        for what, names, known in (
            ("task", tasks, TASKS),
            ("rig", asked, rigs),
            ("scene", trained, scenes),
        ):
            if unknown := set(names) - set(known):
                raise ValueError(
                    f"Unknown {what} {', '.join(sorted(unknown))}. Known: {', '.join(known)}"
                )
        self.scenes, self.rigs, self.tasks, self.modes = scenes, rigs, tasks, [*DENSE, *modes]
        settled = Workload(device=base["device"], threads=base["threads"])
        self.n, self.device, self.threads = base["n"], settled.device, settled.threads
        self.learned, self.repeats = cross_view, repeats
        self._last: tuple[str, Filled] | None = None

    def groups(self) -> list[list[Job[SkipJob]]]:
        """Groups of jobs measured together: the modes of a task."""
        every: list[SkipJob] = []
        for name, scene in self.scenes.items():
            every += [
                SkipJob(name, rig_name, method, task, self.n)
                for rig_name in scene["rigs"]
                for task, methods in self.tasks.items()
                for method in methods
            ]
            if self.learned:
                trained = self.learned["checkpoints"].get(name) is not None
                rig_name, n = ("trained", None) if trained else ("model", self.learned["n"])
                every.append(SkipJob(name, rig_name, "joseph", CROSS_VIEW, n))
        where = {"device": self.device, "threads": self.threads}
        return [
            [Job({**one._asdict(), "mode": mode, **where}, one) for mode in self._modes(one.task)]
            for one in every
        ]

    def _modes(self, task: str) -> list[str]:
        return [*DENSE, *(self.learned or {})["modes"]] if task == CROSS_VIEW else self.modes

    def label(self, row: Row) -> str:
        """Short label of a row's case and mode."""
        return skip_report.label(row)

    def measure(
        self, jobs: Sequence[Job[SkipJob]], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """Rows of some modes of a task; all of its modes are timed, since only alternate timings
        are comparable.
        """
        first = jobs[0].subject
        say(f"{first.scene}, {first.rig}, {first.method}: {first.task}")
        common: Row = {"load": load_average()}
        with threads(self.threads), torch.no_grad():
            try:
                setup, known = (
                    self._model(first) if first.task == CROSS_VIEW else self._operator(first)
                )
                figures = compared(setup, self._modes(first.task), self.repeats, self.device)
                common |= known
            except (
                Exception
            ) as error:  # errors of a scene, a rig or a file become the status of their rows
                failed = {"status": f"skipped: {reason(error)}"}
                figures = dict.fromkeys(self._modes(first.task), failed)
        for job in jobs:
            yield {**job.row, **common, **figures[job.row["mode"]]}

    def _operator(self, job: SkipJob) -> tuple[Callable[[str], SkipTrial], Row]:
        """Build a mode of an operator's task; also the properties of the case."""
        scene, task = self.scenes[job.scene], TASKS[job.task]
        if self._last is None or self._last[0] != job.scene:
            self._last = job.scene, filled(scene, cube(scene, self.n))
        what = self._last[1]
        bed = Bed(what, rig(self.rigs[job.rig], edge(what.grid), self.n), job.method, self.device)
        known = facts(what.source, what.volume != 0, bed.cameras)
        if task is reconstruction:
            known["support"] = bed.within_hull.mask.double().mean().item()
        return partial(task, bed), known

    def _model(self, job: SkipJob) -> tuple[Callable[[str], SkipTrial], Row]:
        """The same for the model's task."""
        assert self.learned is not None
        checkpoint = self.learned["checkpoints"].get(job.scene)
        learned = Learned.of(self.scenes[job.scene], self.learned, checkpoint, self.device)
        known = facts(learned.first.source, learned.first.volume[0] != 0, learned.A.cameras)
        return learned.trial, known | {"support": learned.support("hull").fraction}

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """Write `speedups.png` if matplotlib is installed; return the tables by name."""
        panels = skip_report.panels(rows)
        if panels and find_spec("matplotlib"):
            from mvrecon_bench.benchmarks import plots  # part of the optional extra `bench`

            plots.speedups(panels, folder / "speedups.png")
        base = {"device": self.device, "threads": self.threads}
        return {
            "table": skip_report.table(rows, self.columns),
            "targets": targets.table(targets.SKIP, rows, base),
        }


def facts(source: str, support: Bool[Tensor, "d h w"], cameras: Cameras) -> Row:
    """Columns of a row that describe a volume, by its nonzero voxels, and a rig."""
    return {
        "source": source,
        "grid": "x".join(map(str, support.shape)),
        "views": "x".join(map(str, (len(cameras), *cameras.shape))),
        "occupancy": support.double().mean().item(),
        "box": Box.around(support).size / support.numel(),
    }
