"""Views that end inside the object, and beam hardening of water: before and after correction.

python experiments/30_scan_effects/run.py experiments/30_scan_effects
"""

import math
import sys
import warnings
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.acquisition.spectra import tube
from mvrecon.data.projections.linearise import linearised
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import voxel_centres
from mvrecon.methods.calibration.hardening import fit_linearisation

VALUE = 0.02
#: Centre and semi-axes in the plane in mm, and value, of ellipsoids as high as wide; fields have
#: radii of 50 mm, the half fan's of 66 mm.
OBJECTS = {
    "ball of 90 mm": [(3, -5, 90, 90, VALUE)],
    "ball of 140 mm": [(0, 0, 140, 140, VALUE)],
    "ball of 40 mm, cut off on one side": [(30, 0, 40, 40, VALUE)],
    "two balls, cut off on one side each": [(-35, 0, 40, 40, VALUE), (50, 10, 30, 30, 0.03)],
    "oval with an insert": [(10, 5, 120, 70, VALUE), (15, -20, 8, 8, VALUE)],
    "shell from 70 to 75 mm": [(0, 0, 75, 75, 0.04), (0, 0, 70, 70, -0.02)],
    "body with lungs": [
        (0, 0, 130, 85, VALUE),
        (0, -50, 14, 14, VALUE),
        (35, 15, 25, 40, -0.014),
        (-40, 10, 25, 40, -0.014),
    ],
    "shell from 40 to 75 mm": [(0, 0, 75, 75, VALUE), (0, 0, 40, 40, -VALUE)],
}


def panel(columns: int, pixel_mm: float, rows: int = 1, shift_mm: float = 0.0) -> dict:
    return {"pixels": [rows, columns], "pixel_mm": pixel_mm, "offset_mm": [0.0, shift_mm]}


def parallel(columns: int) -> mv.Cameras:
    return mv.parallel(150, panel(columns, 1.0), depth_mm=900.0)


def fan(columns: int, arc: float = 360.0, rows: int = 1) -> mv.Cameras:
    return mv.circular(180, 400.0, 600.0, panel(columns, 1.5, rows), arc_degrees=arc)


#: The rig, one with a wide detector, and the radius of its field in mm.
RIGS = {
    "parallel": (parallel(100), parallel(400), 50.0),
    "fan": (fan(100), fan(400), 49.6),
    "short fan": (fan(100, 225.0), fan(400), 49.6),
    "half fan": (
        mv.circular(240, 400.0, 600.0, panel(66, 2.0, 1, 35.0)),
        mv.circular(240, 400.0, 600.0, panel(300, 2.0, 1, 1.0)),
        66.0,
    ),
    "cone": (fan(100, rows=6), fan(400, rows=6), 49.6),
}


def ellipsoids(solids: list) -> Phantom:
    x, y, a, b, values = torch.tensor(solids, dtype=torch.float32).T
    centres = torch.stack([x, y, 0 * x], dim=1)
    sizes = torch.stack([a, b, torch.maximum(a, b)], dim=1)
    return Phantom((Solids.upright("ellipsoid", centres, sizes, values),))


def views_of(phantom: Phantom, rig: mv.Cameras) -> torch.Tensor:
    return phantom.views(rig)[None, None].float()


def operator(rig: mv.Cameras, grid: mv.Grid) -> mv.Drr | mv.Radon:
    return mv.Radon(grid, rig) if rig.parallel else mv.Drr(grid, rig)


def truncation() -> list[dict]:
    """Errors in per cent of 0.02/mm inside 95 % of the field, relative to the wide detector."""
    rows = []
    for beam, (rig, wide, field) in RIGS.items():
        grid = mv.Grid.centred(size=(60, 60, min(2, rig.shape[0])), spacing=field / 30)
        inside = voxel_centres(grid)[..., :2].norm(dim=-1) < 0.95 * field
        for name, solids in OBJECTS.items():
            phantom = ellipsoids(solids)
            truth = mv.fdk(operator(wide, grid), views_of(phantom, wide))[0, 0][inside]
            for extrapolate in (False, True):
                A = operator(rig, grid)
                x = mv.fdk(A, views_of(phantom, rig), extrapolate=extrapolate)[0, 0][inside]
                off = 100 * (x - truth) / VALUE
                rows.append(
                    {
                        "beam": beam,
                        "object": name,
                        "extrapolate": str(extrapolate).lower(),
                        "mean": round(off.mean().item(), 2),
                        "q95": round(off.abs().quantile(0.95).item(), 2),
                    }
                )
    return rows


