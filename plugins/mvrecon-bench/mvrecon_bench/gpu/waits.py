"""Report synchronisations, kernel launches and device mismatches of mvrecon on an emulated GPU.
Requires no GPU.

    python -m mvrecon_bench.gpu.waits [--places] [--operators]
"""

import argparse
import traceback
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

import mvrecon as mv
from mvrecon.apps.config import compose
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.sirt import sirt_weights
from mvrecon.operators.selection import ray_subset, view_subset
from mvrecon.operators.visual_hull.support import support_from_views
from mvrecon.operators.voxel_driven import backproject
from mvrecon.report.metrics import volume_metrics
from mvrecon.training.fit import build_module
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.benchmarks.trial import reason
from mvrecon_bench.gpu.as_gpu import AsGpu, OnGpu
from mvrecon_bench.gpu.check import VECTORS
from mvrecon_spect.operators.projector import Spect

N, PIXELS = 24, 36
DETECTOR = {"pixels": [PIXELS, PIXELS], "pixel_mm": 6.0}
PINHOLES = "pinholes with blur and attenuation, there and back"
METHODS = (
    "cross_view",
    "cross_view method.support=hull",
    "cross_view method.support=auto method.crop=true",
    "uncertain",
    "mean_fusion",
    "world_unet",
    "world_unet method.support=hull",
    "geometry_free",
    "sirt",
    "backprojection",
)


def show(what: str, call: Callable[[AsGpu], Any], places: bool) -> None:
    """Print the launches and synchronisations of a call."""
    try:
        with AsGpu() as gpu:
            call(gpu)
    except Exception as error:
        stack = traceback.extract_tb(error.__traceback__)
        lines = [
            f"{f.filename.split('/mvrecon/')[-1]}:{f.lineno}"
            for f in stack
            if "/mvrecon/" in f.filename
        ]
        print(f"{what:55} FAILED {reason(error)[:160]} at {lines[-3:]}", flush=True)
        return
    counts = f"launches {gpu.launches.total():5d}  waits {gpu.waits.total():4d}"
    print(f"{what:55} {counts}", flush=True)
    for (place, why), count in gpu.waits.most_common() if places else ():
        print(f"      {count:3d}  {place}  {why}")


def body() -> torch.Tensor:
    """A box in a volume of zeros."""
    x = torch.zeros(1, 1, N, N, N)
    x[..., 6:14, 8:16, 7:15] = 1
    return x


def show_methods(places: bool) -> None:
    """A training step of every method, or a forward pass of one without weights."""
    x, rig = body(), ["camera.n_views=4", f"camera.detector.pixels=[{PIXELS},{PIXELS}]"]
    rig += ["camera.detector.pixel_mm=6.0", f"grid.size=[{N},{N},{N}]"]
    for text in METHODS:
        method, *extra = text.split()
        settings = TrainSettings(**compose(f"method={method}", *rig, *extra))
        module = build_module(settings, settings.method, 1.0)
        with torch.no_grad():
            batch = {"volume": x, "inside": x > 0.5, "views": module.projector(x)}

        def step(gpu: AsGpu, module: Any = module, batch: Any = batch) -> None:
            gpu.put(module)
            total = module.terms({name: OnGpu(value) for name, value in batch.items()})["total"]
            if total.requires_grad:
                total.backward()

        show(text, step, places)
    show("figures of merit", figures, places)


def figures(gpu: AsGpu) -> dict[str, float]:
    """Metrics of a volume that is 10 % too small."""
    true = OnGpu(body()[0])
    return volume_metrics(true * 0.9, true, true > 0.5, 1.0)


def operator_calls() -> dict[str, Callable[[Any], Any]]:
    """Calls of operators on the device."""
    grid, x = mv.Grid.centred(N, spacing=4.0), body()
    rig = mv.circular(6, 300.0, 450.0, DETECTOR)
    counts = torch.poisson(torch.full((1, 1, 6, PIXELS, PIXELS), 0.05))
    X, Y, C = OnGpu(x), OnGpu(torch.rand(1, 1, 6, PIXELS, PIXELS)), OnGpu(counts)
    parts = {
        "some rays": lambda A: ray_subset(A, OnGpu(counts[0, 0] > 0)),
        "two views": lambda A: view_subset(A, [0, 3]),
        "a support": lambda A: A.with_support(OnGpu(x[0, 0] > 0)),
    }
    return {
        "drr forward": lambda A: A(X),
        "drr adjoint": lambda A: A.T(Y),
        **{
            f"{name}, there and back": lambda A, p=part: there(p(A), X)
            for name, part in parts.items()
        },
        "sirt_weights": sirt_weights,
        "sirt, 10 iterations": lambda A: mv.sirt(A, Y, 10),
        "mlem, 2 iterations": lambda A: mv.mlem(A, C, 2, background=0.01),
        "osem, 2 iterations of 3 subsets": lambda A: mv.mlem(A, C, 2, background=0.01, subsets=3),
        "Poisson likelihood": lambda A: PoissonLikelihood(A, C, 0.01)(X),
        "voxel-driven back-projection": lambda A: backproject(Y, rig, grid, "distance"),
        "visual hull": lambda A: support_from_views(Y, rig, grid, "hull"),
        PINHOLES: lambda A: there(A, X),
        "cameras on the device": lambda A: mv.Drr(grid, moved(rig, OnGpu)),
    }


def operator(what: str) -> Any:
    """The operator used in a call."""
    grid = mv.Grid.centred(N, spacing=4.0)
    if what == PINHOLES:  # in water at 140 keV
        return Spect(
            grid, mv.dcspect80(pixels=PIXELS, rows=[0], columns=[0, 7]), mu=0.0154, blur=True
        )
    return mv.Drr(grid, mv.circular(6, 300.0, 450.0, DETECTOR))


def there(A: Any, x: torch.Tensor) -> torch.Tensor:
    """A^T A x."""
    return A.T(A(x))


def moved(rig: mv.Cameras, change: Callable[[torch.Tensor], torch.Tensor]) -> mv.Cameras:
    """A rig with replaced tensors."""
    vectors: dict[str, Any] = {name: change(getattr(rig, name)) for name in VECTORS}
    return replace(rig, **vectors)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", action="store_true", help="each wait, by file and line")
    parser.add_argument("--operators", action="store_true", help="no methods")
    places = parser.parse_args().places
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    for what, call in operator_calls().items():
        A = operator(what)
        show(what, lambda gpu, call=call, A=A: call(gpu.put(A)), places)
    if not parser.parse_args().operators:
        show_methods(places)


if __name__ == "__main__":
    main()
