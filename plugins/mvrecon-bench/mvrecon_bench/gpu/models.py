"""Check whether the methods run on a GPU, their precision and their synchronisations. Takes about a
minute.

python -m mvrecon_bench.gpu.models --out FOLDER [--device cuda] [--n 24]
"""

from collections.abc import Sequence
from typing import Any

import torch

from mvrecon.apps.config import compose
from mvrecon.training.fit import build_module
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.gpu.check import waits
from mvrecon_bench.gpu.measuring import Results, on_device, options_of
from mvrecon_bench.measure import latency, once

METHODS = [
    *("cross_view", "mean_fusion", "world_unet", "geometry_free", "uncertain"),
    *("sirt", "backprojection"),
]
#: Options of the cross-view model.
VARIANTS = ["method.support=hull", "method.support=box method.crop=true"]


def built(method: str, n: int, device: str, extra: Sequence[str] = ()) -> ReconstructionModule:
    """A method with initial weights, and 5 cameras with a small detector in all directions."""
    pixels = 3 * n // 2
    detector = (f"pixels=[{pixels},{pixels}]", "pixel_mm=6.0")
    rig = ("n_views=5", "arc_degrees=360", *(f"detector.{option}" for option in detector))
    cameras = [f"camera.{option}" for option in rig]
    chosen = (f"method={method}", f"grid.size=[{n},{n},{n}]", *cameras, *extra)
    settings = TrainSettings(**compose(*chosen))
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
        result["ms"] = latency(lambda: module(views), device)
    return result


def skips(extra: str, n: int, device: str) -> dict[str, Any]:
    """Milliseconds and synchronisations of the cross-view model with a support or a crop."""
    module = built("cross_view", n, device, extra.split()).eval()
    with torch.no_grad():
        views = module.projector(box(n, device))
        result: dict[str, Any] = {"ms": latency(lambda: module(views), device)}
        if device == "cuda":
            result["waits"] = waits(lambda: module(views))["waits"]
    return result


def compiled(n: int, device: str) -> dict[str, Any]:
    """`torch.compile` of a network: seconds of the first call, its difference, its milliseconds."""
    module = built("world_unet", n, device)
    views = torch.rand(1, 1, *module.projector.range_shape, device=device)
    with torch.no_grad():
        expected = module(views).volume
        module.method.compile()
        result, seconds = once(lambda: module(views).volume, device)
        difference = (result - expected).abs().max() / expected.abs().max()
        ms = latency(lambda: module(views), device)
    return {"first_s": seconds, "difference": float(difference), "ms": ms}


def main() -> None:
    """Entry point."""
    options = options_of(__doc__, n=24, methods=METHODS, variants=VARIANTS)
    device, n = on_device(options.device), options.n
    results = Results(options.out, "models")
    for method in options.methods:
        results.attempt(method, learns, method, n, device)
    for extra in options.variants:
        results.attempt(f"cross_view {extra}", skips, extra, n, device)
    if device == "cuda":
        results.attempt("torch.compile of world_unet", compiled, n, device)


if __name__ == "__main__":
    main()
