"""How long a projection takes, and how wrong it is: mvrecon beside RTK and nanodrr, where those are installed.

    pip install itk-rtk==2.7.0.post1 nanodrr==0.1.7    # optional
    python experiments/01_projector_speed/run.py --threads 2

Every program projects the same voxels of the same ellipsoids along the same rays, in float32, in one process, on as many
threads. Time is the median of `--repeats` calls after one that is not counted; slow ones stop after ten seconds.
"""

import argparse
import csv
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_in_ball, random_rotation
from mvrecon.parts import PROJECTORS
from mvrecon.scenes.solids import Phantom, Solids
from mvrecon.scenes.voxelise import voxelise

Map = Callable[[torch.Tensor], torch.Tensor]
Operator = tuple[str, Map, Map]


def ellipsoids(radius: float, count: int = 7) -> Phantom:
    """Ellipsoids at random in a ball."""
    rng = torch.Generator().manual_seed(0)
    centres = torch.stack([random_in_ball(rng, 0.4 * radius) for _ in range(count)])
    semi_axes = radius * (0.15 + 0.35 * torch.rand(count, 3, generator=rng, dtype=torch.float64))
    return Phantom((Solids("ellipsoid", centres, random_rotation(rng, count), semi_axes, torch.ones(count)),))


def mvrecon(grid: Grid, rig: Cameras) -> Iterator[Operator]:
    """Our operators, both methods and both back ends."""
    for backend in ("cpu", "reference"):
        for method in ("joseph", "siddon"):
            A = PROJECTORS.build("drr", grid=grid, cameras=rig, method=method, backend=backend)
            yield f"mvrecon {method} {backend}", A, A.T


def rtk(grid: Grid, rig: Cameras, threads: int) -> Iterator[Operator]:
    """RTK's Joseph filters, matched pair, on the CPU."""
    import itk
    from itk import RTK

    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(threads)
    image, pixel = itk.Image[itk.F, 3], rig.u.norm(dim=-1)[0].item()
    rows, columns = rig.shape
    geometry = RTK.ThreeDCircularProjectionGeometry.New()
    centres = rig.origin + rig.u * (columns - 1) / 2 + rig.v * (rows - 1) / 2
    for source, centre, u, v in zip(rig.source, centres, rig.u / pixel, rig.v / pixel, strict=True):
        if not geometry.AddProjection(source.tolist(), centre.tolist(), u.tolist(), v.tolist()):
            raise ValueError("RTK does not take this geometry")

    def filled(values: torch.Tensor, spacing: list[float], origin: list[float]):
        picture = itk.image_from_array(values.contiguous().numpy())
        picture.SetSpacing(spacing)
        picture.SetOrigin(origin)
        return picture

    def volume(values: torch.Tensor):
        return filled(values, list(grid.spacing), grid.affine[:3, 3].tolist())

    def views(values: torch.Tensor):
        return filled(values, [pixel, pixel, 1.0], [-pixel * (columns - 1) / 2, -pixel * (rows - 1) / 2, 0.0])

    def run(kind, target, given) -> torch.Tensor:
        operator = kind[image, image].New()
        operator.SetGeometry(geometry)
        operator.SetInput(0, target)
        operator.SetInput(1, given)
        operator.Update()
        return torch.from_numpy(itk.array_from_image(operator.GetOutput()))[None, None]

    def forward(x: torch.Tensor) -> torch.Tensor:
        return run(RTK.JosephForwardProjectionImageFilter, views(torch.zeros(len(rig), rows, columns)), volume(x[0, 0]))

    def adjoint(y: torch.Tensor) -> torch.Tensor:
        return run(RTK.JosephBackProjectionImageFilter, volume(torch.zeros(grid.shape)), views(y[0, 0]))

    yield "RTK joseph", forward, adjoint


def nanodrr(grid: Grid, rig: Cameras) -> Iterator[Operator]:
    """nanodrr's trilinear renderer, as many samples per ray as the volume has slabs; its adjoint by autograd."""
    from nanodrr.data import Subject
    from nanodrr.drr.renderer import render

    start, end = (p.float().flatten(1, 2) for p in rig.rays())
    affine, scale = grid.affine.float(), Subject._make_voxel_to_grid((1, 1, *grid.shape))
    frame, sdd = (torch.eye(3)[None], torch.eye(4)[None]), rig.distance.float()

    def forward(x: torch.Tensor) -> torch.Tensor:
        subject = Subject(x, torch.zeros_like(x), affine, affine.inverse(), scale, grid.centre.float(), 0)
        subject.convert_to_mu = False
        views = [
            render(subject, *frame, sdd[m : m + 1], *rig.shape, max(grid.shape), src=start[m, None], tgt=end[m, None])
            for m in range(len(rig))
        ]
        return torch.stack(views, dim=2)

    def adjoint(y: torch.Tensor) -> torch.Tensor:
        x = torch.zeros(1, 1, *grid.shape, requires_grad=True)
        return torch.autograd.grad(forward(x), x, y)[0]

    yield "nanodrr trilinear", forward, adjoint


def median_ms(call: Map, value: torch.Tensor, repeats: int) -> float:
    """Median time of a call in ms; see the head of this file."""
    call(value)
    times: list[float] = []
    while len(times) < repeats and sum(times) < 10_000:
        start = time.perf_counter()
        call(value)
        times.append(1000 * (time.perf_counter() - start))
    return statistics.median(times)


def measure(size: int, count: int, threads: int, repeats: int) -> Iterator[dict[str, object]]:
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
            yield {
                "operator": name, "size": size, "views": count, "threads": threads,
                "forward_ms": round(ours[0], 1), "forward_ratio": round(ours[0] / base[0], 2),
                "adjoint_ms": round(ours[1], 1), "adjoint_ratio": round(ours[1] / base[1], 2),
                "relative_error": f"{error:.4f}",
            }  # fmt: skip


def main() -> None:
    """Measure, print, and write results.csv beside this file."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("size", 128), ("views", 32), ("threads", 2), ("repeats", 5)):
        options.add_argument(f"--{name}", type=int, default=value)
    given = options.parse_args()
    rows = []
    for row in measure(given.size, given.views, given.threads, given.repeats):
        rows.append(row)
        print(*row.values(), sep="\t", flush=True)
    file = Path(__file__).with_name("results.csv")
    with open(part := file.with_suffix(".part"), "w", newline="") as sheet:
        writer = csv.DictWriter(sheet, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    os.replace(part, file)


if __name__ == "__main__":
    main()
