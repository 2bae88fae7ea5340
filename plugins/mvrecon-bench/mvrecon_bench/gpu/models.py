"""Check whether the methods run on a GPU, their precision and their synchronisations. Takes about a
minute.

python -m mvrecon_bench.gpu.models --out FOLDER [--device cuda] [--n 24]
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from mvrecon.apps.config import compose
from mvrecon.training.fit import build_module
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.gpu.check import waits
from mvrecon_bench.gpu.measuring import Results, latency, on_device, wait

METHODS = (
    *("cross_view", "mean_fusion", "world_unet", "geometry_free", "uncertain"),
    *("sirt", "backprojection"),
)
#: Options of the cross-view model.
VARIANTS = ("method.support=hull", "method.support=box method.crop=true")


def built(method: str, n: int, device: str, extra: Sequence[str] = ()) -> ReconstructionModule:
    """A method with initial weights, and 5 cameras with a small detector in all directions."""
    pixels = 3 * n // 2
    settings = TrainSettings(
        **compose(
            f"method={method}",
            f"grid.size=[{n},{n},{n}]",
            "camera.n_views=5",
            "camera.arc_degrees=360",
            f"camera.detector.pixels=[{pixels},{pixels}]",
            "camera.detector.pixel_mm=6.0",
            *extra,
        )
    )
    return build_module(settings, settings.method, 1.0).to(device)


def box(n: int, device: str) -> torch.Tensor:
    """Volumes of an off-centre box."""
    volume = torch.zeros(2, 1, n, n, n, device=device)
    volume[..., n // 4 : n // 2, n // 3 : 2 * n // 3, n // 4 : n // 2] = 1
    return volume


def learns(method: str, n: int, device: str) -> dict[str, Any]:
    """Loss and gradient in both precisions, synchronisations and milliseconds of a
    reconstruction.
    """
    module, volume = built(method, n, device), box(n, device)
    views = module.projector(volume)
    batch = {"views": views, "volume": volume, "inside": volume > 0.5}
    result: dict[str, Any] = {}
    for precision in ("float32", "bfloat16"):
        with torch.autocast(device, torch.bfloat16, enabled=precision == "bfloat16"):
            loss = module.terms(batch)["total"]
        result[precision] = float(loss.detach())
        if loss.requires_grad:
            loss.backward()
            norms = [p.grad.float().norm() for p in module.parameters() if p.grad is not None]
            result[f"{precision} gradient"] = float(torch.stack(norms).norm())
            module.zero_grad()
    with torch.no_grad():
        if device == "cuda":
            result |= waits(lambda: module(views))
        result["ms"] = latency(lambda: module(views), device, 3)
    return result


def skips(extra: str, n: int, device: str) -> dict[str, Any]:
    """Milliseconds and synchronisations of the cross-view model with a support or a crop."""
    module = built("cross_view", n, device, extra.split()).eval()
    with torch.no_grad():
        views = module.projector(box(n, device))
        result: dict[str, Any] = {"ms": latency(lambda: module(views), device, 3)}
        if device == "cuda":
            result["waits"] = waits(lambda: module(views))["waits"]
    return result


def compiled(n: int, device: str) -> dict[str, Any]:
    """`torch.compile` of a network: seconds of the first call, its difference, its milliseconds."""
    module = built("world_unet", n, device)
    views = torch.rand(1, 1, *module.projector.range_shape, device=device)
    with torch.no_grad():
        expected = module(views).volume
        start = time.perf_counter()
        module.method.compile()
        result = module(views).volume
        wait(device)
        seconds = time.perf_counter() - start
        difference = (result - expected).abs().max() / expected.abs().max()
        ms = latency(lambda: module(views), device, 3)
    return {"first_s": seconds, "difference": float(difference), "ms": ms}


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--n", type=int, default=24)
    parser.add_argument("--methods", nargs="*", default=METHODS)
    parser.add_argument("--variants", nargs="*", default=VARIANTS, help="of cross_view")
    options = parser.parse_args()
    device, n = on_device(options.device), options.n
    results = Results(options.out, "models")
    for method in options.methods:
        results.attempt(method, lambda m=method: learns(m, n, device))
    for extra in options.variants:
        results.attempt(f"cross_view {extra}", lambda e=extra: skips(e, n, device))
    if device == "cuda":
        results.attempt("torch.compile of world_unet", lambda: compiled(n, device))


if __name__ == "__main__":
    main()
