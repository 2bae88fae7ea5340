"""`bench=emission`: processor time of an MLEM iteration for pinhole SPECT, with attenuation, blur
and both by footprints, and by thin rays where these suffice.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_bench.benchmarks.columns import EMISSION
from mvrecon_bench.measure import interleaved, load_average, once, threads
from mvrecon_bench.rows import Bench, Job, Row
from mvrecon_spect.operators.footprints import pixel_in_voxels

#: Attenuation of water at 140.5 keV in 1/mm; radius of the body along x and z, as a fraction of the
#: grid's width.
WATER, BODY = 0.01536, 0.44


class Model(NamedTuple):
    """Effects modelled by a projector."""

    name: str
    attenuated: bool = False
    blur: bool = False
    method: str = "footprints"


PLAIN, THIN = Model("plain"), Model("plain", method="joseph")
MODELS = (PLAIN, Model("attenuated", True), Model("blur", blur=True), Model("both", True, True))


class Emission(Bench):
    """An MLEM iteration with each model of `spect`, timed alternately so that ratios are from one
    run.

    Args:
        n: voxels along each edge of the grid.
        spacing: voxel spacing in mm.
        pixels: pixels along each edge of the 80 detectors.
        repeats: repetitions per model; times are medians.
    """

    columns = EMISSION
    keys = ("model", "method", "n", "pixels")
    charts = ("cpu_s", "over_plain")
    title, shown = "An iteration of MLEM behind pinholes", dict.fromkeys(charts, ".3g")

    def __init__(self, n: int = 64, spacing: float = 4.0, pixels: int = 64, repeats: int = 5):
        self.grid, self.rig = Grid.centred(n, spacing=spacing), dcspect80(pixels=pixels)
        self.sizes, self.repeats = {"n": n, "pixels": pixels}, repeats

    def groups(self) -> list[list[Job]]:
        """Models that are measured together; thin rays only of pixels up to a voxel's image."""
        fine = pixel_in_voxels(self.rig, self.grid) <= 1
        models = [*MODELS, *[THIN] * fine]
        rows = ({"model": one.name, "method": one.method, **self.sizes} for one in models)
        return [[Job(*pair) for pair in zip(rows, models, strict=True)]]

    def label(self, row: Row) -> str:
        return f"{row['model']}, {row['method']}"

    def measure(self, jobs: Sequence[Job], say: Callable[[str], None]) -> Iterator[Row]:
        """Yield the rows of models after timing them alternately with the plain one."""
        away = voxel_centres(self.grid)[..., :2].norm(dim=-1)
        inside = (away < BODY * self.grid.size[0] * self.grid.spacing[0]).float()
        x = torch.rand(self.grid.shape, generator=torch.Generator().manual_seed(0)) * inside
        calls, seconds = {}, {}
        with threads(1):
            for model in dict.fromkeys([PLAIN, *(job.subject for job in jobs)]):
                say(f"{model.name}, {model.method}")
                A = self._operator(model, inside)
                calls[model] = lambda A=A: step(A, x[None, None])
                seconds[model] = once(calls[model], "cpu")[1]  # compiles
            times = interleaved(calls, seconds, self.repeats, "cpu", time.process_time)
        for job in jobs:
            cpu_s, plain = times[job.subject].ms / 1e3, times[PLAIN].ms / 1e3
            ratio = {"cpu_s": cpu_s, "over_plain": cpu_s / plain}
            yield {**job.row, **ratio, "load": load_average(), "status": "ok"}

    def _operator(self, model: Model, inside: torch.Tensor) -> Any:
        options = {"mu": WATER * inside if model.attenuated else None, "blur": model.blur}
        options |= {"grid": self.grid, "cameras": self.rig, "method": model.method}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about corners behind a pinhole
            return PROJECTORS.build("spect", **options)


def step(A: Any, x: torch.Tensor) -> torch.Tensor:
    """x A^T (y / A x), an MLEM iteration with known sensitivity."""
    expected = A(x)
    return x * A.T(1 / expected.clamp_min(1e-6))
