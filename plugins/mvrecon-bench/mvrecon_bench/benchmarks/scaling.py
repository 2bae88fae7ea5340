"""`bench=scaling`: time against the amount of work, with fitted exponents."""

import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from mvrecon.core.registry import check_choice
from mvrecon.data.scenes.solids import voxelise
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.report.comparison import Cells, markdown
from mvrecon_bench.benchmarks import plots
from mvrecon_bench.benchmarks.cases import DTYPES, FIELD, Workload
from mvrecon_bench.benchmarks.columns import SCALING
from mvrecon_bench.benchmarks.trial import Part, Trial, part_label
from mvrecon_bench.measure import interleaved, load_average, threads
from mvrecon_bench.rows import Bench, Job, Row, number, skipped

#: Varied quantity -> setting, and the exponent of the setting in the amount of work.
AXES = {"voxels": ("n", 3), "rays": ("pixels", 2)}
AXES |= {name: (name, 1) for name in ("views", "batch", "channels", "threads")}
#: Labels of the picture's axes, where they say more than the name.
AXIS_LABELS = {
    "rays": "rays per view",
    "batch": "volumes in a batch",
    "channels": "channels of a volume",
}
CALLS = ("forward", "adjoint")


def trial_of(part: Part, work: Mapping[str, Any]) -> Trial:
    """Trial of a part on an amount of work: n, pixels, views, batch, channels, device, dtype."""
    case, pixels, volumes = Workload(n=work["n"]), work["pixels"], (work["batch"], work["channels"])
    detector = {"pixels": [pixels, pixels], "pixel_mm": 1.536 * FIELD / pixels}
    rig = circular(work["views"], 1000.0, 1536.0, detector, start_degrees=3.0)
    x = voxelise(case.phantom(), case.grid()).expand(*volumes, *case.grid().shape).contiguous()
    y = torch.randn(*volumes, len(rig), *rig.shape, generator=torch.Generator().manual_seed(0))
    x, y = (one.to(work["device"], DTYPES[work["dtype"]]) for one in (x, y))
    return Trial(part, case.grid(), rig, x, y)


class Scaling(Bench):
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

    columns = SCALING
    keys = (
        *("part", "options", "device", "dtype", "axis"),
        *("n", "pixels", "views", "batch", "channels", "threads"),
    )
    charts = ("forward_ms", "adjoint_ms")
    title = "Time against work"
    shown = dict.fromkeys(("size", *(setting for setting, _ in AXES.values()), *charts), ".6g")

    def __init__(
        self,
        parts: Sequence[Mapping[str, Any]],
        base: Mapping[str, Any],
        vary: Mapping[str, Sequence[int]],
        repeats: int = 5,
    ):
        for axis in vary:
            check_choice("axis", axis, AXES)
        self.parts, self.vary, self.repeats = [Part.of(one) for one in parts], vary, repeats
        settled = Workload(device=base["device"], dtype=base["dtype"], threads=base["threads"])
        self.base: dict[str, Any] = {**base, "device": settled.device, "threads": settled.threads}

    def groups(self) -> list[list[Job]]:
        """Groups of jobs measured together: one axis."""
        groups = []
        for axis, values in self.vary.items():
            setting, power = AXES[axis]
            works = [{**self.base, setting: n, "axis": axis, "size": n**power} for n in values]
            pairs = [(part, work) for part in self.parts for work in works]
            groups.append([self.job({**work, **part.row}, (part, work)) for part, work in pairs])
        return groups

    def label(self, row: Row) -> str:
        return f"{part_label(row)}, {row['axis']}"

    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """Yield the rows of the points on one axis."""
        trials: list[tuple[Trial, Row]] = []
        for job in jobs:
            row = {**job.row, "load": load_average()}
            try:
                trials.append((trial_of(*job.subject), row))
            except Exception as error:  # an error of a part becomes the status of its row
                yield row | skipped(error)
        for call in CALLS:
            say(f"{jobs[0].row['axis']}: {call}")
            calls, first = {}, {}
            for key, (trial, row) in enumerate(trials):
                with threads(row["threads"]):
                    if trial.attempt(call, math.inf) is not None:
                        calls[key] = threads(row["threads"])(getattr(trial, call))
                        first[key] = trial.seconds[call]
            timings = interleaved(calls, first, self.repeats, self.base["device"])
            for key, (ms, count) in timings.items():
                row = trials[key][1]
                row |= {f"{call}_ms": ms, "calls": min(row.get("calls", count), count)}
        for trial, row in trials:
            note = "; ".join(trial.notes)
            status = "ok" if "forward_ms" in row else f"skipped: {note}"
            yield {**row, "backend": trial.backend, "status": status, "note": note}

    def summary(self, rows: Sequence[Row], folder: Path) -> str:
        """Write `scaling.png`; the exponents."""
        panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
        fits = []
        for (label, axis, call), points in series(rows).items():
            panels.setdefault(AXIS_LABELS.get(axis, axis), {})[f"{label} {call}"] = points
            p, error = exponent(points)
            span = f"{points[0][0]:g} to {points[-1][0]:g}"
            fits.append((label, axis, call, span, f"{p:.2f}", f"{error:.2f}".replace("nan", "")))
        base = self.base
        start = (
            f"one quantity varied at a time from {base['n']}³ voxels, {base['views']} views of "
            f"{base['pixels']}² pixels"
        )
        plots.scaling(panels, folder / "scaling.png", start)
        head = ("part", "axis", "call", "work", "exponent", "standard error")
        return f"\nTime = c * work^exponent.\n\n{markdown(Cells(head, fits), 4)}"


def series(rows: Sequence[Row]) -> dict[tuple[str, str, str], list[tuple[float, float]]]:
    """(part, axis, call) -> (amount of work, ms), by increasing amount."""
    curves: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for row in sorted(rows, key=lambda row: row["size"]):
        for call in CALLS:
            if (ms := number(row, f"{call}_ms")) == ms:
                key = part_label(row), row["axis"], call
                curves.setdefault(key, []).append((row["size"], ms))
    return curves


def exponent(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Fit time = c * work^p by least squares in the logarithms; return p and its standard error.

    NaN for too few points: p requires two different amounts of work, its error three.
    """
    work, ms = ([math.log(value) for value in values] for values in zip(*points, strict=True))
    if len(set(work)) < 2:
        return math.nan, math.nan
    p, start = statistics.linear_regression(work, ms)
    if len(points) < 3:
        return p, math.nan
    left = sum((y - start - p * x) ** 2 for x, y in zip(work, ms, strict=True))
    return p, math.sqrt(left / (len(points) - 2) / (len(points) - 1) / statistics.variance(work))
