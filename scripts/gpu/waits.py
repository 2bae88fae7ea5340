"""Where mvrecon would wait for a GPU, how many kernels it would start, and which devices would not
meet. Needs a build of torch with CUDA, but no GPU.

    python scripts/gpu/waits.py [--places]
"""

import argparse
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from as_gpu import AsGpu, OnGpu, launches, put, waits
from check import VECTORS
from measuring import reason

import mvrecon as mv
from mvrecon.config import compose
from mvrecon.engine.fit import build_module
from mvrecon.kernels.rays.cuda import selfcheck
from mvrecon.metrics import volume_metrics
from mvrecon.models import frusta
from mvrecon.projectors.selection import ray_subset, view_subset
from mvrecon.projectors.voxel_driven import backproject
from mvrecon.reconstruct.iterative import sirt_weights
from mvrecon.reconstruct.poisson import PoissonLikelihood
from mvrecon.visual_hull.support import support_from_views

N, PIXELS = 24, 36
DETECTOR = {"pixels": [PIXELS, PIXELS], "pixel_mm": 6.0}
MODELS = (
    "single_pass",
    "single_pass model.support=hull",
    "single_pass model.support=auto model.masked=false",
    "single_pass model.refine_where=disagreement",
    "single_pass model.sigma=0.1",
    "mean_fusion",
    "backprojection_unet",
    "backprojection_unet model.support=hull",
    "geometry_free",
    "sirt",
    "backprojection",
)


def pretend() -> None:
    """The compiled operators serve, as on a GPU that passes the self-check; and what needs a
    derivative, which these tensors do not have, says all bins.
    """
    selfcheck.reason = lambda *_: None

    def touched(self: Any, mask: torch.Tensor) -> torch.Tensor:
        launches["touched"] += 60
        shape = len(mask), len(self.slant), 1, *self.shape
        return OnGpu(torch.ones(shape, dtype=torch.bool))

    frusta.Frusta.touched = touched


def show(what: str, call: Callable[[], Any], places: bool) -> None:
    """Print the kernels and the waits of a call."""
    try:
        with torch.no_grad(), AsGpu():
            call()
    except Exception as error:
        stack = traceback.extract_tb(error.__traceback__)
        lines = [
            f"{f.filename.split('/mvrecon/')[-1]}:{f.lineno}"
            for f in stack
            if "/mvrecon/" in f.filename
        ]
        print(f"{what:55} FAILED {reason(error)[:160]} at {lines[-3:]}", flush=True)
        return
    print(f"{what:55} launches {launches.total():5d}  waits {waits.total():4d}", flush=True)
    for (place, why), count in waits.most_common() if places else ():
        print(f"      {count:3d}  {place}  {why}")


def body() -> torch.Tensor:
    """A box in a volume of zeros."""
    x = torch.zeros(1, 1, N, N, N)
    x[..., 6:14, 8:16, 7:15] = 1
    return x


def show_models(places: bool) -> None:
    """The loss of every model, without its gradient."""
    x, rig = body(), ["camera.views=4", f"camera.detector.pixels=[{PIXELS},{PIXELS}]"]
    rig += ["camera.detector.pixel_mm=6.0", f"grid.size=[{N},{N},{N}]"]
    batch = {"volume": OnGpu(x), "inside": OnGpu(x > 0.5)}
    for text in MODELS:
        model, *extra = text.split()
        settings = compose(f"model={model}", *rig, *extra)
        module = build_module(settings, settings["model"], 1.0).eval()
        with torch.no_grad():
            views = OnGpu(module.projector(x))
        put(module)
        show(
            text,
            lambda m=module, y=views: m.loss(m.model(y), {**batch, "views": y}),
            places,
        )
    show("figures of merit", lambda: figures(batch), places)


def figures(batch: Mapping[str, torch.Tensor]) -> dict[str, float]:
    """Of a volume that is a tenth too small."""
    true = batch["volume"][0]
    return volume_metrics(true * 0.9, true, batch["inside"][0], 1.0)


def operator_calls() -> dict[str, Callable[[], Any]]:
    """What is done with an operator."""
    grid, x = mv.Grid.centred(N, spacing=4.0), body()
    rig = mv.circular(6, 300.0, 450.0, DETECTOR)
    counts = torch.poisson(torch.full((1, 1, 6, PIXELS, PIXELS), 0.05))
    X, Y, C = OnGpu(x), OnGpu(torch.rand(1, 1, 6, PIXELS, PIXELS)), OnGpu(counts)
    A = put(mv.Drr(grid, rig))
    operators = {skip: put(mv.Drr(grid, rig, skip=skip)) for skip in ("off", "auto", "verify")}
    noise = {"sensitivity": torch.rand(6, 3, 3, 3), "tolerance": 1.0}
    parts = {
        "some rays": lambda: ray_subset(A, OnGpu(counts[0, 0] > 0)),
        "two views": lambda: view_subset(A, [0, 3]),
        "a support": lambda: A.with_support(OnGpu(x[0, 0] > 0)),
    }
    return {
        **{f"drr skip={skip} forward": partial(B, X) for skip, B in operators.items()},
        "drr adjoint": lambda: A.T(Y),
        **{f"{name}, there and back": lambda p=part: there(p(), X) for name, part in parts.items()},
        "sirt_weights": lambda: sirt_weights(A),
        "sirt, 10 iterations": lambda: mv.sirt(A, Y, 10),
        "mlem, 2 iterations": lambda: mv.mlem(A, C, 2, background=0.01),
        "osem, 2 iterations of 3 subsets": lambda: mv.mlem(A, C, 2, background=0.01, subsets=3),
        "Poisson likelihood": lambda: PoissonLikelihood(A, C, 0.01)(X),
        "voxel-driven back-projection": lambda: backproject(Y, rig, grid, "distance"),
        "visual hull": lambda: support_from_views(Y, rig, grid, "hull"),
        "hull of counts": lambda: support_from_views(C, rig, grid, "hull", noise, brick=8),
        "forward with poses in main memory": lambda: put(mv.Drr(grid, moved(rig, leaf)))(X),
        "cameras on the device": lambda: mv.Drr(grid, moved(rig, OnGpu)),
    }


def there(A: Any, x: torch.Tensor) -> torch.Tensor:
    """A^T A x."""
    return A.T(A(x))


def leaf(x: torch.Tensor) -> torch.Tensor:
    """A copy that wants a gradient."""
    return x.clone().requires_grad_()


def moved(rig: mv.Cameras, change: Callable[[torch.Tensor], torch.Tensor]) -> mv.Cameras:
    """A rig with other tensors."""
    return replace(rig, **{name: change(getattr(rig, name)) for name in VECTORS})


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", action="store_true", help="each wait, by file and line")
    places = parser.parse_args().places
    if torch.version.cuda is None:
        sys.exit(f"waits.py needs a build of torch with CUDA, got torch {torch.__version__}")
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    pretend()
    show_models(places)
    for what, call in operator_calls().items():
        show(what, call, places)


if __name__ == "__main__":
    main()
