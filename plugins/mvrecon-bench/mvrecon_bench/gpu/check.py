"""Check the GPU back end: hardware, self-check, agreement with the CPU, and synchronisations. Takes
about 2 minutes.

    python -m mvrecon_bench.gpu.check --out FOLDER [--device cuda] [--n 48]
"""

import math
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import VECTORS
from mvrecon.geometry.lattice import depth_edges, grid_lattice, lattice_maps
from mvrecon.kernels import self_test, voxels, warps
from mvrecon.kernels.rays import ops
from mvrecon.kernels.warps import warp
from mvrecon.methods.learned.view_frames import frusta_lattice
from mvrecon.operators.ray_transform import RAY_METHODS, RayTransform
from mvrecon.operators.visual_hull.hull import visual_hull
from mvrecon.operators.voxel_driven import backproject
from mvrecon.testing.measures import inner_product_gap
from mvrecon.training.run_folder import versions
from mvrecon_bench.gpu.measuring import Results, on_device, options_of
from mvrecon_bench.measure import throughput
from mvrecon_bench.stresses.fresh_process import python
from mvrecon_spect.operators import footprints
from mvrecon_spect.operators.projector import Spect

SKIPS = ("off", "auto", "box")
#: Linear attenuation in 1/mm before pinholes; voxels along an edge of the hull's bricks.
MU, BRICK = 0.015, 4
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


