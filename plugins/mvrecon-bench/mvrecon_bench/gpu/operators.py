"""Compare operators with those of other programs on one device: device time, host time, latency and
peak memory.

    python -m mvrecon_bench.gpu.operators --out FOLDER [--device cuda] [--cases 64:8:64 128:32:128]

A case is voxels:views:pixels along an edge. Rows are written immediately; unsupported directions
are noted. All programs use the same volume and rays; `difference` is relative to our forward (a
sanity check, not a ranking, since methods differ).
"""

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.testing.measures import gap
from mvrecon_bench.gpu.measuring import Results, on_device, options_of
from mvrecon_bench.gpu.programs import MOST_PIXELS, ONE_VOLUME, PROGRAMS, Program
from mvrecon_bench.measure import latency, once, throughput, with_memory
from mvrecon_bench.rows import reason

CASES = ["64:8:96", "128:1:200", "128:32:128", "256:180:256", "512:720:512"]
REFERENCE, LEAST_S = "mvrecon joseph", 5.0


def case_of(text: str) -> tuple[mv.Grid, mv.Cameras]:
    """A grid of 256 mm, and a cone beam around it."""
    n, n_views, pixels = map(int, text.split(":"))
    detector = {"pixels": [pixels, pixels], "pixel_mm": 1.536 * 256.0 / pixels}
    rig = mv.circular(n_views, 1000.0, 1536.0, detector, start_degrees=3.0)
    return mv.Grid.centred(n, spacing=256.0 / n), rig


def measured(program: Program, x: Tensor, y: Tensor, device: str) -> dict[str, Any]:
    """Milliseconds and MB of each direction; "views" are the views of the first volume."""
    row: dict[str, Any] = {"note": ""}
    few = len(x) == 1 and y.numel() <= 2**24
    inputs = {"forward": (x,), "adjoint": (y,), **({"pose": (x, y)} if few else {})}
    for what, operands in inputs.items():
        if (act := getattr(program, what)) is None:
            continue
        try:
            with torch.set_grad_enabled(what == "pose"):
                call = partial(act, *operands)
                result, first_s = once(call, device)
                if what == "forward":
                    row |= {"first_s": first_s, "views": result[:1]}

                row[f"{what}_ms"], row[f"{what}_host_ms"] = throughput(call, device)
                row[f"{what}_latency_ms"] = latency(call, device)
                row[f"{what}_peak_mb"] = with_memory(call, device)[1]
        except Exception as error:
            row["note"] += f"{what}: {reason(error)}; "
    return row


def rows_of(case: str, volumes: int, device: str, end: float) -> Iterator[dict[str, Any]]:
    """A row for each program until the time limit (`end`, of `time.perf_counter`)."""
    grid, rig = case_of(case)
    rng, expected = torch.Generator().manual_seed(0), None
    x = torch.rand(volumes, *grid.shape, generator=rng).to(device)
    y = torch.rand(volumes, len(rig), *rig.shape, generator=rng).to(device)
    for name, made in PROGRAMS.items():
        if (name in ONE_VOLUME and volumes > 1) or y.numel() > MOST_PIXELS.get(name, y.numel()):
            continue
        row: dict[str, Any] = {"case": case, "volumes": volumes, "program": name}
        if time.perf_counter() > end - LEAST_S:
            yield {**row, "note": "no time left"}
            continue
        try:
            row |= measured(made(grid, rig, device), x, y, device)
        except Exception as error:
            row["note"] = reason(error)
        views = row.pop("views", None)
        if name == REFERENCE:
            expected = views
        elif views is not None and expected is not None and name != "flashdrr":
            row["difference"] = gap(views, expected)
        yield row
        if device == "cuda":
            torch.cuda.empty_cache()


def main() -> None:
    """Entry point."""
    options = options_of(__doc__, cases=CASES, volumes=[1, 8], seconds=420.0)
    device, end = on_device(options.device), time.perf_counter() + options.seconds
    results = Results(options.out, "operators")
    for case in options.cases:
        n, n_views, pixels = map(int, case.split(":"))
        for volumes in options.volumes:
            if volumes * n**3 > 2**29 or (volumes > 1 and volumes * n_views * pixels**2 > 2**28):
                continue
            for row in rows_of(case, volumes, device, end):
                results.row(**row)


if __name__ == "__main__":
    main()
