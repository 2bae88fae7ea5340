"""What the sanity checks of a rig say about random scans with a right rig, with a wrong one and
with other faults, and how little a scan tells of the distance to its detector.

python experiments/30_scan_effects/checks.py experiments/30_scan_effects
"""

import re
import sys
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.apps.rig_checks import SomeViews, better_rig, coarse_grid
from mvrecon.apps.scan import Scan, ViewsInMemory
from mvrecon.core.files.runs import write_rows
from mvrecon.core.numbers import uniform
from mvrecon.data.scenes.phantoms import shepp_logan
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.field import auto_grid
from mvrecon.geometry.cameras.random_rigs import Misalignment, misaligned
from mvrecon.report.metrics import nrmse

SCANS, FIELD = 400, 52.0
HEAD = shepp_logan(0.8 * FIELD, value=0.03)
#: Faults of the rig that the checks look for, with the words that name each, and other faults.
NAMES = {
    "columns reversed": ["does the rig turn the other way"],
    "axes exchanged": ["with their axes exchanged"],
    "axis aside": ["calibrate=[offset_u]"],
    "range of angles": ["are the angles or camera.arc_degrees wrong"],
    "axis and range": ["calibrate=[offset_u]", "are the angles or camera.arc_degrees wrong"],
}
OTHERS = ("object moves", "tilt", "gains", "sdd 10 % long")
ALL_WORDS = {words for several in NAMES.values() for words in several}


def one_of(rng: torch.Generator, values):
    return values[int(torch.randint(len(values), (), generator=rng))]


def rig_of(beam: str, count: int, arc: float, sdd: float = 600.0) -> mv.Cameras:
    """Cones and stacks of 40 rows and 52 columns, fans and single rows of 104."""
    pixels = [40, 52] if beam in ("cone", "parallel stack") else [1, 104]
    pitch = 2 * FIELD / pixels[1]
    if beam.startswith("parallel"):
        panel = {"pixels": pixels, "pixel_mm": pitch}
        return mv.parallel(count, panel, arc_degrees=arc, depth_mm=900.0)
    panel = {"pixels": pixels, "pixel_mm": 1.5 * pitch}
    return mv.circular(count, 400.0, sdd, panel, arc_degrees=arc)


def ellipsoids(rng: torch.Generator, high: bool, wider: float = 1.0) -> Phantom:
    """Random ellipsoids in a larger one, as wide as 0.6 to 0.95 fields times a factor."""
    height = 34.0 if high else 400.0
    parts = [(0.0, 0.0, 0.0, *(FIELD * uniform(rng, 0.6, 0.95) for _ in "xy"), height, 0.02)]
    for _ in range(3 + int(uniform(rng, 0, 5))):
        x, y = (FIELD * uniform(rng, -0.5, 0.5) for _ in "xy")
        radii = [FIELD * uniform(rng, 0.06, 0.25) for _ in "xyz"]
        parts.append((x, y, uniform(rng, -15, 15), *radii, uniform(rng, -0.015, 0.03)))
    x, scale = torch.tensor(parts).double(), torch.tensor([wider, wider, 1.0]).double()
    return Phantom((Solids.upright("ellipsoid", scale * x[:, :3], scale * x[:, 3:6], x[:, 6]),))


