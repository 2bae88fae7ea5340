"""Check the GPU back end: hardware, self-check, agreement with the CPU, and synchronisations. Takes
about 2 minutes.

    python -m mvrecon_bench.gpu.check --out FOLDER [--device cuda] [--n 48]
"""

import argparse
import math
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

import mvrecon as mv
from mvrecon.core.parts import PROJECTORS
from mvrecon.operators.ray_transform import RAY_METHODS, RayTransform
from mvrecon_bench.gpu.fields import check_fields
from mvrecon_bench.gpu.measuring import Results, on_device, throughput

PACKAGES = ("torch", "triton", "numpy", "numba", "llvmlite", "lightning", "kornia")
SKIPS = ("off", "auto", "box")
VECTORS = ("source", "origin", "u", "v")
#: The result of the self-check is permanent: a first call in one of these modes must not make it
#: fail.
FIRST_CALLS = {
    "inference_mode": ("torch.inference_mode()", "A(x)"),
    "bfloat16 autocast": ("torch.autocast(device, torch.bfloat16)", "A(x)"),
    "vmap": ("torch.no_grad()", "torch.func.vmap(A)(x[None])"),
}
FIRST_CALL = """
import torch
import mvrecon as mv
device = "DEVICE"
rig = mv.circular(2, 50.0, 75.0, {"pixels": [8, 8], "pixel_mm": 2.0})
A = mv.Drr(mv.Grid.centred(8, spacing=1.0), rig).to(device)
x = torch.rand(2, 1, 8, 8, 8, device=device)
with MODE:
    CALL
print(A.last_backend)
"""


