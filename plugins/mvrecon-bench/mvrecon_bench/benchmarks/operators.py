"""`bench=operators`: run time and error of every projector on the same voxels and rays."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from mvrecon.testing.measures import gap, inner_product_gap
from mvrecon_bench.benchmarks import accuracy, report, targets
from mvrecon_bench.benchmarks.cases import DTYPES, Workload, expand
from mvrecon_bench.benchmarks.columns import KEYS, OPERATORS
from mvrecon_bench.benchmarks.measure import Timing, interleaved, load_average, threads
from mvrecon_bench.benchmarks.part import BenchmarkedPart
from mvrecon_bench.benchmarks.rows import Job, Row, number
from mvrecon_bench.benchmarks.trial import CALLS, Trial, expected, reason
from mvrecon_bench.benchmarks.truth import Truth, truth_of

Say = Callable[[str], None]
#: A part on a case.
Placed = tuple[BenchmarkedPart, Workload]


class Operators:
    """Every part on every case of a plan; the parts on a case are timed alternately.

    Args:
        parts: the projectors, see `BenchmarkedPart.of`; the first one that supports a case is the
            reference for time ratios.
        base: first case of the tables, options of `Workload`.
        plan: blocks `{about: {...}, vary: {axis: [values]}, repeat_s: ...}`, see `cases.expand`.
        rays: the pixel average is the mean of rays x rays exact integrals.
        repeats: minimum number of calls per median time.
        limit_s: calls that are expected to take longer are skipped. Calls longer than a block's
            `repeat_s` are timed once, with a note.
    """

    columns: Mapping[str, str] = OPERATORS
    keys: Sequence[str] = KEYS
    charts: Sequence[str] = (
        "error_thin",
        "error_pixel",
        "forward_ms",
        "adjoint_ms",
        "volume_grad_ms",
        "pose_grad_ms",
    )

    def __init__(
        self,
        parts: Sequence[Mapping[str, Any]],
        base: Mapping[str, Any],
        plan: Mapping[str, Mapping[str, Any]],
        rays: int = 4,
        repeats: int = 5,
        limit_s: float = 30.0,
    ):
        self.parts, self.base = [BenchmarkedPart.of(config) for config in parts], Workload(**base)
        self.rays, self.repeats, self.limit_s = rays, repeats, limit_s
        self.plan = dict(expand(base, plan))

    def _parts(self, case: Workload) -> list[BenchmarkedPart]:
        """The parts that support a case; the first is the reference for time ratios."""
        parallel, block = case.cameras().parallel, self.plan[case]["block"]
        return [part for part in self.parts if part.takes(case.n, parallel, block)]

    def groups(self) -> list[list[Job[Placed]]]:
        """Groups of jobs measured together: one case with all parts that support it."""
        return [
            [
                Job.of(self.columns, {**part.row, **asdict(case)}, (part, case))
                for part in self._parts(case)
            ]
            for case in self.plan
        ]

    def label(self, row: Row) -> str:
        """Short label of a row's part."""
        return report.part_label(row)

    def measure(self, jobs: Sequence[Job[Placed]], rows: Sequence[Row], say: Say) -> Iterator[Row]:
        """Yield the rows of jobs on one case; `rows` are existing rows, used to predict long
        times.
        """
        case = jobs[0].subject[1]
        repeat_s = self.plan[case].get("repeat_s", 5.0)
        where, shown = (
            {"device": case.device, "dtype": DTYPES[case.dtype]},
            report.case_label(jobs[0].row),
        )
        with threads(case.threads):
            say(f"{shown}: truth")
            truth, rig, grid = truth_of(case.geometry, self.rays), case.cameras(), case.grid()
            x, y = truth.volume[None, None].to(**where), truth.cotangent[None, None].to(**where)
            common = {
                "pixels": "x".join(map(str, rig.shape)),
                "rays": truth.thin.numel(),
                "load": load_average(),
            }
            common |= {"floor_thin": truth.floor_thin, "floor_pixel": truth.floor_pixel}
            trials: list[tuple[Trial, Row]] = []
            for job in jobs:
                part = job.subject[0]
                say(f"{shown}: {part.label}")
                row = {**job.row, **common}
                try:
                    trial = Trial(part, grid, rig, x, y)
                    row |= self._examine(trial, truth, self._forecast(row, rows), repeat_s)
                except Exception as error:  # an error of a part becomes the status of its row
                    yield {**row, "status": f"skipped: {reason(error)}"}
                else:
                    trials.append((trial, row))
            say(f"{shown}: times")
            yield from self._timed(trials, case, repeat_s)

    def _forecast(self, row: Row, rows: Sequence[Row]) -> dict[str, float]:
        """Predicted seconds of each call, scaled by work (rays times voxels along an edge) from the
        largest similar case so far.
        """
        same = ("part", "options", "device", "dtype")
        done = [
            r
            for r in rows
            if r.get("status") == "ok"
            and all(r.get(k, "") == row[k] for k in same)
            and number(r, "n") < row["n"]
        ]
        if not done:
            return {}
        nearest = max(done, key=lambda r: r["n"] * r["rays"])
        grow = row["n"] * row["rays"] / (nearest["n"] * nearest["rays"])
        times = {call: number(nearest, f"{call}_ms") for call in CALLS}
        return {call: grow * ms / 1e3 for call, ms in times.items() if ms == ms}

    def _examine(
        self, trial: Trial, truth: Truth, forecast: Mapping[str, float], repeat_s: float
    ) -> Row:
        """Execute every call once, and fast calls again, for errors, memory and repeatability.

        Raises:
            RuntimeError: the forward call failed.
        """
        first = {}
        for call in CALLS:
            first[call] = trial.attempt(
                call, expected(trial.seconds, call, forecast), repeat_s, self.limit_s
            )
            if first["forward"] is None:
                raise RuntimeError("; ".join(trial.notes))
        views, volume, pose = first["forward"], first["adjoint"], first["pose_grad"]
        row: Row = {"first_ms": 1e3 * trial.first_s["forward"], "backend": trial.backend}
        for name in ("thin", "pixel"):
            row[f"error_{name}"] = gap(views[0, 0].cpu(), getattr(truth, name))
        results = [
            result
            for result in (views, volume, first["volume_grad"], *(pose or ()))
            if result is not None
        ]
        row["nans"] = accuracy.not_finite(results)
        if pose is not None:
            result = accuracy.rigid(pose, trial.cameras, trial.grid)[truth.watched]
            row["pose_cosine"] = accuracy.cosine(result, truth.pose)
        return row | self._repeat(trial, {"forward": views, "adjoint": volume}, repeat_s)

    def _repeat(
        self, trial: Trial, first: Mapping[str, torch.Tensor | None], repeat_s: float
    ) -> Row:
        row: Row = {}
        same: list[bool] = []
        for call, name in (("forward", "peak_mb"), ("adjoint", "adjoint_peak_mb")):
            before = first[call]
            if before is not None and trial.seconds[call] <= repeat_s:
                result, row[name] = trial.again(call)
                same.append(accuracy.same_bits(result, before))
        row["repeatable"] = all(same) if same else None
        volume = first["adjoint"]
        if volume is not None and trial.seconds["forward"] <= repeat_s:
            trial.x, x = (
                torch.rand(trial.x.shape, generator=torch.Generator().manual_seed(1)).to(trial.x),
                trial.x,
            )
            row["adjointness"] = inner_product_gap(trial.x, trial.forward(), trial.y, volume)
            trial.x = x
        return row

    def _timed(
        self, trials: Sequence[tuple[Trial, Row]], case: Workload, repeat_s: float
    ) -> Iterator[Row]:
        """Time each call of all parts alternately; return the rows with their ratios to the first
        part.
        """
        for call in CALLS:
            seconds_of = {
                n: trial.seconds[call]
                for n, (trial, _) in enumerate(trials)
                if call in trial.seconds
            }
            short = {n: s for n, s in seconds_of.items() if s <= repeat_s}
            calls = {n: getattr(trials[n][0], call) for n in short}
            timings = interleaved(calls, short, self.repeats, case.device)
            for n, seconds in seconds_of.items():
                trial, row = trials[n]
                timing = timings.get(n, Timing(1e3 * seconds, 1))
                row[f"{call}_ms"], row["calls"] = (
                    timing.ms,
                    min(row.get("calls", timing.calls), timing.calls),
                )
                if n not in timings:
                    trial.notes.append(f"{call}: one call, which took {seconds:.1f} s")
        first = self._parts(case)[0]
        unit = next((row for trial, row in trials if trial.part == first), {})
        for trial, row in trials:
            ratios = {
                f"{c}_ratio": row[f"{c}_ms"] / unit[f"{c}_ms"]
                for c in CALLS
                if {f"{c}_ms"} <= set(row) & set(unit)
            }
            rate = row["rays"] * case.n / (row["forward_ms"] / 1e3)
            yield {
                **row,
                **ratios,
                "ray_slabs_per_s": rate,
                "status": "ok",
                "note": "; ".join(trial.notes),
            }

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """Write `pareto.png` if matplotlib is installed; return the tables by name."""
        base = {name: value for name, value in asdict(self.base).items() if name in KEYS}
        if find_spec("matplotlib"):
            from mvrecon_bench.benchmarks import plots  # part of the optional extra `bench`

            names = {
                "thin": "relative error, thin ray",
                "pixel": "relative error, pixel average",
            }
            panels = {title: report.panel(rows, base, name) for name, title in names.items()}
            plots.pareto(panels, folder / "pareto.png")
        wanted = (*(targets.GPU if self.base.device != "cpu" else targets.CPU), *targets.ACCURACY)
        return {
            "table": report.operators_table(rows, self.columns),
            "targets": targets.table(wanted, rows, base),
        }
