"""Cases of a benchmark: scene, rig, sizes, device and precision."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from mvrecon.core.machine import device_of
from mvrecon.core.numbers import generator
from mvrecon.core.parts import SCENES
from mvrecon.core.registry import check_choice
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras import rigs
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.rigs import DETECTOR_MM, dcspect80, modules
from mvrecon.geometry.grid import Grid
from mvrecon.operators.stacked import joined_cameras

#: Edge of the volume in mm; smaller for the closer pinholes of DC-SPECT.
FIELD, NEAR_FIELD = 256.0, 160.0
DTYPES = {name: getattr(torch, name) for name in ("float32", "float64", "float16", "bfloat16")}
#: Rigs with a fixed number of views.
FIXED_VIEWS = {"dcspect80": 80, "axis_aligned": 4, "axis_parallel": 3}


@dataclass(frozen=True)
class Workload:
    """A volume with a rig, in one precision.

    Args:
        scene: "box", or a scene of closed-form phantoms in the registry of scenes.
        camera: a name in `RIGS`.
        n: voxels along each edge.
        ratio: pixel / voxel, both at the isocentre.
        views: number of views of rigs without a fixed number.
        device: "cpu", "gpu" ("cuda"), or "auto": a GPU if available.
        dtype: dtype of volume and views.
        threads: number of threads; 0: torch's default.
        slices: central voxels along z, one per detector row of parallel beams; 0: n.

    Raises:
        ValueError: an unknown camera, dtype or device, or non-positive sizes.
    """

    scene: str = "ellipsoids"
    camera: str = "circular"
    n: int = 128
    ratio: float = 1.0
    views: int = 32
    device: str = "cpu"
    dtype: str = "float32"
    threads: int = 0
    slices: int = 0

    def __post_init__(self) -> None:
        check_choice("camera", self.camera, RIGS)
        check_choice("dtype", self.dtype, DTYPES)
        if self.n < 1 or not self.ratio > 0 or self.views < 1 or min(self.threads, self.slices) < 0:
            raise ValueError(f"A benchmark's n, ratio and views must be positive, got {self}")
        settled = {
            "views": FIXED_VIEWS.get(self.camera, self.views),
            "device": device_of(self.device),
            "threads": self.threads or torch.get_num_threads(),
        }
        for name, value in settled.items():
            object.__setattr__(self, name, value)

    @property
    def geometry(self) -> "Workload":
        """The case that defines the truth, independent of device and dtype."""
        return replace(self, device="cpu", dtype="float32", threads=1)

    @property
    def field(self) -> float:
        """Edge of the volume in mm."""
        return NEAR_FIELD if self.camera == "dcspect80" else FIELD

    @property
    def pixel(self) -> float:
        """Pixel size at the isocentre in mm."""
        return self.ratio * self.field / self.n

    def grid(self) -> Grid:
        """The grid of the volume, centred at the origin."""
        return Grid.centred(
            size=(self.n, self.n, self.slices or self.n), spacing=self.field / self.n
        )

    def cameras(self) -> Cameras:
        """The rig."""
        return RIGS[self.camera](self)

    def phantom(self) -> Phantom:
        """The object, with the same size in mm for every n."""
        if self.scene == "box":
            return boxes(self.field)
        return SCENES.build(self.scene).phantom(generator(0, 0), replace(self, slices=0).grid())


def boxes(field: float) -> Phantom:
    """Three boxes whose faces coincide with voxel faces if n is a multiple of 32, so that there is
    no discretisation error.
    """
    centres = torch.tensor([[1, -1, 0], [-3, 2, 4], [5, -4, -2]])
    halves = torch.tensor([[12, 10, 11], [3, 4, 2], [2, 3, 5]])
    values = torch.tensor([0.4, 0.5, -0.3])
    step = field / 32
    return Phantom((Solids.upright("box", centres * step, halves * step, values),))


def case_label(row: Mapping[str, Any]) -> str:
    """Short label of a row's case."""
    n, views, threads = (int(row[name]) for name in ("n", "views", "threads"))
    what = f"{row['scene']}, {row['camera']}, {n}^3, {views} views, pixel {row['ratio']:g} voxels"
    return f"{what}, {row['dtype']}, {row['device']}, {threads} thread{'s' * (threads > 1)}"


def expand(
    base: Mapping[str, Any], plan: Mapping[str, Mapping[str, Any]]
) -> list[tuple[Workload, dict[str, Any]]]:
    """The unique cases of a plan with the settings and the name of their block, small volumes
    first.

    A block `{about: {...}, vary: {axis: [values]}, **settings}` is the base case with the changes
    of `about`, and every axis varied separately from there.
    """
    cases: dict[Workload, dict[str, Any]] = {}
    for name, block in plan.items():
        about = Workload(**{**base, **block.get("about", {})})
        axes: Mapping[str, Sequence[Any]] = block.get("vary", {})
        varied = [
            replace(about, **{axis: value}) for axis, values in axes.items() for value in values
        ]
        settings = {key: value for key, value in block.items() if key not in ("about", "vary")}
        for case in sorted([about, *varied], key=lambda case: case.n):
            cases.setdefault(case, settings | {"block": name})
    return list(cases.items())


def _cone(case: Workload, sid: float, sdd: float, odd: int = 0, start: float = 3.0) -> Cameras:
    count = max(1, round(case.n / case.ratio)) | odd
    detector = {"pixels": [count, count], "pixel_mm": case.pixel * sdd / sid}
    return rigs.circular(case.views, sid, sdd, detector, start_degrees=start)


def _parallel(case: Workload, views: int) -> Cameras:
    count = max(1, round(case.n / case.ratio))
    start = 0.0 if views == 1 else 3.0
    rows, height = (case.slices, case.field / case.n) if case.slices else (count, case.pixel)
    detector = {"pixels": [rows, count], "pixel_mm": [height, case.pixel]}
    return rigs.parallel(views, detector, start_degrees=start)


def _dcspect80(case: Workload) -> Cameras:
    table = torch.tensor(modules(), dtype=torch.float64)
    zoom = (table[:, :3].norm(dim=1) / table[:, 3]).mean().item()
    return dcspect80(max(1, round(DETECTOR_MM * zoom / case.pixel)))


def _axis_aligned(case: Workload) -> Cameras:
    rig = _cone(case, 1000.0, 1536.0, odd=1, start=0.0)
    return replace(rig, **{name: getattr(rig, name).round(decimals=9) for name in VECTORS})


def _axis_parallel(case: Workload) -> Cameras:
    one = _parallel(case, 1)
    turn, still = torch.eye(3, dtype=torch.float64).roll(1, 0), torch.zeros(3, dtype=torch.float64)
    return joined_cameras([one, one.moved(turn, still), one.moved(turn @ turn, still)])


RIGS: dict[str, Callable[[Workload], Cameras]] = {
    "circular": lambda case: _cone(case, 1000.0, 1536.0),
    "dcspect80": _dcspect80,
    "parallel": lambda case: _parallel(case, case.views),
    "axis_aligned": _axis_aligned,
    "axis_parallel": _axis_parallel,
    "inside": lambda case: _cone(case, 100.0, 300.0),
    "far": lambda case: _cone(case, 1e6, 1e6 + 536.0),
}
