"""`bench=emission`: processor time of an MLEM iteration for pinhole SPECT, with attenuation, blur
and both by footprints, and by thin rays where these suffice.
"""

import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_bench.benchmarks import report
from mvrecon_bench.benchmarks.columns import EMISSION, EMISSION_KEYS
from mvrecon_bench.benchmarks.measure import load_average, threads
from mvrecon_bench.benchmarks.rows import Job, Row, number
from mvrecon_spect.operators.footprints import pixel_in_voxels

#: Attenuation of water at 140.5 keV in 1/mm; radius of the body along x and z, as a fraction of the
#: grid's width.
WATER, BODY = 0.01536, 0.44


@dataclass(frozen=True)
class Model:
    """Effects modelled by a projector, and its voxels and pixels along an edge."""

    n: int
    pixels: int
    attenuated: bool = False
    blur: bool = False
    method: str = "footprints"

    @property
    def job(self) -> Job["Model"]:
        """The job of measuring it."""
        names = {(False, False): "plain", (True, False): "attenuated", (False, True): "blur"}
        name = names.get((self.attenuated, self.blur), "both")
        own = {"model": name, "method": self.method}
        return Job(own | {"n": self.n, "pixels": self.pixels}, self)


class Emission:
    """An MLEM iteration with each model of `spect`, timed alternately so that ratios are from one
    run.

    Args:
        n: voxels along each edge of the grid.
        spacing: voxel spacing in mm.
        pixels: pixels along each edge of the 80 detectors.
        repeats: repetitions per model; times are medians.
    """

    columns: Mapping[str, str] = EMISSION
    keys: Sequence[str] = EMISSION_KEYS
    charts: Sequence[str] = ("cpu_s", "over_plain")

    def __init__(
        self,
        n: int = 64,
        spacing: float = 4.0,
        pixels: int = 64,
        repeats: int = 5,
    ):
        self.grid, self.rig = Grid.centred(n, spacing=spacing), dcspect80(pixels=pixels)
        self.repeats = repeats

    def groups(self) -> list[list[Job[Model]]]:
        """Models that are measured together; thin rays only of pixels up to a voxel's image."""
        kinds = [(False, False), (True, False), (False, True), (True, True)]
        models = [Model(self.grid.shape[0], self.rig.shape[0], *kind) for kind in kinds]
        fine = pixel_in_voxels(self.rig, self.grid) <= 1
        models += [replace(models[0], method="joseph")] * fine
        return [[model.job for model in models]]

    def label(self, row: Row) -> str:
        """Short label of a row's model and method."""
        return f"{row['model']}, {row['method']}"

    def measure(
        self, jobs: Sequence[Job[Model]], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """Yield the rows of models after timing them alternately with the plain one."""
        places = voxel_centres(self.grid)
        inside = places[..., :2].norm(dim=-1) < BODY * self.grid.size[0] * self.grid.spacing[0]
        x = torch.rand(self.grid.shape, generator=torch.Generator().manual_seed(0)) * inside
        calls: dict[Model, Any] = {}
        models = [job.subject for job in jobs]
        taken: dict[Model, list[float]] = {
            model: [] for model in [self.groups()[0][0].subject, *models]
        }
        for model in taken:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # about corners behind a pinhole
                calls[model] = PROJECTORS.build(
                    "spect",
                    grid=self.grid,
                    cameras=self.rig,
                    mu=WATER * inside.float() if model.attenuated else None,
                    blur=model.blur,
                    method=model.method,
                )
        with threads(1):
            for turn in range(self.repeats + 1):  # the first compiles
                for model, A in calls.items():
                    say(self.label(model.job.row))
                    start = time.process_time()
                    step(A, x[None, None].float())
                    if turn:
                        taken[model].append(time.process_time() - start)
        seconds = {model: statistics.median(times) for model, times in taken.items()}
        for model in models:
            plain = Model(model.n, model.pixels)
            yield {
                **model.job.row,
                "cpu_s": seconds[model],
                "over_plain": seconds[model] / seconds[plain],
                "load": load_average(),
                "status": "ok",
            }

    def report(self, rows: Sequence[Row], folder: Path) -> dict[str, str]:
        """The table by name."""
        names = ("cpu_s", "over_plain")
        lines = [(self.label(row), *(f"{number(row, name):.3g}" for name in names)) for row in rows]
        text = (
            f"# An iteration of MLEM behind pinholes\n\n{report.markdown(('model', *names), lines)}"
        )
        return {"table": text + report.legend(self.columns)}


def step(A: Any, x: torch.Tensor) -> torch.Tensor:
    """x A^T (y / A x), an MLEM iteration with known sensitivity."""
    expected = A(x)
    return x * A.T(1 / expected.clamp_min(1e-6))
