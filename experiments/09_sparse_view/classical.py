"""Errors of methods without training against their iterations, on test slices of the experiment at
several sizes.
"""

import time
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mvrecon.config import compose
from mvrecon.data.module import TEST
from mvrecon.engine.fit import build_data
from mvrecon.engine.module import build_projector
from mvrecon.metrics import nrmse
from mvrecon.parts import RECONSTRUCTORS
from mvrecon.projectors.operator import Projector
from mvrecon.reconstructors.problem import Iterate

#: Edge of the grid, and of the virtual detector, in mm.
EDGE, DETECTOR = 180.0, 400.0
#: Iterations at which the error is looked at, and every five hundredth.
AT = (1, 3, 10, 30, 100, 200, 300)


class Scan(NamedTuple):
    """A slice of so many pixels each way from so many views of twice as many pixels.

    Args:
        size: pixels each way.
        views: a quarter of it, as in the AAPM challenge.
        detail: periods of the texture's finest wave across the breast.
        dtype: of views and volume; rounding in single precision ends the fall of the error at 1e-4.
    """

    size: int
    views: int
    detail: int
    dtype: torch.dtype = torch.float64

    @property
    def overrides(self) -> list[str]:
        """What this scan changes in the experiment."""
        detector = f"{{pixels: [1, {2 * self.size}], pixel_mm: {DETECTOR / (2 * self.size)}}}"
        return [
            f"grid={{size: [{self.size}, {self.size}, 1], spacing: {EDGE / self.size}}}",
            f"camera.n_views={self.views}",
            f"camera.detector={detector}",
            f"scene.detail={self.detail}",
        ]


class Run(NamedTuple):
    """A method on a scan, in stages of falling weight: the next starts where the last one ended.

    Args:
        method: of the registry `reconstructor`.
        scan: what is reconstructed.
        weights: of the total variation; none for methods without.
        iterations: of each stage.
    """

    method: str
    scan: Scan
    iterations: int = 0
    weights: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        """Name in the table."""
        if not self.weights:
            return self.method
        ends = dict.fromkeys(f"{weight:g}" for weight in (self.weights[0], self.weights[-1]))
        return f"{self.method} {' to '.join(ends)}"


SMALL, MIDDLE = Scan(64, 16, 6), Scan(128, 32, 12)
LARGE = Scan(512, 128, 12, torch.float32)
FALLING = (1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
RUNS = (
    Run("fbp", SMALL),
    Run("sirt", SMALL, 500),
    Run("cgls", SMALL, 500),
    Run("fista_tv", SMALL, 500, (1e-5,)),
    Run("fista_tv", SMALL, 1000, (1e-6,)),
    Run("fista_tv", SMALL, 500, FALLING),
    Run("fista_tv", MIDDLE, 500, FALLING[:3]),
)
#: Of the challenge's size.
LARGE_RUNS = (Run("fista_tv", LARGE, 300, FALLING[:1]),)


def case(scan: Scan) -> tuple[Projector, Tensor, Tensor]:
    """Operator, exact views and truth of the first test slice."""
    settings = compose("experiment=sparse_view", *scan.overrides)
    data = build_data(settings)
    A = build_projector(*(settings[key] for key in ("grid", "camera", "projector")))
    sample = data.scenes["test"].sample(data.indices("test")[0], TEST, data.grid, data.cameras)
    truth = sample.volume[None].to(scan.dtype)
    return A, A(truth), truth


def rows(run: Run) -> list[dict[str, Any]]:
    """A row for each number of iterations."""
    A, views, truth = case(run.scan)
    table: list[dict[str, Any]] = []
    start = time.perf_counter()

    def look(volume: Tensor, number: int, residual: Tensor) -> None:
        table.append(
            {
                "method": run.label,
                "size": run.scan.size,
                "views": run.scan.views,
                "counted": "iterations",
                "count": number,
                "nrmse": nrmse(volume, truth),
                "view_nrmse": (residual.norm() / views.norm()).item(),
                "seconds": time.perf_counter() - start,
                "cases": 1,
            }
        )

    method = RECONSTRUCTORS.get(run.method)
    if not run.iterations:
        volume = method(A, views)
        look(volume, 0, views - A(volume))
        return table
    volume = torch.zeros_like(truth)
    for stage, weight in enumerate(run.weights or (None,)):
        before = stage * run.iterations

        def monitor(iterate: Iterate, before: int = before) -> None:
            number = before + iterate.number
            if number in AT or number % 500 == 0:
                look(iterate.volume, number, iterate.residual)

        options = {} if weight is None else {"weight": weight}
        volume = method(
            A, views, iterations=run.iterations, start=volume, monitor=monitor, **options
        )
    return table
