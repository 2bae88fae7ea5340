"""DC-SPECT's figures, expected and measured: inverse squares, sensitivity, field, resolution,
attenuation, MTF, wells, bias of counts; its rig and its 80 views.

python experiments/15_spect_figures/figures.py OUT_FOLDER
"""

import csv
import math
import sys
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.cameras.field import sees
from mvrecon.engine.export import save_png
from mvrecon.projectors.attenuated import AttenuatedTransform
from mvrecon.scenes.derenzo import derenzo
from mvrecon.scenes.solids import Phantom, Solids
from mvrecon.scenes.voxelise import voxelise
from mvrecon.viz.montage import enlarged, radiographs, tiled
from mvrecon.viz.rig import save_picture
from mvrecon_spect.hole import Hole
from mvrecon_spect.metrics.contrast import count_bias
from mvrecon_spect.metrics.derenzo import valley_to_peak
from mvrecon_spect.metrics.edge import ball_mtf
from mvrecon_spect.projector import Spect

MU, HOLE = 0.01536, 2.3  # water at 140.5 keV in 1/mm; mm
GRID = mv.Grid.centred(64, spacing=2.0)
RADIUS, HEIGHT = 60.0, 80.0  # of the wells' phantom
DIAMETERS = (16, 14, 12, 10, 8, 6)
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


def ball(radius: float, centre=(0.0, 0.0, 0.0), value: float = 1.0) -> Phantom:
    """A uniform ball; mm."""
    place = torch.as_tensor(centre, dtype=torch.float64)[None]
    return Phantom(
        (
            Solids(
                "ellipsoid",
                place,
                torch.eye(3)[None],
                torch.full((1, 3), radius),
                torch.tensor([value]),
            ),
        )
    )


def counts_of(phantom: Phantom, cameras: mv.Cameras, diameter: float) -> torch.Tensor:
    """Expected counts [m v u] from exact integrals."""
    integrals = phantom.integrals(*cameras.rays(), ray_extent=cameras.ray_extent)
    return integrals * Hole(diameter).weight(cameras)


def inverse_square() -> dict:
    """Counts of a ball that comes 100 mm nearer on the axis of module 0."""
    camera = mv.dcspect80(pixels=512)[[0]]
    pinhole, distance = camera.source[0], camera.source[0].norm()
    nearer = pinhole * (100.0 / distance)
    far, near = (counts_of(ball(18.0, c), camera, HOLE).sum() for c in (pinhole * 0, nearer))
    expected = (distance / (distance - 100)) ** 2
    return row("ball, 294.26 to 194.26 mm: counts", "times", expected, near / far)


def sensitivities() -> list[dict]:
    """Counts of all pinholes over the decays of a small ball at the heart."""
    cameras = mv.dcspect80(pixels=512)
    rows = []
    for diameter in (2.3, 0.94):
        parts = [counts_of(ball(6.0), camera, diameter).sum() for camera in cameras]
        expected = (diameter**2 / (16 * cameras.source.norm(dim=-1) ** 2)).sum()
        measured = torch.stack(parts).sum() / (4 / 3 * math.pi * 6.0**3)
        name = f"sensitivity on the axes, {diameter} mm"
        rows.append(row(name, "%", 100 * expected, 100 * measured))
    return rows


def field() -> list[dict]:
    """The fields at the heart, and the ball that all see."""
    cameras = mv.dcspect80(pixels=512)
    b, length = cameras.source.norm(dim=-1), cameras.distance
    widths = cameras.u.norm(dim=-1) * 512 * b / length
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(40000, 3, generator=generator).double())
    low, high = 0.0, 100.0
    while high - low > 0.02:
        middle = (low + high) / 2
        low, high = (middle, high) if sees(cameras, middle * points).all() else (low, middle)
    half = 25.0
    expected = (b * half / (half**2 + length**2).sqrt()).min()
    return [
        row("field at the heart, least", "mm", 165.2, widths.min()),
        row("field at the heart, greatest", "mm", 175.6, widths.max()),
        row("radius of the ball that all 80 see", "mm", expected, (low + high) / 2),
    ]


