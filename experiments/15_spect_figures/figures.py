"""DC-SPECT's figures, expected and measured: inverse squares, sensitivity, field, resolution,
attenuation, MTF, rods, bias of counts; its rig and its 80 views.

python experiments/15_spect_figures/figures.py OUT_FOLDER [geometry] [bias] [edges] [wells]
"""

import sys
from pathlib import Path

import torch
from geometry import HOLE, ball, counts_of, geometry
from matplotlib import pyplot

import mvrecon as mv
from mvrecon.core.files.runs import read_rows, write_rows
from mvrecon.data.scenes.phantoms import derenzo
from mvrecon.data.scenes.solids import voxelise
from mvrecon_spect.metrics.contrast import count_bias
from mvrecon_spect.metrics.derenzo import valley_to_peak
from mvrecon_spect.metrics.edge import ball_mtf
from mvrecon_spect.operators.projector import Spect

GRID, PIXELS, SUBSETS = mv.Grid.centred(40, spacing=3.2), 48, 8
RADIUS, HEIGHT = 60.0, 80.0  # of the rods' phantom
DIAMETERS = (16, 14, 12, 10, 8, 6)
BLUR: dict[str, dict[str, bool]] = {"none": {}, "modelled": {"blur": True}}
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


def drawn(ideal: torch.Tensor, total: float, seed: int = 0) -> tuple[torch.Tensor, float]:
    """Poisson counts [1 1 m v u] of a total, and what an activity of one is on their scale."""
    scale = total / ideal.sum().item()
    counts = torch.poisson(scale * ideal.float(), generator=torch.Generator().manual_seed(seed))
    return counts[None, None], scale


def bias(out: Path) -> None:
    """Bias of the counts of a ball over OSEM's iterations."""
    cameras = mv.dcspect80(pixels=PIXELS)
    A = Spect(GRID, cameras, HOLE)
    ideal = counts_of(ball(40.0), cameras, HOLE)
    truth = voxelise(ball(40.0), GRID)
    rows = []
    for total in (None, 5e6, 5e5, 5e4):
        counts, scale = (ideal.float()[None, None], 1.0) if total is None else drawn(ideal, total)
        name = "no noise" if total is None else f"{total:.0e}"

        def watch(iterate, name=name, scale=scale) -> None:
            x = iterate.volume[0, 0] / scale
            values = (count_bias(x, truth, mask) for mask in (truth > 0, inner()))
            rows.append(
                {"counts": name, "iteration": iterate.number}
                | {k: f"{v:.4f}" for k, v in zip(("ball", "inner_half"), values, strict=True)}
            )

        mv.osem(A, counts, 6, SUBSETS, monitor=watch)
    write_rows(out / "bias.csv", rows)


def edges(out: Path) -> None:
    """MTF in x, y, z from the edge of a ball behind holes of 2.3 mm, without noise, reconstructed
    without and with their blur.
    """
    cameras, fine, rows = mv.dcspect80(pixels=PIXELS), GRID.refined(2), []
    views = Spect(fine, cameras, HOLE, blur=True)(voxelise(ball(40.0), fine)[None, None])
    for name, options in BLUR.items():
        A = Spect(GRID, cameras, HOLE, **options)
        x = mv.osem(A, views, 8, SUBSETS, background=1e-6)[0, 0]
        rows += transfer(x, name)
    write_rows(out / "mtf.csv", rows)


def transfer(x: torch.Tensor, blur: str) -> list[dict]:
    """The modulation transfer function along three axes."""
    rows = []
    for name, axis in AXES.items():
        curve = ball_mtf(x, GRID, (0.0, 0.0, 0.0), 80.0, axis)
        for frequency, value in zip(curve.frequencies.tolist(), curve.values.tolist(), strict=True):
            rows.append(
                {
                    "curve": f"{name}, blur: {blur}",
                    "per_mm": f"{frequency:.4f}",
                    "mtf": f"{value:.4f}",
                }
            )
    return rows


def inner() -> torch.Tensor:
    """Voxels within half of the ball's radius."""
    return voxelise(ball(20.0), GRID) > 0.99


