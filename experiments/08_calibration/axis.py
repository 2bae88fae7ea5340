"""How exactly does `calibrate=[offset_u]` find the axis of rotation of noisy views?

`python experiments/08_calibration/axis.py experiments/08_calibration/axis.csv`
"""

import math
import sys
import warnings
from itertools import product

import torch

import mvrecon as mv
from mvrecon.apps import correction
from mvrecon.apps.progress import Bar
from mvrecon.apps.scan import Scan, ViewsInMemory
from mvrecon.core.files.runs import write_rows
from mvrecon.data.scenes.solids import Phantom, Solids

COLUMNS, ROWS, VIEWS, PHOTONS, CASES = 192, 24, 120, 2e4, 20
#: Share of the detector's width by which it is aside, and the object's radius relative to that of a
#: centred detector's field: a half panel sees 6 to 17 columns beyond the axis.
ASIDE = {"half acquisition": 0.3, "half panel": 0.44}
WIDER = {"half acquisition": 1.4, "half panel": 1.6, "truncated": 1.4}
ARCS = (
    "full turn",
    "half turn",
    "half acquisition",
    "half panel",
    "full turn, truncated",
    "half turn, truncated",
)


def phantom(rng, radius, height):
    """An upright elliptic cylinder with eight ellipsoids in it, all places and sizes random."""

    def draw(low, high, *size):
        return low + (high - low) * torch.rand(*size, generator=rng, dtype=torch.float64)

    body = torch.cat([draw(0.6, 0.9, 2) * radius, torch.tensor([10 * height])])
    angle, far = draw(0, 2 * math.pi, 8), draw(0, 0.5, 8) * radius
    centres = torch.stack([far * angle.cos(), far * angle.sin(), draw(-0.3, 0.3, 8) * height], 1)
    radii, values = draw(0.04, 0.2, 8, 3) * radius, draw(-0.8, 2, 8) / radius
    outer = Solids.upright("cylinder", torch.zeros(1, 3), body[None], torch.tensor([1.2 / radius]))
    return Phantom((outer, Solids.upright("ellipsoid", centres, radii, values)))


def scan(beam, arc, seed):
    """Views with Poisson noise of a random object, whose detector is aside by some pixels: the scan
    with the nominal rig, and that offset.
    """
    rng = torch.Generator().manual_seed(seed)
    half, rows = COLUMNS / 2, ROWS if beam == "cone" else 1
    far = (3 + 2 * torch.rand(1, generator=rng).item()) * half
    degrees = 360.0
    if arc.startswith("half turn"):
        degrees = 180.0 if beam == "parallel" else 190 + 2 * math.degrees(math.asin(half / far))
    if beam == "parallel":
        rig = mv.parallel(VIEWS, {"pixels": [rows, COLUMNS], "pixel_mm": 1.0}, arc_degrees=degrees)
    else:
        panel = {"pixels": [rows, COLUMNS], "pixel_mm": 1.5}
        rig = mv.circular(VIEWS, far, 1.5 * far, panel, arc_degrees=degrees)
    radius = 0.9 * half * WIDER.get(arc.split(", ")[-1], 1)
    rig = rig.shifted(torch.tensor([[ASIDE.get(arc, 0.0) * COLUMNS, 0.0]]))
    offset = 10 * torch.rand(1, generator=rng).item() - 5
    true = rig.shifted(torch.tensor([[offset, 0.0]]))
    y = phantom(rng, radius, float(ROWS)).views(true, 2).float()
    y = -(torch.poisson(PHOTONS * (-y).exp(), generator=rng).clamp_min(1) / PHOTONS).log()
    across = math.ceil(2 * radius)
    grid = mv.Grid.centred(size=(across, across, rows), spacing=1.0)
    projector = {"name": "radon" if beam == "parallel" else "drr"}
    measured = ViewsInMemory(y, torch.ones_like(y, dtype=torch.bool))
    return Scan(measured, rig, grid, projector), offset


def main(out):
    """Entry point."""
    rows = []
    for seed, beam, arc in product(range(CASES), ("parallel", "fan", "cone"), ARCS):
        case, offset = scan(beam, arc, seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # what is kept is a column
            _, fit = correction.calibrate(case, ["offset_u"], "cpu", Bar())
        error = fit.misalignment.offset_px[0, 0].item() - offset
        within = "" if fit.kept else f"{fit.uncertainty['offset_u']:.4f}"
        row = {"beam": beam, "arc": arc, "seed": seed, "offset, px": f"{offset:.3f}"}
        row |= {"error, px": f"{error:.4f}", "uncertainty, px": within}
        rows.append({**row, "kept": " ".join(fit.kept)})
        print(rows[-1], flush=True)
        write_rows(out, rows)


if __name__ == "__main__":
    main(sys.argv[1])
