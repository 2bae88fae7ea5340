"""Contrast recovery against background variability over iterations and processor seconds, rods
resolved, bias and variance: mlem, osem, bsrem and tv_map on counts of DC-SPECT's 80 ideal pinholes.

python experiments/14_counts/recovery.py OUT_FOLDER

A folder with the first table gets the picture of it alone.
"""

import math
import sys
import time
from pathlib import Path

import torch
from matplotlib import pyplot

import mvrecon as mv
from mvrecon.core.files.runs import VERSIONS, read_rows, write_rows
from mvrecon.data.scenes.phantoms import derenzo
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.training.run_folder import versions
from mvrecon_spect.methods.bsrem import bsrem
from mvrecon_spect.methods.tv_map import tv_map
from mvrecon_spect.metrics.contrast import sphere_recovery
from mvrecon_spect.metrics.derenzo import valley_to_peak
from mvrecon_spect.metrics.repeated import repeated
from mvrecon_spect.operators.projector import Spect

GRID = mv.Grid.centred(64, spacing=2.5)
RATIO, COUNTS, DRAWS = 5.0, 5e6, 20
DIAMETERS = torch.tensor([10.0, 13.0, 17.0, 22.0])
WELLS = (10, 8, 7, 6, 5, 4)
#: Iterations, and the method up to a number of them.
METHODS = {
    "mlem": (100, lambda A, y, n, **o: mv.mlem(A, y, n, **o)),
    "osem20": (10, lambda A, y, n, **o: mv.osem(A, y, n, 20, **o)),
    "bsrem 0.003": (15, lambda A, y, n, **o: bsrem(A, y, n, 0.003, 8, **o)),
    "bsrem 0.03": (15, lambda A, y, n, **o: bsrem(A, y, n, 0.03, 8, **o)),
    "tv_map 0.1": (100, lambda A, y, n, **o: tv_map(A, y, n, 0.1, background=0.01, **o)),
}
#: Names in the picture.
TOLD = {
    "mlem": "MLEM",
    "osem20": "OSEM, 20 subsets",
    "bsrem 0.003": "BSREM, weight 0.003",
    "bsrem 0.03": "BSREM, weight 0.03",
    "tv_map 0.1": "total variation, weight 0.1",
}


def ring(radius: float, count: int, z: float = 0.0, start: float = 0.0) -> torch.Tensor:
    """Points on a circle about the axis z, in mm."""
    turn = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count + math.radians(start)
    return torch.stack([radius * turn.cos(), radius * turn.sin(), torch.full_like(turn, z)], -1)


def cylinder(spheres: torch.Tensor) -> Phantom:
    """Hot spheres in a warm cylinder of radius 72 mm and height 80 mm."""
    radii, size = (DIAMETERS / 2)[:, None].expand(4, 3), torch.tensor([[72.0, 72.0, 40.0]])
    body = Solids.upright("cylinder", torch.zeros(1, 3), size, torch.ones(1))
    return Phantom((body, Solids.upright("ellipsoid", spheres, radii, torch.full((4,), RATIO - 1))))


def counted(phantom: Phantom, A: Spect, seed: int) -> tuple[torch.Tensor, float]:
    """Counts from exact integrals, and by how much they exceed those of an activity of one."""
    pixel = A.pixel_integral()
    ideal = (phantom.views(A.cameras, pixel.rays) * pixel.weight)[None, None].float()
    scale = COUNTS / ideal.sum().item()
    return torch.poisson(scale * ideal, generator=torch.Generator().manual_seed(seed)), scale


def contrasts(A: Spect, rows: list[dict]) -> None:
    """Recovery, variability and objective of every iteration."""
    spheres = ring(45.0, 4)
    background = torch.cat([ring(42.0, 4, z, 45.0) for z in (-18.0, 18.0)])
    y, scale = counted(cylinder(spheres), A, 0)
    for name, (iterations, method) in METHODS.items():
        method(A, y, 1)  # what is compiled and kept at a first call is no time of a method
        spent = -time.process_time()

        def watch(iterate, name=name) -> None:
            nonlocal spent
            spent += time.process_time()
            x = iterate.volume[0, 0] / scale
            figures = sphere_recovery(x, GRID, spheres, DIAMETERS, background, RATIO)
            for diameter, c, n in zip(DIAMETERS.tolist(), *figures, strict=True):
                rows.append(
                    {
                        "method": name,
                        "iteration": iterate.number,
                        "seconds": f"{spent:.2f}",
                        "objective": f"{iterate.objective.item():.8g}",
                        "sphere_mm": diameter,
                        "recovery": f"{c:.4f}",
                        "variability": f"{n:.4f}",
                    }
                )
            spent -= time.process_time()  # figures take no part of a method's time

        method(A, y, iterations, monitor=watch)


