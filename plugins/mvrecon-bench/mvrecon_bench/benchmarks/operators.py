"""`bench=operators`: run time and error of every projector on the same voxels and rays."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mvrecon.testing.measures import bits, gap, inner_product_gap
from mvrecon_bench.benchmarks import plots
from mvrecon_bench.benchmarks.cases import DTYPES, Workload, case_label, expand
from mvrecon_bench.benchmarks.columns import OPERATORS
from mvrecon_bench.benchmarks.trial import CALLS, Part, Trial, part_label
from mvrecon_bench.benchmarks.truth import Truth, cosine, rigid, truth_of
from mvrecon_bench.measure import Timing, interleaved, load_average, threads, with_memory
from mvrecon_bench.rows import Bench, Job, Row, measured, number, skipped

#: Columns of the tables, and their formats.
SHOWN = {
    **{"error_thin": ".4f", "floor_thin": ".4f", "error_pixel": ".4f", "floor_pixel": ".4f"},
    **{f"{call}_ms": ".4g" for call in CALLS},
    **{"peak_mb": ".1f", "adjoint_peak_mb": ".1f"},
    **{"adjointness": ".1e", "repeatable": "", "nans": ".0f", "pose_cosine": ".3f"},
}
CASE = ("scene", "camera", "n", "ratio", "views", "dtype", "threads", "device")


class Operators(Bench):
    """Every part on every case of a plan; the parts on a case are timed alternately.

    Args:
        parts: the projectors, see `Part.of`.
        base: first case of the tables, options of `Workload`.
        plan: blocks `{about: {...}, vary: {axis: [values]}, repeat_s: ...}`, see `cases.expand`.
        rays: the pixel average is the mean of rays x rays exact integrals.
        repeats: minimum number of calls per median time; calls longer than a block's `repeat_s` are
            timed once, with a note.
    """

    columns = OPERATORS
    keys = ("part", "options", *CASE)
    charts = ("error_thin", "error_pixel", *(f"{call}_ms" for call in CALLS))
    title, sections, shown = "Run time against error", CASE, SHOWN

    def __init__(
        self,
        parts: Sequence[Mapping[str, Any]],
        base: Mapping[str, Any],
        plan: Mapping[str, Mapping[str, Any]],
        rays: int = 4,
        repeats: int = 5,
    ):
        self.parts, self.base = [Part.of(config) for config in parts], Workload(**base)
        self.rays, self.repeats, self.plan = rays, repeats, dict(expand(base, plan))

    def groups(self) -> list[list[Job]]:
        """Groups of jobs measured together: one case with all parts that support it."""
        return [
            [
                self.job({**part.row, **asdict(case)}, (part, case))
                for part in self.parts
                if part.takes(case.n, case.cameras().parallel, settings["block"])
            ]
            for case, settings in self.plan.items()
        ]

    def label(self, row: Row) -> str:
        return part_label(row)

    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """Yield the rows of jobs on one case."""
        case, shown = jobs[0].subject[1], case_label(jobs[0].row)
        repeat_s = self.plan[case].get("repeat_s", 5.0)
        with threads(case.threads):
            say(f"{shown}: truth")
            truth, rig, grid = truth_of(case.geometry, self.rays), case.cameras(), case.grid()
            x, y = (one[None, None].to(case.device, DTYPES[case.dtype]) for one in truth[:2])
            common = {"pixels": "x".join(map(str, rig.shape)), "rays": truth.thin.numel()}
            common |= {"floor_thin": truth.floor_thin, "floor_pixel": truth.floor_pixel}
            trials: list[tuple[Trial, Row]] = []
            for job in jobs:
                part, row = job.subject[0], {**job.row, **common, "load": load_average()}
                say(f"{shown}: {part.label}")
                try:
                    trial = Trial(part, grid, rig, x, y)
                    row |= self._examine(trial, truth, repeat_s)
                except Exception as error:  # an error of a part becomes the status of its row
                    yield row | skipped(error)
                else:
                    trials.append((trial, row))
            say(f"{shown}: times")
            yield from self._timed(trials, case, repeat_s)

    def _examine(self, trial: Trial, truth: Truth, repeat_s: float) -> Row:
        """Execute every call once, and fast calls again, for errors, memory and repeatability.

        Raises:
            RuntimeError: the forward call failed.
        """
        first: dict[str, Any] = {}
        for call in CALLS:
            first[call] = trial.attempt(call, repeat_s)
            if first["forward"] is None:
                raise RuntimeError("; ".join(trial.notes))
        *calls, pose = first.values()
        results = [result for result in (*calls, *(pose or ())) if result is not None]
        views = first["forward"][0, 0].cpu()
        row: Row = {"first_ms": 1e3 * trial.first_s["forward"], "backend": trial.backend}
        row |= {f"error_{name}": gap(views, getattr(truth, name)) for name in ("thin", "pixel")}
        row["nans"] = sum(int((~result.isfinite()).sum()) for result in results)
        if pose is not None:
            found = rigid(pose, trial.cameras, trial.grid)[truth.watched]
            row["pose_cosine"] = cosine(found, truth.pose)
        return row | self._repeat(trial, first, repeat_s)

    def _repeat(self, trial: Trial, first: Mapping[str, Any], repeat_s: float) -> Row:
        row: Row = {}
        same: list[bool] = []
        for call, name in (("forward", "peak_mb"), ("adjoint", "adjoint_peak_mb")):
            before = first[call]
            if before is not None and trial.seconds[call] <= repeat_s:
                result, row[name] = with_memory(getattr(trial, call), trial.device)
                same.append(bits(result, before) == 0)
        row["repeatable"] = all(same) if same else None
        if first["adjoint"] is not None and trial.seconds["forward"] <= repeat_s:
            x, rng = trial.x, torch.Generator().manual_seed(1)
            trial.x = torch.rand(x.shape, generator=rng).to(x)
            pairs = trial.x, trial.forward(), trial.y, first["adjoint"]
            row["adjointness"], trial.x = inner_product_gap(*pairs), x
        return row

    def _timed(
        self, trials: Sequence[tuple[Trial, Row]], case: Workload, repeat_s: float
    ) -> Iterator[Row]:
        """Time each call of all parts alternately; return the rows."""
        for call in CALLS:
            taken = {n: t.seconds[call] for n, (t, _) in enumerate(trials) if call in t.seconds}
            short = {n: seconds for n, seconds in taken.items() if seconds <= repeat_s}
            calls: dict[int, Callable[[], Tensor]] = {n: getattr(trials[n][0], call) for n in short}
            timings = interleaved(calls, short, self.repeats, case.device)
            for n, seconds in taken.items():
                trial, row = trials[n]
                timing = timings.get(n, Timing(1e3 * seconds, 1))
                row |= {
                    f"{call}_ms": timing.ms,
                    "calls": min(row.get("calls", math.inf), timing.calls),
                }
                if n not in timings:
                    trial.notes.append(f"{call}: one call, which took {seconds:.1f} s")
        for trial, row in trials:
            yield row | {"status": "ok", "note": "; ".join(trial.notes)}

    def summary(self, rows: Sequence[Row], folder: Path) -> str:
        """Write `pareto.png`."""
        plots.pareto(self._panels(rows), folder / "pareto.png")
        return ""

    def _panels(self, rows: Sequence[Row]) -> dict[str, plots.Pareto]:
        """For either truth, the results of the base case at all sizes: by part (forward time,
        error), small volumes first; and the error floor by volume size.
        """
        base = asdict(self.base)
        same = [
            row
            for row in measured(rows)
            if all(row[name] == base[name] for name in CASE if name != "n")
        ]
        panels: dict[str, plots.Pareto] = {}
        for name, title in (("thin", "thin ray"), ("pixel", "pixel average")):
            curves: dict[str, list[tuple[float, float]]] = {}
            for row in sorted(same, key=lambda row: row["n"]):
                point = number(row, "forward_ms"), number(row, f"error_{name}")
                if not math.isnan(sum(point)):
                    curves.setdefault(part_label(row), []).append(point)
            floors = {int(row["n"]): number(row, f"floor_{name}") for row in same}
            panels[f"relative error, {title}"] = curves, floors
        return panels
