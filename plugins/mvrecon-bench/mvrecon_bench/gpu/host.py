"""Python overhead of a projection, its adjoint and its pose gradient: microseconds of processor
time with an empty driver. Requires no GPU.

    python -m mvrecon_bench.gpu.host
"""

import ctypes
import time
from collections.abc import Callable
from ctypes import c_void_p
from types import SimpleNamespace
from typing import Any

import torch

import mvrecon as mv
from mvrecon.kernels.cuda import driver
from mvrecon.kernels.cuda.launch import RAYS
from mvrecon.kernels.rays.cuda import operators
from mvrecon.kernels.rays.lines import lines_of
from mvrecon_bench.measure import once

CALLS, ROUNDS = 200, 40


def without_a_device() -> None:
    """Empty kernels of a driver whose launch is a foreign call that does nothing."""
    none = {name: c_void_p() for name in RAYS.names}
    stub = SimpleNamespace(cuLaunchKernel=ctypes.CDLL(None).abs)
    driver.library = lambda: stub  # pyrefly: ignore[bad-assignment]
    driver.stream_of = lambda device: 0
    driver.memory_of = lambda device: 2**36
    operators.kernels_of = lambda variant, device: none  # pyrefly: ignore[bad-assignment]


def calls() -> dict[str, Callable[[], Any]]:
    """The operators of a small cone beam for one volume."""
    grid = mv.Grid.centred(8, spacing=1.0)
    rig = mv.circular(6, 50.0, 75.0, {"pixels": [8, 8], "pixel_mm": 2.0})
    lines, shape = lines_of(rig, grid), list(grid.shape)
    x, y = torch.rand(1, *grid.shape), torch.rand(1, len(rig), *rig.shape)
    scene = lines, list(rig.ray_extent)
    return {
        "projection": lambda: operators.project(x, *scene, list(rig.shape), "joseph"),
        "adjoint": lambda: operators.backproject(y, *scene, shape, "joseph"),
        "pose gradient": lambda: operators.lines_vjp(x, y, *scene, "joseph"),
    }


def microseconds(call: Callable[[], Any]) -> float:
    """Microseconds per call; minimum over several rounds, after a warm-up."""

    def repeated() -> None:
        for _ in range(CALLS):
            call()

    times = [once(repeated, "cpu", time.process_time)[1] for _ in range(ROUNDS + 1)]
    return 1e6 * min(times[1:]) / CALLS


def main() -> None:
    """Entry point."""
    torch.set_num_threads(1)
    without_a_device()
    for what, call in calls().items():
        print(f"{what}: {microseconds(call):.1f} us", flush=True)


if __name__ == "__main__":
    main()
