"""`bench=skip`: speed-up by skipping over the full cube and over the cropped volume, and its
error.

Two modes skip nothing: "off" on the entire cube, and "cropped", which is off on the bounding box of
the nonzero voxels, as a careful user would crop by hand. Their times exclude the mask that
determines the box; those of all other modes include it.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.parts import CAMERAS
from mvrecon.core.registry import check_choice
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Box, Grid, placed
from mvrecon.methods.classical.sirt import sirt
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.visual_hull.support import support_from_views
from mvrecon_bench.benchmarks import plots
from mvrecon_bench.benchmarks.cases import Workload
from mvrecon_bench.benchmarks.columns import SKIP
from mvrecon_bench.benchmarks.fills import cube, filled
from mvrecon_bench.measure import interleaved, load_average, once, threads, with_memory
from mvrecon_bench.rows import Bench, Job, Row, measured, number, skipped

OFF, CROPPED = "off", "cropped"
DENSE = (OFF, CROPPED)
ITERATIONS = 20
#: Duration of a call in seconds above which each mode is timed once.
LONG_S = 10.0
#: Columns of the tables, and their formats.
SHOWN = {
    **{"chosen": "", "ms": ".4g", "over_full": ".3g", "over_crop": ".3g", "build_ms": ".3g"},
    **{"error": ".2g", "differing": ".0f", "peak_mb": ".1f", "occupancy": ".2%", "box": ".2%"},
}
AGAINST = {"over_full": "over the full cube", "over_crop": "over the volume cropped by hand"}


@dataclass(frozen=True, eq=False)
class Bed:
    """A volume with a rig, for one method.

    Args:
        volume: the volume, on its device.
        grid: grid of the volume.
        cameras: the rig.
        method: method of the projector.
        support: the voxels that may be nonzero; None: the nonzero voxels.
    """

    volume: Float[Tensor, "1 1 d h w"]
    grid: Grid
    cameras: Cameras
    method: str
    support: Bool[Tensor, "d h w"] | None = None

    @cached_property
    def mask(self) -> Bool[Tensor, "d h w"]:
        """The support."""
        return self.volume[0, 0] != 0 if self.support is None else self.support

    @cached_property
    def box(self) -> Box:
        """Bounding box of the support."""
        return Box.around(self.mask)

    @cached_property
    def views(self) -> Float[Tensor, "1 1 m v u"]:
        """Noise-free views of the volume."""
        return self.operator(OFF)(self.volume)

    def hull(self) -> Bool[Tensor, "d h w"]:
        """Support computed from the views."""
        mask = support_from_views(self.views, self.cameras, self.grid, kind="hull").mask
        return torch.ones_like(self.mask) if mask is None else mask[0, 0]

    @cached_property
    def within_hull(self) -> "Bed":
        """The same case with another support."""
        return replace(self, support=self.hull())

    def operator(self, mode: str, masked: bool = False) -> RayTransform:
        """The projector in a mode, optionally with the support."""
        grid = self.grid.cropped(self.box) if mode == CROPPED else self.grid
        support = self.cut(self.mask, mode) if masked else None
        skip = OFF if mode in DENSE else mode
        A = RayTransform(grid, self.cameras, self.method, skip=skip, support=support)
        return A.to(self.volume.device)

    def cut(self, volume: Tensor, mode: str) -> Tensor:
        """The part of a volume that a mode processes."""
        return volume[..., *self.box.slices].contiguous() if mode == CROPPED else volume

    def pasted(self, part: Tensor, mode: str) -> Tensor:
        """The inverse of `cut`, zero elsewhere."""
        return placed(part, self.box, self.grid.shape) if mode == CROPPED else part


class SkipTrial(NamedTuple):
    """One mode of one task.

    Args:
        A: the operator, which reports what it skipped.
        call: the timed call.
        whole: pads its result to the grid or detectors of "off" for comparison.
        build: computes the mask, once per support; None: no mask, or every call computes its own.
        charged: whether that time is added to the call's.
    """

    A: RayTransform
    call: Callable[[], Tensor]
    whole: Callable[[Tensor], Tensor] = lambda result: result
    build: Callable[[], Any] | None = None
    charged: bool = False


def forward(bed: Bed, mode: str) -> SkipTrial:
    """A x of a new volume at every call: its nonzero voxels are determined every time."""
    A, x = bed.operator(mode), bed.cut(bed.volume, mode).clone()

    def call() -> Tensor:
        x[..., :1, :1, :1].mul_(1)  # a new volume according to its version counter
        return A(x)

    return SkipTrial(A, call)


def forward_static(bed: Bed, mode: str) -> SkipTrial:
    """A x with a precomputed support."""
    A, x = bed.operator(mode, masked=mode not in DENSE), bed.cut(bed.volume, mode)
    return SkipTrial(A, lambda: A(x), build=lambda: A.with_support(bed.mask))


def adjoint(bed: Bed, mode: str) -> SkipTrial:
    """A^T y within a precomputed support for views of white noise, without empty rays."""
    A = bed.operator(mode, masked=mode not in DENSE)
    noise = torch.randn(1, 1, *A.range_shape, generator=torch.Generator().manual_seed(0))
    y = noise.to(bed.volume)

    def whole(part: Tensor) -> Tensor:
        return torch.where(bed.mask, bed.pasted(part, mode), 0)

    return SkipTrial(A, lambda: A.T(y), whole, lambda: A.with_support(bed.mask))


def reconstruction(bed: Bed, mode: str) -> SkipTrial:
    """SIRT within the visual hull of the views. All modes have this support, so that they return
    the same volume.
    """
    within = bed.within_hull
    A = within.operator(mode, masked=True)
    return SkipTrial(
        A,
        lambda: sirt(A, within.views, ITERATIONS),
        lambda part: within.pasted(part, mode),
        lambda: A.with_support(within.hull()),
        charged=True,
    )


#: Task -> function that builds a mode of it.
TASKS: dict[str, Callable[[Bed, str], SkipTrial]] = {
    **{"forward": forward, "forward_static": forward_static, "adjoint": adjoint},
    f"sirt{ITERATIONS}": reconstruction,
}
#: Titles of the picture's panels by task.
TITLES = {
    "forward": "projection, with the search for voxels",
    "forward_static": "projection within a given support",
    "adjoint": "back-projection into a given support",
    f"sirt{ITERATIONS}": f"{ITERATIONS} iterations of SIRT, with the hull",
}


class Skip(Bench):
    """Every task on every scene; the modes of a task are timed alternately.

    Args:
        scenes: name -> `{volume, rigs, ...}`, see `fills.filled`; `rigs` are names of `rigs`.
        rigs: name -> cameras, see `rig`.
        tasks: name of `TASKS` -> methods of the projector.
        modes: values of the projector's `skip`, besides off and cropped.
        base: n, device (or auto), threads (0: all).
        repeats: minimum number of calls per median time.

    Raises:
        ValueError: an unknown task or rig.
    """

    columns = SKIP
    keys = ("scene", "rig", "method", "task", "mode", "n", "device", "threads")
    charts = ("ms", "over_full", "over_crop")
    title, sections, shown = "What skipping gains", ("task",), SHOWN

    def __init__(
        self,
        scenes: Mapping[str, Mapping[str, Any]],
        rigs: Mapping[str, Mapping[str, Any]],
        tasks: Mapping[str, Sequence[str]],
        modes: Sequence[str],
        base: Mapping[str, Any],
        repeats: int = 5,
    ):
        asked = {name for scene in scenes.values() for name in scene["rigs"]}
        for what, names, known in (("task", tasks, TASKS), ("rig", asked, rigs)):
            for name in names:
                check_choice(what, name, known)
        self.scenes, self.rigs, self.tasks, self.modes = scenes, rigs, tasks, [*DENSE, *modes]
        case = Workload(**base)
        self.where = {name: getattr(case, name) for name in ("n", "device", "threads")}
        self.repeats = repeats

    def groups(self) -> list[list[Job]]:
        """Groups of jobs measured together: the modes of a task."""
        cases = [
            {"scene": name, "rig": rig, "method": method, "task": task, **self.where}
            for name, scene in self.scenes.items()
            for rig in scene["rigs"]
            for task, methods in self.tasks.items()
            for method in methods
        ]
        return [[Job({**case, "mode": mode}, case) for mode in self.modes] for case in cases]

    def label(self, row: Row) -> str:
        return " ".join(row[name] for name in ("scene", "rig", "method", "task", "mode"))

    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """Rows of some modes of a task; all of its modes are timed, since only alternate timings
        are comparable.
        """
        case, (n, device, count) = jobs[0].subject, self.where.values()
        say("{scene}, {rig}, {method}: {task}".format_map(case))
        common: Row = {"load": load_average()}
        with threads(count), torch.no_grad():
            try:
                scene = self.scenes[case["scene"]]
                grid = cube(scene, n)
                volume, source = filled(scene, grid)
                edge = grid.shape[0] * grid.spacing[0]
                cameras = rig(self.rigs[case["rig"]], edge, n)
                bed = Bed(volume[None, None].to(device), grid, cameras, case["method"])
                task = TASKS[case["task"]]
                found = compared(lambda mode: task(bed, mode), self.modes, self.repeats, device)
                common |= {"source": source, "grid": "x".join(map(str, grid.shape))}
                common["views"] = "x".join(map(str, (len(cameras), *cameras.shape)))
                common["occupancy"] = bed.mask.double().mean().item()
                common["box"] = bed.box.size / bed.mask.numel()
                if task is reconstruction:
                    common["support"] = bed.within_hull.mask.double().mean().item()
            except Exception as error:  # of a scene, a rig or a file
                found = dict.fromkeys(self.modes, skipped(error))
        for job in jobs:
            yield {**job.row, **common, **found[job.row["mode"]]}

    def summary(self, rows: Sequence[Row], folder: Path) -> str:
        """Write `speedups.png`."""
        plots.speedups(panels(measured(rows)), folder / "speedups.png")
        return "\nTimes as fast as off on the full cube, and as off on the cropped volume.\n"


def rig(config: Mapping[str, Any], field: float, n: int) -> Cameras:
    """Build the cameras of a configuration in the registry.

    With `cover`, the detector is a square whose edge is this multiple of the field of view, with
    `pixels` along it (n if null or absent); `detector` is ignored.
    """
    options = dict(config)
    if (cover := options.pop("cover", None)) is not None:
        pixels = options.pop("pixels", None) or n
        options["detector"] = {"pixels": [pixels, pixels], "pixel_mm": cover * field / pixels}
    return CAMERAS.from_config(options)


def compared(
    setup: Callable[[str], SkipTrial], modes: Sequence[str], repeats: int, device: str
) -> dict[str, Row]:
    """The figures of every mode, with "off" first as the reference result, then their times.

    An error of a mode becomes the status of its row; the run continues.
    """
    rows: dict[str, Row] = {}
    trials: dict[str, SkipTrial] = {}
    seconds: dict[str, float] = {}
    reference: Tensor | None = None
    for mode in modes:
        try:
            trial = setup(mode)
            once(trial.call, device)  # compiles and fills caches
            (result, taken), memory = with_memory(lambda t=trial: once(t.call, device), device)
            whole = trial.whole(result)
            reference = whole if mode == OFF else reference
            row = {"peak_mb": memory, **difference(whole, reference)}
            if trial.build is not None and mode not in DENSE:
                once(trial.build, device)
                row["build_ms"] = 1e3 * once(trial.build, device)[1]
        except Exception as error:
            rows[mode] = skipped(error)
        else:
            rows[mode], trials[mode], seconds[mode] = row, trial, taken
    repeats = 1 if max(seconds.values(), default=0.0) > LONG_S else repeats
    calls = {mode: trial.call for mode, trial in trials.items()}
    for mode, (ms, count) in interleaved(calls, seconds, repeats, device).items():
        A, row = trials[mode].A, rows[mode]
        charge = row.get("build_ms", 0.0) if trials[mode].charged else 0.0
        chosen, why = (OFF, "") if mode in DENSE else (A.skipped.mode, A.skipped.why)
        row |= {"ms": ms + charge, "calls": count, "chosen": chosen, "why": why, "status": "ok"}
    for mode in trials:
        for name, unit in (("over_full", OFF), ("over_crop", CROPPED)):
            if unit in trials:
                rows[mode][name] = rows[unit]["ms"] / rows[mode]["ms"]
    return rows


def difference(result: Tensor, reference: Tensor | None) -> Row:
    """Maximum absolute difference, and number of values that differ in any bit."""
    if reference is None:
        return {}
    a, b = (values.contiguous().view(torch.int32) for values in (result, reference))
    return {"error": (result - reference).abs().max().item(), "differing": int((a != b).sum())}


def _scene_label(row: Row) -> str:
    """The name of a scene, with the share of its non-zero voxels in place of digits, if known."""
    name, share = row["scene"].replace("_", " "), number(row, "occupancy")
    return name if math.isnan(share) else f"{name.rstrip('0123456789')}, {100 * share:.0f} %"


def panels(rows: Iterable[Row]) -> dict[str, dict[str, list[tuple[str, float]]]]:
    """Title of a task -> baseline -> (scene, speed-up) for every rig and method, in mode auto."""
    curves: dict[str, dict[str, list[tuple[str, float]]]] = {}
    for row in rows:
        if row["mode"] == "auto":
            kinds = curves.setdefault(TITLES[row["task"]], {text: [] for text in AGAINST.values()})
            for name, text in AGAINST.items():
                if (times := number(row, name)) == times:
                    kinds[text].append((_scene_label(row), times))
    return {task: kinds for task, kinds in curves.items() if all(kinds.values())}