def wells(out: Path) -> None:
    """Valley to peak of rods behind holes of 2.3 mm, reconstructed without and with their blur,
    and the noise-free views.
    """
    cameras, fine = mv.dcspect80(pixels=PIXELS), GRID.refined(2)
    phantom = derenzo(DIAMETERS, radius=RADIUS, height=HEIGHT)
    ideal = Spect(fine, cameras, HOLE, blur=True)(voxelise(phantom, fine)[None, None])[0, 0]
    draw_views(ideal / ideal.max(), out / "views.png")
    counts, _ = drawn(ideal, 5e6, seed=1)
    rows = []
    for name, options in BLUR.items():

        def watch(iterate, name=name) -> None:
            if iterate.number in (2, 4, 8):
                rows.extend(sectors(iterate.volume[0, 0], name, iterate.number))

        A = Spect(GRID, cameras, HOLE, **options)
        mv.osem(A, counts, 8, SUBSETS, background=1e-3, monitor=watch)
        write_rows(out / "wells.csv", rows)


def draw_views(views: torch.Tensor, file: Path) -> None:
    """The 80 views, a row for each row of 20 modules."""
    n = views.shape[-1]
    mosaic = views.reshape(4, 20, n, n).permute(0, 2, 1, 3).reshape(4 * n, 20 * n)
    figure, axis = pyplot.subplots(figsize=(8, 2), layout="constrained")
    shown = axis.imshow(mosaic, cmap="gray", vmin=0, vmax=1)
    axis.set_xticks(n / 2 + n * torch.arange(20), range(20))
    axis.set_yticks(n / 2 + n * torch.arange(4), range(4))
    axis.set(xlabel="module of a row", ylabel="row")
    figure.colorbar(shown, label="expected counts\n(greatest is 1)")
    figure.savefig(file, dpi=150)


def sectors(x: torch.Tensor, blur: str, iteration: int) -> list[dict]:
    """Valley to peak of each sector."""
    return [
        {
            "blur": blur,
            "iteration": iteration,
            "wells_mm": sector.diameter,
            "pairs": len(sector.ratios),
            "valley_to_peak": f"{sector.ratios.mean().item():.3f}",
            "resolved": f"{sector.resolved:.2f}",
        }
        for sector in valley_to_peak(x, GRID, DIAMETERS, RADIUS, HEIGHT)
    ]


def draw(out: Path) -> None:
    """Error over voxel size, MTF, bias of counts, from the tables."""
    figure = pyplot.figure(figsize=(8, 6.8), layout="constrained")
    axes = figure.subplot_mosaic([["convergence", "bias"], ["mtf", "mtf"]])
    panels = (
        ("convergence", "method", "voxels", "error"),
        ("mtf", "curve", "per_mm", "mtf"),
        ("bias", "counts", "iteration", "inner_half"),
    )
    for table, key, x, y in panels:
        axis = axes[table]
        rows = read_rows(out / f"{table}.csv")
        for name in dict.fromkeys(r[key] for r in rows):
            points = [(float(r[x]), float(r[y])) for r in rows if r[key] == name]
            axis.plot(*zip(*points, strict=True), ".-", label=name)
        if table == "bias":
            axis.legend(title="counts", loc="upper right", bbox_to_anchor=(1, 0.62))
        elif table == "mtf":
            axis.legend()
    axes["convergence"].set(
        xscale="log", yscale="log", xlabel="voxels along an edge", ylabel="relative error"
    )
    axes["convergence"].set_xticks([16, 32, 64, 128], [16, 32, 64, 128])
    axes["convergence"].set_xticks([], minor=True)
    axes["convergence"].set_yticks([0.003, 0.01, 0.03], [0.003, 0.01, 0.03])
    axes["convergence"].set_yticks([], minor=True)
    axes["convergence"].set_title("attenuated views of a ball")
    axes["bias"].set(
        xlabel=f"iteration of osem, {SUBSETS} subsets", ylabel="relative bias of the counts"
    )
    axes["bias"].set_title("inner half of a ball")
    axes["mtf"].set(xlabel="spatial frequency / (1/mm)", ylabel="MTF", ylim=(0, 1.5))
    axes["mtf"].set_title("edge of a ball of 80 mm, by axis and blur; above 1: Gibbs overshoot")
    figure.savefig(out / "figures.png", dpi=100)


PARTS = {"geometry": geometry, "bias": bias, "edges": edges, "wells": wells}


def main(out: Path, parts: list[str]) -> None:
    """The tables and pictures of some parts, or of all."""
    out.mkdir(parents=True, exist_ok=True)
    for name in parts or PARTS:
        PARTS[name](out)
    if all((out / f"{table}.csv").exists() for table in ("convergence", "mtf", "bias")):
        draw(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