def widths() -> list[dict]:
    """FWHM of the profiles of a point and of a line at the heart, the narrowest and the widest."""
    cameras, rows = mv.dcspect80(pixels=201), []
    b, length = cameras.source.norm(dim=-1), cameras.distance
    geometric = HOLE * (b + length) / length
    grid = mv.Grid.centred(3, spacing=0.3)
    point = torch.zeros(1, 1, 3, 3, 3, dtype=torch.float64)
    point[..., 1, 1, 1] = 1
    for name, m in (("narrowest", int(geometric.argmin())), ("widest", int(geometric.argmax()))):
        image = Spect(grid, cameras[[m]], HOLE, blur=True)(point)[0, 0, 0]
        scale = 50 / 201 * (b[m] / length[m])
        profile = row(f"FWHM of a point, {name}", "mm", geometric[m], fwhm(image[100]) * scale)
        line = fwhm(image.sum(dim=0)) * scale
        rows += [
            profile,
            row(f"FWHM of a line, {name}", "mm", geometric[m] * math.sqrt(3) / 2, line),
        ]
    return rows


def fwhm(profile: torch.Tensor) -> torch.Tensor:
    """Full width at half of the maximum, in samples, linear between them."""
    half = profile.max() / 2
    above = (profile > half).nonzero().flatten()
    first, last = above[0], above[-1]
    before, low, high, after = (profile[i] for i in (first - 1, first, last, last + 1))
    return last - first + (low - half) / (low - before) + (high - half) / (high - after)


def attenuation() -> tuple[dict, list[dict]]:
    """The attenuated central ray of a filled ball, R = 100 mm, and the error over voxel sizes."""
    camera = mv.dcspect80(pixels=33, field=2)[[0]]
    phantom, start_end = ball(100.0), camera.rays()
    chord = phantom.integrals(*start_end, ray_extent=camera.ray_extent)
    exact = -torch.expm1(-MU * chord) / MU
    rows = []
    for n in (16, 32, 64, 128):
        grid = mv.Grid.centred(n, spacing=208.0 / n)
        x = voxelise(phantom, grid).double()
        for method in ("joseph", "siddon"):
            y = AttenuatedTransform(grid, camera, mu=MU * x, method=method)(x[None, None])[0, 0]
            error = ((y - exact).norm() / exact.norm()).item()
            central = f"{y[0, 16, 16].item():.3f}"
            rows.append(
                {"voxels": n, "method": method, "error": f"{error:.5f}", "central_mm": central}
            )
    expected = -math.expm1(-MU * 200) / MU
    return row("central ray of a filled ball", "mm", expected, float(rows[-2]["central_mm"])), rows


def drawn(ideal: torch.Tensor, total: float, seed: int = 0) -> tuple[torch.Tensor, float]:
    """Poisson counts [1 1 m v u] of a total, and what an activity of one is on their scale."""
    scale = total / ideal.sum().item()
    counts = torch.poisson(scale * ideal.float(), generator=torch.Generator().manual_seed(seed))
    return counts[None, None], scale


def edges() -> tuple[list[dict], list[dict]]:
    """MTF in x, y, z from a ball's edge, and the bias of its counts over OSEM's iterations."""
    cameras = mv.dcspect80(pixels=32)
    A = Spect(GRID, cameras, HOLE)
    ideal = counts_of(ball(40.0), cameras, HOLE)
    truth = voxelise(ball(40.0), GRID)
    mtf, bias = [], []
    for total in (5e4, 5e5, 5e6):
        counts, scale = drawn(ideal, total)

        def watch(iterate, total=total, scale=scale) -> None:
            x = iterate.volume[0, 0] / scale
            bias.append(
                {
                    "counts": f"{total:.0e}",
                    "iteration": iterate.number,
                    "ball": f"{count_bias(x, truth, truth > 0):.4f}",
                    "inner_half": f"{count_bias(x, truth, inner()):.4f}",
                }
            )

        x = mv.osem(A, counts, 10, 20, monitor=watch)[0, 0]
    for name, axis in AXES.items():
        curve = ball_mtf(x, GRID, (0.0, 0.0, 0.0), 80.0, axis)
        for frequency, value in zip(curve.frequencies.tolist(), curve.values.tolist(), strict=True):
            mtf.append({"axis": name, "per_mm": f"{frequency:.4f}", "mtf": f"{value:.4f}"})
    return mtf, bias


