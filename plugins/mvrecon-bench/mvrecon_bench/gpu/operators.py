"""Compare operators with those of other programs on one device: device time, host time, latency and
peak memory.

    python -m mvrecon_bench.gpu.operators --out FOLDER [--device cuda] [--cases 64:8:64 128:32:128]

A case is voxels:views:pixels along an edge. Rows are written immediately; unsupported directions
are noted. All programs use the same volume and rays; `difference` is relative to our forward (a
sanity check, not a ranking, since methods differ).
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon_bench.benchmarks.trial import reason
from mvrecon_bench.gpu.measuring import Results, latency, on_device, peak_mb, throughput
from mvrecon_bench.gpu.programs import MOST_PIXELS, ONE_VOLUME, PROGRAMS, Program

CASES = ("64:8:96", "128:1:200", "128:32:128", "256:180:256", "512:720:512")
REFERENCE, LEAST_S = "mvrecon joseph", 5.0


def case_of(text: str) -> tuple[mv.Grid, mv.Cameras]:
    """A grid of 256 mm, and a cone beam around it."""
    n, n_views, pixels = map(int, text.split(":"))
    detector = {"pixels": [pixels, pixels], "pixel_mm": 1.536 * 256.0 / pixels}
    rig = mv.circular(n_views, 1000.0, 1536.0, detector, start_degrees=3.0)
    return mv.Grid.centred(n, spacing=256.0 / n), rig


def suits(name: str, volumes: int, pixels: int) -> bool:
    """Whether a program supports this number of volumes and pixels."""
    if name in ONE_VOLUME and volumes > 1:
        return False
    return pixels <= MOST_PIXELS.get(name, pixels)


def calls_of(program: Program, x: Tensor, y: Tensor) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The directions that a program supports."""
    forward, adjoint, pose = program.forward, program.adjoint, program.pose
    if forward:
        yield "forward", torch.no_grad()(lambda: forward(x))
    if adjoint:
        yield "adjoint", torch.no_grad()(lambda: adjoint(y))
    if pose and len(x) == 1 and y.numel() <= 2**24:
        yield "pose", lambda: pose(x, y)


def measured(program: Program, x: Tensor, y: Tensor, device: str) -> dict[str, Any]:
    """Milliseconds and MB of each direction; "views" are the views of the first volume."""
    row: dict[str, Any] = {"note": ""}
    for what, call in calls_of(program, x, y):
        try:
            start = time.perf_counter()
            result = call()
            if what == "forward":
                row |= {"first_s": time.perf_counter() - start, "views": result[:1]}
            row[f"{what}_ms"], row[f"{what}_host_ms"] = throughput(call, device)
            row[f"{what}_latency_ms"] = latency(call, device)
            row[f"{what}_peak_mb"] = peak_mb(call, device)
        except Exception as error:
            row["note"] += f"{what}: {reason(error)}; "
    return row


def rows_of(case: str, volumes: int, device: str, end: float) -> Iterator[dict[str, Any]]:
    """A row for each program until the time limit (`end`, of `time.perf_counter`)."""
    grid, rig = case_of(case)
    rng, expected = torch.Generator().manual_seed(0), None
    x = torch.rand(volumes, *grid.shape, generator=rng).to(device)
    y = torch.rand(volumes, len(rig), *rig.shape, generator=rng).to(device)
    for name in (name for name in PROGRAMS if suits(name, volumes, y.numel())):
        row: dict[str, Any] = {"case": case, "volumes": volumes, "program": name}
        if time.perf_counter() > end - LEAST_S:
            yield {**row, "note": "no time left"}
            continue
        try:
            row |= measured(PROGRAMS[name](grid, rig, device), x, y, device)
        except Exception as error:
            row["note"] = reason(error)
        views = row.pop("views", None)
        if name == REFERENCE:
            expected = views
        elif views is not None and expected is not None and name != "flashdrr":
            row["difference"] = float((views - expected).norm() / expected.norm())
        yield row
        if device == "cuda":
            torch.cuda.empty_cache()


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--cases", nargs="+", default=CASES)
    parser.add_argument("--volumes", nargs="+", type=int, default=[1, 8])
    parser.add_argument("--seconds", type=float, default=420.0)
    options = parser.parse_args()
    device, end = on_device(options.device), time.perf_counter() + options.seconds
    results = Results(options.out, "operators")
    for case in options.cases:
        n, n_views, pixels = map(int, case.split(":"))
        for volumes in options.volumes:
            many = volumes * math.prod((n, n, n)) > 2**29
            if many or (volumes > 1 and volumes * n_views * pixels**2 > 2**28):
                continue
            for row in rows_of(case, volumes, device, end):
                results.row(**row)


if __name__ == "__main__":
    main()