def versions() -> dict[str, str]:
    """Versions of the software below the back end."""
    known = {name: "not installed" for name in PACKAGES}
    for name in PACKAGES:
        try:
            known[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return known


def machine() -> dict[str, Any]:
    """The GPU and its peak performance."""
    p = torch.cuda.get_device_properties(0)
    x = torch.rand(min(2**28, p.total_memory // 64), device="cuda")
    y = torch.empty_like(x)
    copy, _ = throughput(lambda: y.copy_(x), "cuda")
    _, small = throughput(lambda: y[:4].add_(1), "cuda", 0.02)
    return {
        "name": p.name,
        "capability": f"{p.major}.{p.minor}",
        "multiprocessors": p.multi_processor_count,
        "memory GB": p.total_memory / 2**30,
        "copy TB/s": 2 * x.numel() * 4 / copy / 1e9,
        "one small operation, us": 1e3 * small,
    }


def self_checks(results: Results) -> None:
    """The self-tests of the back end."""
    from mvrecon.kernels import self_test
    from mvrecon.kernels.rays import ops

    for method in RAY_METHODS:
        for dtype in (torch.float32, torch.float64, torch.bfloat16):
            for volumes in (1, 5):
                what = f"self-test {method} {dtype} {volumes}"
                purpose = method + (ops.SEVERAL if volumes > 1 else "")
                start = time.perf_counter()
                results.attempt(
                    what,
                    lambda p=purpose, d=dtype: (
                        self_test.failure("cuda", p, d, ops.self_test) or "right"
                    ),
                )
                results.add(f"{what} seconds", round(time.perf_counter() - start, 2))


def rigs(n: int) -> dict[str, mv.Cameras]:
    """A cone beam, a parallel beam, and cameras in all directions."""
    detector = {"pixels": [n, n + 5], "pixel_mm": 1.7}
    return {
        "cone": mv.circular(7, 200.0, 300.0, detector, start_degrees=3.0),
        "parallel": mv.parallel(6, {**detector, "pixel_mm": 1.1}, start_degrees=3.0),
        "dome": mv.dome(7, 150.0, 60.0, 140.0, {**detector, "pixel_mm": 1.2}),
    }


def build(grid: mv.Grid, rig: mv.Cameras, **options: Any) -> RayTransform:
    """The projector for a rig."""
    kind = "radon" if rig.parallel else "drr"
    return PROJECTORS.build(kind, grid=grid, cameras=rig, **options)


def agreement(
    grid: mv.Grid, rig: mv.Cameras, x: torch.Tensor, y: torch.Tensor, method: str, device: str
) -> dict[str, Any]:
    """Maximum differences from the CPU relative to the maximum value, and the difference of both
    inner products.
    """
    C = build(grid, rig, method=method)
    views, volume = C(x), C.T(y)
    errors: dict[str, Any] = {}
    for skip in SKIPS:
        A = build(grid, rig, method=method, skip=skip).to(device)
        Ax, Aty = A(x.to(device)).cpu(), A.T(y.to(device)).cpu()
        gap = (Ax * y).double().sum() - (x * Aty).double().sum()
        errors[f"forward {skip}"] = float((Ax - views).abs().max() / views.abs().max())
        errors[f"adjoint {skip}"] = float((Aty - volume).abs().max() / volume.abs().max())
        errors[f"matched {skip}"] = float(gap.abs() / (Ax.double().norm() * y.double().norm()))
        errors["backend"] = A.last_backend
    return errors


def pose_gradient(
    grid: mv.Grid, rig: mv.Cameras, x: torch.Tensor, y: torch.Tensor, device: str
) -> dict[str, float]:
    """Relative difference of the camera gradients from the CPU's."""
    gradients = []
    for place in ("cpu", device):
        leaves = {name: getattr(rig, name).clone().requires_grad_() for name in VECTORS}
        A = build(grid, replace(rig, **leaves)).to(place)
        by = torch.autograd.grad(A(x.to(place)), list(leaves.values()), y.to(place))
        gradients.append(torch.cat([g.flatten().cpu() for g in by]))
    exact, other = gradients
    return {"relative": float((exact - other).norm() / exact.norm())}


def first_call(name: str, device: str) -> str:
    """The back end used by a new process whose first call is made in a mode."""
    mode, call = FIRST_CALLS[name]
    code = FIRST_CALL.replace("MODE", mode).replace("CALL", call).replace("DEVICE", device)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=90, check=False
    )
    return done.stdout.strip() or done.stderr.strip()[-300:]


def waits(call: Callable[[], Any]) -> dict[str, Any]:
    """Positions at which the host synchronises with the device, according to torch."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    places = Counter(
        f"{w.filename.split('/mvrecon/')[-1]}:{w.lineno}"
        for w in caught
        if "synchroniz" in str(w.message)
    )
    return {"waits": places.total(), "places": dict(places)}


def graph(A: RayTransform, x: torch.Tensor) -> dict[str, Any]:
    """A^T A x in a CUDA graph."""
    side = torch.cuda.Stream()
    with torch.no_grad(), torch.cuda.stream(side):
        for _ in range(3):
            expected = A.T(A(x))
    torch.cuda.synchronize()
    recorded = torch.cuda.CUDAGraph()
    with torch.no_grad(), torch.cuda.graph(recorded):
        result = A.T(A(x))
    result.zero_()
    recorded.replay()
    torch.cuda.synchronize()
    return {
        "same": bool(torch.allclose(result, expected, rtol=1e-4)),
        "replay ms": throughput(recorded.replay, "cuda")[0],
        "calls ms": throughput(lambda: A.T(A(x)), "cuda")[0],
    }


def stream(A: RayTransform, x: torch.Tensor) -> bool:
    """Whether the kernels run on torch's current stream instead of the default one."""
    side, expected = torch.cuda.Stream(), A(x)
    torch.cuda.synchronize()
    edge = min(6000, math.isqrt(torch.cuda.get_device_properties(0).total_memory >> 10))
    busy = torch.rand(edge, edge, device="cuda")
    with torch.cuda.stream(side):
        for _ in range(20):
            busy = busy @ busy * 1e-4
        result = A(x + 0 * busy[0, 0])
    side.synchronize()
    return bool(torch.equal(result, expected))


def device_alone(results: Results, A: RayTransform, B: RayTransform, x: torch.Tensor) -> None:
    """Checks that require a GPU, for an operator A with skipping and an operator B without."""
    y = torch.rand_like(A(x))
    results.attempt("waits of a forward", lambda: waits(lambda: A(x)))
    results.attempt("waits of an adjoint", lambda: waits(lambda: A.T(y)))
    results.attempt("host us of a forward", lambda: 1e3 * throughput(lambda: A(x), "cuda")[1])
    results.attempt("the same, skip=off", lambda: 1e3 * throughput(lambda: B(x), "cuda")[1])
    results.attempt("host us of an adjoint", lambda: 1e3 * throughput(lambda: A.T(y), "cuda")[1])
    results.attempt("CUDA graph", lambda: graph(B, x))
    results.attempt("on the current stream", lambda: stream(A, x))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--n", type=int, default=48)
    parser.add_argument("--modes", nargs="*", default=[*FIRST_CALLS], help="of first calls")
    options = parser.parse_args()
    device, n = on_device(options.device), options.n
    results = Results(options.out, "check")
    results.attempt("versions", versions)
    if device == "cuda":
        results.attempt("machine", machine)
        self_checks(results)
    grid = mv.Grid.centred(size=(n - 2, n + 3, n), spacing=(1.0, 1.1, 0.9))
    rng = torch.Generator().manual_seed(0)
    x = torch.rand(2, 1, *grid.shape, generator=rng)
    x[..., : n // 3, :, :] = 0  # zeros to skip
    for name, rig in rigs(n).items():
        y = torch.rand(2, 1, len(rig), *rig.shape, generator=rng)
        for method in RAY_METHODS:
            found = results.attempt(
                f"agrees {name} {method}",
                lambda r=rig, y=y, m=method: agreement(grid, r, x, y, m, device),
            )
            results.row(rig=name, method=method, **(found or {}))
        results.attempt(
            f"pose gradient {name}", lambda r=rig, y=y: pose_gradient(grid, r, x, y, device)
        )
    cone = rigs(n)["cone"]
    check_fields(results, grid, cone, x, build(grid, cone)(x), device)
    for name in options.modes:  # not supported by the emulated GPU
        place = "cpu" if options.device == "dry" else device
        results.attempt(f"first call in {name}", lambda n=name, p=place: first_call(n, p))
    if device == "cuda":
        A, B = (build(grid, cone, skip=skip).to(device) for skip in ("auto", "off"))
        device_alone(results, A, B, x.to(device))


if __name__ == "__main__":
    main()