def checked(seed: int) -> dict:
    """A random scan, and what is said of it."""
    rng = torch.Generator().manual_seed(seed)
    kind = ("right rig", "wrong rig", "right rig", "wrong rig", "other fault")[seed % 5]
    beam = one_of(rng, ("cone", "fan", "parallel", "parallel stack"))
    one_row = beam in ("fan", "parallel")
    arc, count = one_of(rng, (180.0, 360.0)), int(uniform(rng, 40, 120))
    true_arc = arc if beam.startswith("parallel") else max(arc, 205.0)
    rig = rig_of(beam, count, true_arc)
    wide = uniform(rng, 0, 1) < 0.25  # a part of the object is beside the panel
    phantom = ellipsoids(rng, not one_row, 1.6 if wide else 1.0)
    if not wide and uniform(rng, 0, 1) < 0.25:
        phantom = HEAD
    fault = ""
    if kind == "wrong rig":
        barred = [
            *["axes exchanged"] * one_row,
            *["columns reversed"] * beam.startswith("parallel"),
        ]
        fault = one_of(rng, [name for name in NAMES if name not in barred])
    if kind == "other fault":
        barred = [*["tilt"] * one_row, *["sdd 10 % long"] * beam.startswith("parallel")]
        fault = one_of(rng, [name for name in OTHERS if name not in barred])

    true, stated, aside = rig, rig, 0.0
    if fault in ("axis aside", "axis and range"):
        aside = one_of(rng, (-1, 1)) * rig.shape[1] * uniform(rng, 0.03, 0.12)
        true = rig.shifted(torch.tensor([[aside, 0.0]]))
    if fault in ("range of angles", "axis and range"):
        stated = rig_of(beam, count, 540.0 - arc)
    if fault == "tilt":
        by = Misalignment.none(count)
        by.tilt_degrees[:] = uniform(rng, 1, 3)
        true = misaligned(rig, by)
    if fault == "sdd 10 % long":
        stated = rig_of(beam, count, true_arc, 660.0)
    views = phantom.views(true).float()
    if fault == "object moves":
        moved = phantom.moved(torch.eye(3).double(), torch.tensor([6.0, 3.0, 0.0]).double())
        views[count // 2 :] = moved.views(true)[count // 2 :]
    if fault == "gains":
        views = views * (1 + 0.1 * torch.randn(count, 1, 1, generator=rng))
    noise = one_of(rng, (0.0, 0.01, 0.03))
    views = views + noise * views.max() * torch.randn(views.shape, generator=rng)
    mask = torch.ones_like(views, dtype=torch.bool)
    if uniform(rng, 0, 1) < 0.25:
        mask[:, :, int(uniform(rng, 0, rig.shape[1]))] = False
    if uniform(rng, 0, 1) < 0.25:
        views[int(uniform(rng, 0, count))] = 0
    if fault == "columns reversed":
        views, mask = views.flip(-1), mask.flip(-1)
    if fault == "axes exchanged":
        views, mask, stated = views.mT, mask.mT, stated.transposed()

    name = "radon" if stated.parallel else "drr"
    scan = Scan(ViewsInMemory(views, mask), stated, auto_grid(stated, seen_by=0.5), {"name": name})
    words = better_rig(SomeViews.of(scan, coarse_grid(scan))) or ""
    return {
        "seed": seed,
        "kind": kind,
        "fault": fault,
        "beam": beam,
        "arc": true_arc,
        "views": count,
        "wide": int(wide),
        "noise": noise,
        "said": answer(fault, aside, words),
        "words": words,
    }


def answer(fault: str, aside: float, words: str) -> str:
    """Whether words name a fault, a part of it, it among others, or something else."""
    if not words:
        return "nothing"
    expected = NAMES.get(fault, [])
    right = [one in words for one in expected]
    found = re.search(r"detector ([+-][\d.]+) pixels aside", words)
    if "axis" in fault and found and abs(float(found[1]) - aside) > 2:
        right[0] = False
    if "do not tell" in words:
        return "among several" if any(right) else "another fault"
    if any(one in words for one in ALL_WORDS - set(expected)) or not any(right):
        return "another fault"
    return "named" if all(right) else "in part"


def distances() -> list[dict]:
    """View NRMSE of FDK and of SIRT, 30 iterations, by the stated distance to the detector."""
    rows = []
    for beam in ("cone", "fan"):
        rig = rig_of(beam, 60, 360.0)
        rng = torch.Generator().manual_seed(0)
        objects = {"head": HEAD} | {
            f"ellipsoids {n}": ellipsoids(rng, beam == "cone") for n in (1, 2)
        }
        for name, phantom in objects.items():
            y = phantom.views(rig)[None, None].float()
            for factor in (0.9, 0.95, 1.0, 1.1, 1.2, 1.3):
                stated = rig_of(beam, 60, 360.0, 600.0 * factor)
                A = mv.Drr(auto_grid(stated), stated)
                left = {
                    "fdk": nrmse(A(mv.fdk(A, y)), y),
                    "sirt": nrmse(A(mv.sirt(A, y, 30)), y),
                }
                row = {"beam": beam, "object": name, "sdd, stated over true": factor}
                rows.append(row | {method: round(value, 4) for method, value in left.items()})
    return rows


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    write_rows(folder / "checks.csv", [checked(seed) for seed in range(SCANS)])
    write_rows(folder / "distances.csv", distances())
