"""How exactly is a misaligned rig recovered, from markers and from the views alone?

`python experiments/08_calibration/study.py experiments/08_calibration/results.csv`
"""

import sys
from functools import partial

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.scenes.phantoms import shepp_logan
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned, perturbed
from mvrecon.geometry.grid import voxel_centres
from mvrecon.methods.calibration.from_data import without_motion
from mvrecon.methods.calibration.markers import centroids, helix

EDGE, SIZE, VIEWS = 96.0, 32, 24  # mm and voxels of the grid
NOISE = [(None, 0), (1e4, 0), (1e4, 1), (1e4, 2)]  # photons and seed


def blobs(grid, rig):
    """Line integrals of smooth blobs that the grid can hold, by the same operator."""
    rng = torch.Generator().manual_seed(1)
    places = 0.25 * EDGE * (2 * torch.rand(12, 3, generator=rng, dtype=torch.float64) - 1)
    centres = voxel_centres(grid)
    x = sum(torch.exp(-((centres - p) ** 2).sum(-1) / (2 * 7.0**2)) for p in places)
    return mv.Drr(grid, rig)(x.float()[None, None])


def head(grid, rig):
    """Closed-form integrals of the Shepp-Logan phantom: sharp, with no grid behind them."""
    return shepp_logan(0.4 * EDGE, value=0.03).views(rig, 4)[None, None].float()


def counted(y, photons, seed):
    """Views with the noise of so many photons; line integrals scaled to at most 3."""
    y = y * (3 / y.max())
    if photons is None:
        return y
    rng = torch.Generator().manual_seed(seed)
    return -torch.log(torch.poisson(photons * torch.exp(-y), generator=rng).clamp_min(1) / photons)


def from_views():
    """Rows of the table: what all views share, and shifts and gains of single views."""
    grid = mv.Grid.centred(SIZE, spacing=EDGE / SIZE)
    panel = {"pixels": [SIZE, SIZE * 4 // 3], "pixel_mm": 1.6 * EDGE / SIZE}
    rig = mv.circular(VIEWS, 400.0, 600.0, panel)
    shared = Misalignment.none(VIEWS)
    shared.offset_px[:, 0], shared.tilt_degrees[:, 2] = 1.3, 0.7
    rng = torch.Generator().manual_seed(3)
    noise = torch.randn(VIEWS, 3, generator=rng, dtype=torch.float64)
    single = Misalignment.none(VIEWS)._replace(offset_px=without_motion(rig, 0.7 * noise[:, :2]))
    gains = (0.03 * (noise[:, 2] - noise[:, 2].mean())).exp()
    every = torch.ones_like(gains)
    for scene in (blobs, head):
        for by, factors, free in (
            (shared, every, ["offset_u", "tilt"]),
            (single, gains, ["shifts", "gains"]),
        ):
            views_of = scene(grid, misaligned(rig, by)) * factors[:, None, None].float()
            for photons, seed in NOISE:
                y = counted(views_of, photons, seed)
                fit = mv.calibrated(partial(mv.Drr, grid), rig, y, free)
                name = {"object": scene.__name__, "photons": photons or "no noise", "seed": seed}
                for what, error, unit in errors(fit, by, factors, free):
                    yield {**name, "from": what, "error": error, "unit": unit}


def errors(fit, by, gains, free):
    """What was fitted, its error and its unit."""
    offset = fit.misalignment.offset_px - by.offset_px
    if "shifts" in free:
        offset = without_motion(fit.cameras, offset)
        yield "shifts of views (rms)", offset.square().mean().sqrt().item(), "px"
        yield "gains of views (rms)", 100 * (fit.gains / gains - 1).square().mean().sqrt(), "%"
        return
    tilt = fit.misalignment.tilt_degrees - by.tilt_degrees
    yield "shared offset", offset[0, 0].abs().item(), "px"
    yield "shared tilt", tilt[0, 2].abs().item(), "degrees"


def from_balls(views):
    """Rows of the table: rays through markers, from views of steel-like balls of 1.5 mm radius."""
    plate = {"pixels": [192, 256], "pixel_mm": 0.75}
    ideal = mv.circular(views, 400.0, 600.0, plate)
    rig = perturbed(ideal, offset_px=2.0, tilt_degrees=1.0, source_mm=1.0, seed=1)
    markers = helix(20, 30.0, 60.0, 1.7)
    radii, values = torch.full_like(markers, 1.5), torch.full_like(markers[:, 0], 0.3)
    phantom = Phantom((Solids.upright("ellipsoid", markers, radii, values),))
    exact = phantom.views(rig, 3)[None, None].float()
    for photons, seed in NOISE:
        y = counted(exact, photons, seed)[0, 0]
        uv = centroids(y, ideal.project(markers)[..., :2], radius_px=9.0)
        fit = mv.from_markers(markers, uv, ideal.shape, (0.75, 0.75))
        error = (fit.cameras.project(markers) - rig.project(markers))[..., :2]
        rms = error.square().sum(dim=-1).mean().sqrt().item()
        name = {"object": "20 balls", "photons": photons or "no noise", "seed": seed}
        yield {**name, "from": "rays through markers (rms)", "error": rms, "unit": "px"}


if __name__ == "__main__":
    rows = (*from_balls(8), *from_views())
    write_rows(sys.argv[1], [row | {"error": f"{float(row['error']):.2g}"} for row in rows])