def edges() -> list[dict]:
    """Errors in per cent of a long cylinder's value, at the centre and just inside the rim of the
    field, by its line integrals at the edge relative to the greatest ones.
    """
    rows, (rig, _, field) = [], RIGS["parallel"]
    grid = mv.Grid.centred(size=(60, 60, 1), spacing=field / 30)
    off = voxel_centres(grid)[..., :2].norm(dim=-1) / field
    for share in (0.1, 0.2, 0.33, 0.57, 0.79):
        radius = field / math.sqrt(1 - share**2)
        views = views_of(ellipsoids([(0, 0, radius, radius, VALUE)]), rig)
        row: dict = {"edge": share}
        for extrapolate in (False, True):
            x = mv.fbp(operator(rig, grid), views, extrapolate=extrapolate)[0, 0] / VALUE - 1
            for place, inside in {"centre": off < 0.1, "rim": (off > 0.9) & (off < 0.95)}.items():
                name = f"{place}, extrapolate={str(extrapolate).lower()}"
                row[name] = round(100 * x[inside].mean().item(), 2)
        rows.append(row)
    return rows


def noisy() -> list[dict]:
    """The mean error of the ball of 90 mm in per cent, inside 95 % of the field, from scans of one
    row with noise in per cent of the greatest line integral.
    """
    rows = []
    for beam in ("parallel", "fan", "short fan", "half fan"):
        rig, wide, field = RIGS[beam]
        grid = mv.Grid.centred(size=(60, 60, 1), spacing=field / 30)
        inside = voxel_centres(grid)[..., :2].norm(dim=-1) < 0.95 * field
        phantom = ellipsoids(OBJECTS["ball of 90 mm"])
        truth = mv.fbp(operator(wide, grid), views_of(phantom, wide))[0, 0][inside].mean()
        for percent in (1, 3, 10):
            for seed in range(3):
                rng, views = torch.Generator().manual_seed(seed), views_of(phantom, rig)
                noise = percent / 100 * views.max() * torch.randn(views.shape, generator=rng)
                x = mv.fbp(operator(rig, grid), views + noise)[0, 0][inside].mean()
                mean = round((100 * (x - truth) / VALUE).item(), 2)
                rows.append({"beam": beam, "noise": percent, "seed": seed, "mean": mean})
    return rows


def hardening() -> list[dict]:
    """Cupping in per cent of a long cylinder of water, by the polynomial of the greater one's own
    views.
    """
    rows = []
    for beam, rig in {
        "parallel": mv.parallel(120, panel(160, 1.5), depth_mm=900.0),
        "fan": mv.circular(120, 500.0, 750.0, panel(160, 2.25)),
        "cone": mv.circular(120, 500.0, 750.0, panel(160, 2.25, 12)),
    }.items():
        grid = mv.Grid.centred(size=(90, 90, 4 if beam == "cone" else 1), spacing=2.6)
        A = operator(rig, grid)
        for kv in (80.0, 120.0):
            coefficients: list[float] = []
            for radius in (100.0, 60.0):
                place = [[5.0, -3.0, 0.0]], [[radius, radius, 400.0]]
                middle, sizes = map(torch.tensor, place)
                solid = Solids.upright("cylinder", middle, sizes, torch.tensor([0.01929]))
                water = Phantom((solid,))
                rng = torch.Generator().manual_seed(1)
                p = -tube(kv).transmission(views_of(water, rig).double()).log()
                p = (p + 0.01 * torch.randn(p.shape, generator=rng)).float()
                coefficients = coefficients or fit_linearisation(A, p).coefficients
                off = (voxel_centres(grid)[0, ..., :2] - middle[0, :2]).norm(dim=-1) / radius
                cups = []
                for views in (p, linearised(p, coefficients, p > -1)):
                    x = mv.fdk(A, views)[0, 0, grid.shape[0] // 2]
                    rim = x[(off > 0.8) & (off < 0.9)].mean()
                    cups.append(round(100 * (1 - (x[off < 0.15].mean() / rim)).item(), 2))
                rows.append(
                    {
                        "beam": beam,
                        "kv": int(kv),
                        "diameter mm": int(2 * radius),
                        "before": cups[0],
                        "after": cups[1],
                        "c2": round(coefficients[1], 4),
                        "c3": round(coefficients[2], 5),
                    }
                )
    return rows


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    folder = Path(sys.argv[1])
    write_rows(folder / "truncation.csv", truncation())
    write_rows(folder / "edges.csv", edges())
    write_rows(folder / "noise.csv", noisy())
    write_rows(folder / "hardening.csv", hardening())