def inner() -> torch.Tensor:
    """Voxels within half of the ball's radius."""
    return voxelise(ball(20.0), GRID) > 0.99


def wells() -> tuple[list[dict], torch.Tensor]:
    """Valley to peak of wells behind holes of 2.3 mm, reconstructed without and with their blur,
    and the noise-free views.
    """
    cameras, fine = mv.dcspect80(pixels=32), GRID.refined(2)
    phantom = derenzo(DIAMETERS, radius=RADIUS, height=HEIGHT)
    ideal = Spect(fine, cameras, HOLE, blur=True)(voxelise(phantom, fine)[None, None])[0, 0]
    counts, _ = drawn(ideal, 5e6, seed=1)
    rows = []
    for name, options in (("none", {}), ("modelled", {"blur": True})):
        A = Spect(GRID, cameras, HOLE, **options)
        for iterations in (5, 20):
            x = mv.osem(A, counts, iterations, 10, background=1e-3)[0, 0]
            for sector in valley_to_peak(x, GRID, DIAMETERS, RADIUS, HEIGHT):
                rows.append(
                    {
                        "blur": name,
                        "iterations": iterations,
                        "wells_mm": sector.diameter,
                        "pairs": len(sector.ratios),
                        "valley_to_peak": f"{sector.ratios.mean().item():.3f}",
                        "resolved": f"{sector.resolved:.2f}",
                    }
                )
    return rows, ideal


def row(
    figure: str, unit: str, expected: float | torch.Tensor, measured: float | torch.Tensor
) -> dict:
    """A figure with what it should be."""
    return {
        "figure": figure,
        "unit": unit,
        "expected": f"{float(expected):.4g}",
        "measured": f"{float(measured):.4g}",
    }


def save(file: Path, rows: list[dict]) -> None:
    """Write rows as CSV."""
    with file.open("w", newline="") as out:
        table = csv.DictWriter(out, rows[0].keys(), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def draw(file: Path, convergence: list[dict], mtf: list[dict], bias: list[dict]) -> None:
    """Error over voxel size, MTF, bias of counts."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(13, 4), layout="constrained")
    panels = (
        (axes[0], convergence, "method", "voxels", "error"),
        (axes[1], mtf, "axis", "per_mm", "mtf"),
        (axes[2], bias, "counts", "iteration", "inner_half"),
    )
    for axis, rows, key, x, y in panels:
        for name in dict.fromkeys(r[key] for r in rows):
            points = [(float(r[x]), float(r[y])) for r in rows if r[key] == name]
            axis.plot(*zip(*points, strict=True), ".-", label=f"{name}")
        axis.legend()
    axes[0].set(xscale="log", yscale="log", xlabel="voxels along an edge", ylabel="relative error")
    axes[1].set(xlabel="1/mm", ylabel="MTF", ylim=(0, 1.2))
    axes[2].set(xlabel="iteration of osem, 20 subsets", ylabel="bias of counts, inner half of ball")
    figure.savefig(file, dpi=90)


def main(out: Path) -> None:
    """All tables and pictures."""
    out.mkdir(parents=True, exist_ok=True)
    central, convergence = attenuation()
    save(out / "convergence.csv", convergence)
    save(out / "numbers.csv", [inverse_square(), *sensitivities(), *field(), *widths(), central])
    save_picture(out / "rig.png", mv.dcspect80(pixels=32), GRID)
    mtf, bias = edges()
    save(out / "mtf.csv", mtf)
    save(out / "bias.csv", bias)
    draw(out / "figures.png", convergence, mtf, bias)
    table, views = wells()
    save(out / "wells.csv", table)
    images = enlarged(radiographs(views), 64)
    save_png(out / "views.png", tiled([images[r : r + 20] for r in range(0, 80, 20)]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
