"""How long a projection takes, and how wrong it is: mvrecon beside RTK and nanodrr, where those are installed.

    pip install itk-rtk==2.7.0.post1 nanodrr==0.1.7    # optional
    python experiments/01_projector_speed/run.py --threads 2

Every program projects the same voxels of the same ellipsoids along the same rays, in float32, in one process, on the
same number of threads. Time is the median of `--repeats` calls after one that is not counted; ten seconds are enough.
"""

import argparse
import os
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from peers import Map, Operator, nanodrr, rtk

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_in_ball, random_rotation
from mvrecon.parts import PROJECTORS
from mvrecon.scenes.solids import Phantom, Solids
from mvrecon.scenes.voxelise import voxelise

HEAD = "operator,size,views,threads,forward_ms,forward_ratio,adjoint_ms,adjoint_ratio,relative_error"


def ellipsoids(radius: float, count: int = 7) -> Phantom:
    """Ellipsoids at random in a ball."""
    rng = torch.Generator().manual_seed(0)
    centres = torch.stack([random_in_ball(rng, 0.4 * radius) for _ in range(count)])
    semi_axes = radius * (0.15 + 0.35 * torch.rand(count, 3, generator=rng, dtype=torch.float64))
    return Phantom((Solids("ellipsoid", centres, random_rotation(rng, count), semi_axes, torch.ones(count)),))


def mvrecon(grid: Grid, rig: Cameras) -> Iterator[Operator]:
    """Our operators: both methods compiled, and the reference."""
    for method, backend in (("joseph", "cpu"), ("siddon", "cpu"), ("joseph", "reference")):
        A = PROJECTORS.build("drr", grid=grid, cameras=rig, method=method, backend=backend)
        yield f"mvrecon {method} {backend}", A, A.T


def median_ms(call: Map, value: torch.Tensor, repeats: int) -> float:
    """Median time of a call in ms; see the head of this file."""
    call(value)
    times: list[float] = []
    while len(times) < repeats and sum(times) < 10_000:
        start = time.perf_counter()
        call(value)
        times.append(1000 * (time.perf_counter() - start))
    return statistics.median(times)


def measure(size: int, count: int, threads: int, repeats: int) -> Iterator[str]:
    """One row per operator; the first is what the others are compared with."""
    torch.set_num_threads(threads)
    grid = Grid.centred((size, size, size), 256.0 / size)
    detector = {"pixels": [size, size], "pixel_mm": 1.536 * 256.0 / size}
    rig = circular(count, 1000.0, 1536.0, detector, start_degrees=3.0)
    phantom = ellipsoids(100.0)
    exact = phantom.integrals(*rig.rays(), extent=rig.limits)
    x = voxelise(phantom, grid)[None, None]
    y = torch.rand(1, 1, *exact.shape)
    base: tuple[float, float] | None = None
    for build in (mvrecon, lambda g, r: rtk(g, r, threads), nanodrr):
        try:
            operators = list(build(grid, rig))
        except ImportError:
            continue
        for name, forward, adjoint in operators:
            error = ((forward(x)[0, 0] - exact).norm() / exact.norm()).item()
            ours = (median_ms(forward, x, repeats), median_ms(adjoint, y, repeats))
            base = base or ours
            times = ",".join(f"{own:.1f},{own / first:.2f}" for own, first in zip(ours, base, strict=True))
            yield f"{name},{size},{count},{threads},{times},{error:.4f}"


def main() -> None:
    """Measure, print, and write results.csv beside this file."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("size", 128), ("views", 32), ("threads", 2), ("repeats", 5)):
        options.add_argument(f"--{name}", type=int, default=value)
    rows = [HEAD]
    print(HEAD)
    for row in measure(*vars(options.parse_args()).values()):
        rows.append(row)
        print(row, flush=True)
    part = Path(__file__).with_name("results.part")
    part.write_text("\n".join(rows) + "\n")
    os.replace(part, part.with_suffix(".csv"))


if __name__ == "__main__":
    main()
