"""What follows from DC-SPECT's places and sizes alone: inverse squares, sensitivity, field, widths
of images, the attenuated integral of a ball.
"""

import math
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.field import sees
from mvrecon.report.viz.rig import save_picture
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.projector import Spect

MU, HOLE = 0.01536, 2.3  # water at 140.5 keV in 1/mm; mm


def geometry(out: Path) -> None:
    """What follows from places and sizes alone, and the picture of the rig."""
    central, convergence = attenuation()
    write_rows(out / "convergence.csv", convergence)
    write_rows(
        out / "numbers.csv", [inverse_square(), *sensitivities(), *field(), *widths(), central]
    )
    save_picture(out / "rig.png", mv.dcspect80(pixels=32), mv.Grid.centred(64, spacing=2.0))


def ball(radius: float, centre=(0.0, 0.0, 0.0)) -> Phantom:
    """A uniform ball; mm."""
    place = torch.as_tensor(centre, dtype=torch.float64)[None]
    return Phantom((Solids.upright("ellipsoid", place, torch.full((1, 3), radius), torch.ones(1)),))


def counts_of(phantom: Phantom, cameras: mv.Cameras, diameter: float) -> torch.Tensor:
    """Expected counts [m v u] from exact integrals."""
    return phantom.views(cameras) * Hole(diameter).weight(cameras)


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
    """Width of the image of a point at the heart, 4 standard deviations of its profile as of a
    disc, and FWHM of the profile of a line, the narrowest and the widest.
    """
    cameras, rows = mv.dcspect80(pixels=201), []
    b, length = cameras.source.norm(dim=-1), cameras.distance
    geometric = HOLE * (b + length) / length
    grid = mv.Grid.centred(3, spacing=0.3)
    point = torch.zeros(1, 1, 3, 3, 3, dtype=torch.float64)
    point[..., 1, 1, 1] = 1
    place = torch.arange(201, dtype=torch.float64)
    for name, m in (("narrowest", int(geometric.argmin())), ("widest", int(geometric.argmax()))):
        profile = Spect(grid, cameras[[m]], HOLE, blur=True)(point)[0, 0, 0].sum(dim=0)
        scale, mean = 50 / 201 * (b[m] / length[m]), (profile * place).sum() / profile.sum()
        spread = (profile * (place - mean) ** 2).sum() / profile.sum() - 1 / 12  # without a pixel
        line, chord = fwhm(profile) * scale, geometric[m] * math.sqrt(3) / 2
        rows += [
            row(f"width of a point, {name}", "mm", geometric[m], 4 * spread.sqrt() * scale),
            row(f"FWHM of a line, {name}", "mm", chord, line),
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
    """The attenuated central pixel of a filled ball, R = 100 mm, and the error over voxel sizes."""
    camera, parts = mv.dcspect80(pixels=33, field=2)[[0]], 8
    fine, phantom = camera.refined(parts), ball(100.0)
    counts = -torch.expm1(-MU * phantom.views(fine)) / MU * Hole(HOLE).weight(fine)
    exact = parts**2 * torch.nn.functional.avg_pool2d(counts, parts)
    weight, rows = Hole(HOLE).weight(camera)[0, 16, 16], []
    for n in (16, 32, 64, 128):
        grid = mv.Grid.centred(n, spacing=208.0 / n)
        x = voxelise(phantom, grid).double()
        y = Spect(grid, camera, HOLE, mu=MU * x)(x[None, None])[0, 0]
        error, central = (y - exact).norm() / exact.norm(), y[0, 16, 16] / weight
        found = {"error": f"{error:.5f}", "central_mm": f"{central:.3f}"}
        rows.append({"voxels": n, "method": "footprints", **found})
    expected, found = exact[0, 16, 16] / weight, float(rows[-2]["central_mm"])
    return row("central pixel of a filled ball", "mm", expected, found), rows


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