def machine() -> dict[str, Any]:
    """The GPU and its peak performance."""
    p = torch.cuda.get_device_properties(0)
    x = torch.rand(min(2**28, p.total_memory // 64), device="cuda")
    y = torch.empty_like(x)
    copy, _ = throughput(lambda: y.copy_(x), "cuda")
    _, small = throughput(lambda: y[:4].add_(1), "cuda")
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

    def passes(purpose: str, dtype: torch.dtype, tests: Any) -> str:
        return self_test.failure("cuda", purpose, dtype, tests) or "right"

    for method in RAY_METHODS:
        for dtype in (torch.float32, torch.float64, torch.bfloat16):
            for volumes, kind in ((1, ""), (5, ops.SEVERAL)):
                what, start = f"self-test {method} {dtype} {volumes}", time.perf_counter()
                results.attempt(what, passes, method + kind, dtype, ops.self_test)
                results.add(f"{what} seconds", round(time.perf_counter() - start, 2))
    purposes = {"warp": warps, "voxel_driven": voxels, "footprints": footprints}
    for purpose, module in purposes.items():
        for dtype in (torch.float32, torch.float64):
            what = f"self-check {purpose} {dtype}"
            results.attempt(what, passes, purpose, dtype, module.self_test)


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


def apart(result: Tensor, expected: Tensor) -> float:
    """Maximum difference relative to the maximum value."""
    return float((result.cpu() - expected).abs().max() / expected.abs().max())


def agreement(
    grid: mv.Grid, rig: mv.Cameras, x: Tensor, y: Tensor, method: str, device: str
) -> dict[str, Any]:
    """Maximum differences from the CPU, and the difference of both inner products."""
    C = build(grid, rig, method=method)
    views, volume, errors = C(x), C.T(y), {}
    for skip in SKIPS:
        A = build(grid, rig, method=method, skip=skip).to(device)
        Ax, Aty = A(x.to(device)).cpu(), A.T(y.to(device)).cpu()
        errors |= {f"forward {skip}": apart(Ax, views), f"adjoint {skip}": apart(Aty, volume)}
        errors |= {f"matched {skip}": inner_product_gap(x, Ax, y, Aty), "backend": A.last_backend}
    return errors


def pose_gradient(
    grid: mv.Grid, rig: mv.Cameras, x: Tensor, y: Tensor, device: str
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


def field(call: Callable[[Tensor], Tensor], x: Tensor, device: str) -> dict[str, Any]:
    """Maximum differences of a value and its gradient from the CPU's, and ms of the value on the
    device.
    """
    found = []
    for place in ("cpu", device):
        leaf = x.to(place).requires_grad_()
        value = call(leaf)
        (gradient,) = torch.autograd.grad(value.square().sum(), leaf)
        found.append((value.detach().cpu(), gradient.cpu()))
    value, gradient = (apart(other, exact) for exact, other in zip(*found, strict=True))
    with torch.no_grad():
        there = x.to(device)
        ms, _ = throughput(lambda: call(there), device)
    return {"value": value, "gradient": gradient, "ms": ms}


def fields(
    results: Results, grid: mv.Grid, rig: mv.Cameras, x: Tensor, views: Tensor, device: str
) -> None:
    """Agreement of operators other than plain rays: footprints behind pinholes, warps between grid
    and frusta, voxel-driven back-projection, hull.

    Args:
        results: output.
        grid, rig: grid and rig of a cone beam.
        x: volumes [b 1 d h w].
        views: views of that rig, [b 1 m v u], with zeros outside the object.
        device: device of the kernels.
    """
    frusta = frusta_lattice(rig, grid, depth_edges(rig.depth_range(grid), 16))
    lattices, operators = (grid_lattice(grid), frusta), {}
    there, back = lattice_maps(*lattices), lattice_maps(*lattices[::-1])

    def world(x: Tensor) -> Tensor:
        return warp(x, there.to(x.device), frusta.shape)

    def volumes(x: Tensor) -> Tensor:
        return warp(x, back.to(x.device), lattices[0].shape)

    def pinholes(x: Tensor) -> Tensor:
        if x.device not in operators:
            near = mv.Grid.centred(size=grid.size, spacing=128 / max(grid.size))
            cameras = mv.dcspect80(pixels=16, columns=[0, 7], field=2.0)
            operators[x.device] = Spect(near, cameras, mu=MU, blur=True).to(x.device)
        return operators[x.device](x)

    def returned(x: Tensor) -> Tensor:
        y = pinholes(x)
        return operators[x.device].T(y)

    for name, call, values in (
        ("pinholes", pinholes, x),
        ("pinholes, there and back", returned, x),
        ("warp to frusta", world, x[:, None]),
        ("warp to the grid", volumes, world(x[:, None])[:, 0]),
        ("back-projection", lambda y: backproject(y, rig, grid, "distance"), views),
    ):
        results.attempt(f"agrees {name}", field, call, values, device)
    results.attempt("hull", same_hull, grid, rig, views, device)


def same_hull(grid: mv.Grid, rig: mv.Cameras, views: Tensor, device: str) -> dict[str, Any]:
    """Bricks that differ from the CPU's, and ms on the device."""
    exact, there = visual_hull(views, rig, grid, BRICK), views.to(device)
    differ = exact != visual_hull(there, rig, grid, BRICK).cpu()
    ms, _ = throughput(lambda: visual_hull(there, rig, grid, BRICK), device)
    return {"bricks": exact.numel(), "differ": int(differ.sum()), "ms": ms}


def first_call(name: str, device: str) -> str:
    """The back end used by a new process whose first call is made in a mode."""
    mode, call = FIRST_CALLS[name]
    code = FIRST_CALL.replace("MODE", mode).replace("CALL", call).replace("DEVICE", device)
    done = python("-c", code)
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
    synchronised = [w for w in caught if "synchroniz" in str(w.message)]
    places = Counter(f"{w.filename.split('/mvrecon/')[-1]}:{w.lineno}" for w in synchronised)
    return {"waits": places.total(), "places": dict(places)}


def graph(A: RayTransform, x: Tensor) -> dict[str, Any]:
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


def stream(A: RayTransform, x: Tensor) -> bool:
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


def device_alone(results: Results, A: RayTransform, B: RayTransform, x: Tensor) -> None:
    """Checks that require a GPU, for an operator A with skipping and an operator B without."""
    y = torch.rand_like(A(x))

    def host_us(call: Callable[[], Any]) -> float:
        return 1e3 * throughput(call, "cuda")[1]

    results.attempt("waits of a forward", waits, lambda: A(x))
    results.attempt("waits of an adjoint", waits, lambda: A.T(y))
    results.attempt("host us of a forward", host_us, lambda: A(x))
    results.attempt("the same, skip=off", host_us, lambda: B(x))
    results.attempt("host us of an adjoint", host_us, lambda: A.T(y))
    results.attempt("CUDA graph", graph, B, x)
    results.attempt("on the current stream", stream, A, x)


def main() -> None:
    """Entry point."""
    options = options_of(__doc__, n=48, modes=[*FIRST_CALLS])
    device, n = on_device(options.device), options.n
    results = Results(options.out, "check")
    results.add("versions", versions("triton"))
    if device == "cuda":
        results.attempt("machine", machine)
        self_checks(results)
    grid = mv.Grid.centred(size=(n - 2, n + 3, n), spacing=(1.0, 1.1, 0.9))
    rng = torch.Generator().manual_seed(0)
    x = torch.rand(2, 1, *grid.shape, generator=rng)
    x[..., : n // 3, :, :] = 0  # zeros to skip
    for name, rig in rigs(n).items():
        case = grid, rig, x, torch.rand(2, 1, len(rig), *rig.shape, generator=rng)
        for method in RAY_METHODS:
            found = results.attempt(f"agrees {name} {method}", agreement, *case, method, device)
            results.row(rig=name, method=method, **(found or {}))
        results.attempt(f"pose gradient {name}", pose_gradient, *case, device)
    cone = rigs(n)["cone"]
    fields(results, grid, cone, x, build(grid, cone)(x), device)
    for name in options.modes:  # not supported by the emulated GPU
        place = "cpu" if options.device == "dry" else device
        results.attempt(f"first call in {name}", first_call, name, place)
    if device == "cuda":
        A, B = (build(grid, cone, skip=skip).to(device) for skip in ("auto", "off"))
        device_alone(results, A, B, x.to(device))


if __name__ == "__main__":
    main()