def resolved(A: Spect) -> list[dict]:
    """Share of the rods' pairs that are resolved, by diameter."""
    pose = {"radius": 70.0, "height": 60.0}
    y, _ = counted(derenzo(WELLS, **pose), A, 1)
    rows = []
    for name, (iterations, method) in METHODS.items():
        x = method(A, y, iterations)[0, 0]
        shares = {f"{s.diameter:g} mm": s.resolved for s in valley_to_peak(x, GRID, WELLS, **pose)}
        rows.append({"method": name} | {k: f"{v:.2f}" for k, v in shares.items()})
    return rows


def spreads(A: Spect) -> list[dict]:
    """Bias and standard deviation over noise draws, in the spheres and in the background."""
    phantom = cylinder(ring(45.0, 4))
    truth = voxelise(phantom, GRID)
    regions = {"spheres": truth > 0.99 * RATIO, "background": (truth - 1).abs() < 1e-3}
    rows = []
    for name in ("osem20", "bsrem 0.003", "bsrem 0.03"):
        method = METHODS[name][1]

        def volume(seed: int, method=method) -> torch.Tensor:
            y, scale = counted(phantom, A, 100 + seed)
            return method(A, y, 5)[0, 0] / scale

        figures = repeated(map(volume, range(DRAWS)), truth)
        for region, mask in regions.items():
            values = figures.within(mask)._asdict()
            row = {"method": name, "iterations": 5, "region": region, "draws": DRAWS}
            rows.append(row | {k: f"{v:.4f}" for k, v in values.items()})
    return rows


def draw(rows: list[dict], file: Path) -> None:
    """Recovery over variability of two spheres, and over the processor's time."""
    figure = pyplot.figure(figsize=(8, 6.4), layout="constrained")
    axes = list(figure.subplot_mosaic("AB;CC").values())
    for name in METHODS:
        lines = [r for r in rows if r["method"] == name]
        for axis, diameter in zip(axes, (13.0, 22.0), strict=False):
            points = [r for r in lines if float(r["sphere_mm"]) == diameter]
            pairs = [(float(r["variability"]), float(r["recovery"])) for r in points]
            axis.plot(*zip(*pairs, strict=True), ".-", label=TOLD[name])
            axis.set(xlabel="background variability", ylabel="contrast recovery")
            axis.set_title(f"contrast and noise, sphere of {diameter:g} mm")
            if axis is axes[0]:
                seconds = [float(r["seconds"]) for r in points]
                axes[2].plot(seconds, [recovery for _, recovery in pairs], ".-", label=TOLD[name])
    axes[2].set(xlabel="processor time (s)", ylabel="contrast recovery", xscale="log")
    axes[2].set_title("contrast and time, sphere of 13 mm")
    axes[2].legend()
    figure.savefig(file, dpi=100)


def main(out: Path) -> None:
    """All three tables, the figure and the versions."""
    out.mkdir(parents=True, exist_ok=True)
    A = Spect(GRID, mv.dcspect80(pixels=[32, 32]), diameter_mm=2.3)
    rows: list[dict] = []
    contrasts(A, rows)
    write_rows(out / "recovery.csv", rows)
    draw(rows, out / "recovery.png")
    write_rows(out / "resolved.csv", resolved(A))
    write_rows(out / "spreads.csv", spreads(A))
    made = "".join(f"{name} {version}\n" for name, version in versions().items())
    (out / VERSIONS).write_text(made, encoding="utf-8")


if __name__ == "__main__":
    if (table := Path(sys.argv[1]) / "recovery.csv").exists():  # the picture of the table
        draw(read_rows(table), table.with_suffix(".png"))
    else:
        main(Path(sys.argv[1]))
