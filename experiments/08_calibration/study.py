"""How exactly is a misaligned rig recovered, from markers and from the views alone?

`python experiments/08_calibration/study.py --size 32 --views 24 --out
experiments/08_calibration/results.csv`
"""

import argparse
import csv
import time
from functools import partial

import torch

from mvrecon.calibration.detection import centroids, helix
from mvrecon.calibration.from_data import shared_misalignment, view_shifts, without_motion
from mvrecon.calibration.markers import from_markers
from mvrecon.cameras.misalignment import Misalignment, misaligned, perturbed
from mvrecon.cameras.rigs import circular
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.projectors.drr import Drr
from mvrecon.scenes.shepp_logan import shepp_logan
from mvrecon.scenes.solids import Phantom, Solids

EDGE = 96.0  # mm of the grid


def blobs(grid, rig):
    """Line integrals of smooth blobs that the grid can hold, by the same operator."""
    rng = torch.Generator().manual_seed(1)
    places = 0.25 * EDGE * (2 * torch.rand(12, 3, generator=rng, dtype=torch.float64) - 1)
    centres = voxel_centres(grid)
    x = sum(torch.exp(-((centres - p) ** 2).sum(-1) / (2 * 7.0**2)) for p in places)
    return Drr(grid, rig)(x.float()[None, None])


def head(grid, rig):
    """Closed-form integrals of the Shepp-Logan phantom: sharp, with no grid behind them."""
    phantom = shepp_logan(0.4 * EDGE, value=0.03)
    fine = rig.refined(4)
    y = phantom.integrals(*fine.rays()).float()
    return torch.nn.functional.avg_pool2d(y, 4)[None, None]


def counted(y, photons):
    """Views with the noise of so many photons; line integrals scaled to at most 3."""
    y = y * (3 / y.max())
    if photons is None:
        return y
    rng = torch.Generator().manual_seed(0)
    return -torch.log(torch.poisson(photons * torch.exp(-y), generator=rng).clamp_min(1) / photons)


def from_views(size, views):
    """Rows of the table: shared offset and tilt, and shifts of single views, from the views."""
    grid = Grid.centred(size, spacing=EDGE / size)
    pitch = 1.6 * EDGE / size
    rig = circular(views, 400.0, 600.0, {"pixels": [size, size * 4 // 3], "pixel_mm": pitch})
    shared = Misalignment.none(1)
    shared.offset_px[0, 0], shared.tilt_degrees[0, 2] = 1.3, 0.7
    rng = torch.Generator().manual_seed(3)
    shifts = without_motion(rig, 0.7 * torch.randn(views, 2, generator=rng, dtype=torch.float64))
    single = Misalignment.none(views)._replace(offset_px=shifts)
    for scene in (blobs, head):
        for photons in (None, 1e4):
            start = time.perf_counter()
            y = counted(scene(grid, misaligned(rig, shared)), photons)
            got = shared_misalignment(partial(Drr, grid), rig, y).misalignment
            took = time.perf_counter() - start
            name = {"object": scene.__name__, "photons": photons or "no noise"}
            offset = abs(got.offset_px[0, 0].item() - 1.3)
            tilt = abs(got.tilt_degrees[0, 2].item() - 0.7)
            yield {**name, "from": "shared offset", "error": offset, "unit": "px", "s": took}
            yield {**name, "from": "shared tilt", "error": tilt, "unit": "degrees", "s": took}
            start = time.perf_counter()
            y = counted(scene(grid, misaligned(rig, single)), photons)
            got = view_shifts(partial(Drr, grid), rig, y).misalignment.offset_px
            rms = (got - shifts).square().mean().sqrt().item()
            took = time.perf_counter() - start
            yield {**name, "from": "shifts of views (rms)", "error": rms, "unit": "px", "s": took}


def from_balls(views):
    """Rows of the table: rays through markers, from views of steel-like balls of 1.5 mm radius."""
    plate = {"pixels": [192, 256], "pixel_mm": 0.75}
    ideal = circular(views, 400.0, 600.0, plate)
    rig = perturbed(ideal, offset_px=2.0, tilt_degrees=1.0, source_mm=1.0, seed=1)
    markers = helix(20, 30.0, 60.0, 1.7)
    turn = torch.eye(3, dtype=torch.float64).expand(len(markers), 3, 3)
    radii = torch.full((len(markers), 3), 1.5, dtype=torch.float64)
    values = torch.full((len(markers),), 0.3, dtype=torch.float64)
    phantom = Phantom((Solids("ellipsoid", markers, turn, radii, values),))
    for photons in (None, 1e4):
        start = time.perf_counter()
        y = torch.nn.functional.avg_pool2d(phantom.integrals(*rig.refined(3).rays()).float(), 3)
        y = counted(y[None, None], photons)[0, 0]
        uv = centroids(y, ideal.project(markers)[..., :2], radius_px=9.0)
        fit = from_markers(markers, uv, ideal.shape, (0.75, 0.75))
        error = (fit.cameras.project(markers) - rig.project(markers))[..., :2]
        rms = error.square().sum(dim=-1).mean().sqrt().item()
        took = time.perf_counter() - start
        name = {"object": "20 balls", "photons": photons or "no noise"}
        yield {**name, "from": "rays through markers (rms)", "error": rms, "unit": "px", "s": took}


def main():
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--out", default="results.csv")
    options = parser.parse_args()
    rows = []
    for row in (*from_balls(8), *from_views(options.size, options.views)):
        rows.append({**row, "error": f"{row['error']:.2g}", "s": f"{row['s']:.1f}"})
        print(rows[-1], flush=True)
    with open(options.out, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
