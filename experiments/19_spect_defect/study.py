"""A defect of the left ventricle in SPECT: contrast, contrast to noise, count bias, polar maps.

python experiments/19_spect_defect/study.py OUT_FOLDER
"""

import sys
from pathlib import Path
from typing import NamedTuple

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.geometry.rigid import euler_rotation
from mvrecon_spect.apps.polarmap import draw_maps
from mvrecon_spect.methods.bsrem import bsrem
from mvrecon_spect.metrics.contrast import contrast_to_noise, count_bias, defect_contrast
from mvrecon_spect.metrics.polar_map import LongAxis, polar_map
from mvrecon_spect.operators.projector import Spect
from mvrecon_spect.scenes.cardiac import RandomCardiac

GRID = mv.Grid.centred(size=(54, 42, 42), spacing=6.0, centre=(42, -42, 0))
CAMERAS, CASE, SEED, LOST = mv.dcspect80(pixels=32), 2, 0, 0.6
TOTALS, DRAWS = (5e5, 5e6), 2
#: Label: reconstructor, its options, and whether it knows the attenuation.
METHODS = {
    "osem, no attenuation": (mv.osem, {"iterations": 4, "subsets": 8}, False),
    "osem, 20 subsets": (mv.osem, {"iterations": 3, "subsets": 20}, True),
    "osem, 8 subsets": (mv.osem, {"iterations": 4, "subsets": 8}, True),
    "bsrem, weight 0.003": (bsrem, {"iterations": 6, "subsets": 8, "weight": 0.003}, True),
}


class Patient(NamedTuple):
    """One patient on GRID.

    Args:
        truth: activity, and views of it as a perfect detector counts them.
        views: see `truth`.
        mu: attenuation in 1/mm.
        wall: voxels of the left ventricle's wall without the defect.
        defect: those of the defect.
        axis: of the left ventricle.
    """

    truth: torch.Tensor
    views: torch.Tensor
    mu: torch.Tensor
    wall: torch.Tensor
    defect: torch.Tensor
    axis: LongAxis


def patient() -> Patient:
    """A patient whose defect has lost 60 % of the wall's uptake, and the same one without it."""
    ill = RandomCardiac(defects=1.0, contrast=(LOST, LOST))
    well = RandomCardiac(defects=1.0, contrast=(0.0, 0.0))
    fine = ill.finer(CASE, SEED, GRID, CAMERAS, 2)
    A = Spect(GRID.refined(2), CAMERAS, mu=ill.maps(CASE, SEED, GRID, 2)["mu"][0])
    truth, healthy = (
        scene.pooled(CASE, SEED, GRID, CAMERAS, scene.finer(CASE, SEED, GRID, CAMERAS, 2)).volume[0]
        for scene in (ill, well)
    )
    lost, wall = (healthy - truth) / LOST, healthy > 0.8
    numbers = ill.parameters(CASE, SEED, GRID)
    angles = [numbers[f"{name}_degrees"] for name in ("phi", "theta", "psi")]
    R = euler_rotation(angles, "zyz")
    base = torch.tensor([numbers[f"{name}_mm"] for name in "xyz"], dtype=torch.float64)
    apex = base + numbers["length_mm"] * R[:, 2]
    axis = LongAxis(base.tolist(), apex.tolist(), R[:, 0].tolist())
    mu = ill.maps(CASE, SEED, GRID)["mu"][0]
    return Patient(truth, A(fine[None]), mu, wall & (lost < 0.1), wall & (lost > 0.7), axis)


def measure(out: Path) -> None:
    """A row for each total, draw of noise and method; the table is written after each."""
    case, rows = patient(), []
    maps = [{"truth": polar_map(case.truth, GRID, case.axis, 45.0)}, {}]
    operators = {known: Spect(GRID, CAMERAS, mu=case.mu if known else None) for known in (0, 1)}
    rows.append({"counts": "", "draw": "", "method": "truth"} | figures(case.truth, case))
    for total, of_total in zip(TOTALS, maps, strict=True):
        scale = total / case.views.sum().item()
        for draw in range(DRAWS):
            noise = torch.Generator().manual_seed(draw)
            counts = torch.poisson(scale * case.views, generator=noise)
            for label, (method, options, known) in METHODS.items():
                x = method(operators[known], counts, **options)[0, 0] / scale
                if draw == 0:
                    named = label.replace("osem", "OSEM").replace("bsrem", "BSREM")
                    title = f"{named},\n{total:.0e} counts".replace(", ", "\n")
                    of_total[title] = polar_map(x, GRID, case.axis, 45.0)
                names = {"counts": f"{total:.0e}", "draw": draw, "method": label}
                rows.append(names | figures(x, case))
                write_rows(out / "results.csv", rows)
    draw_maps(out / "polar_maps.png", maps)


def figures(x: torch.Tensor, case: Patient) -> dict[str, str]:
    """Contrast of the defect, contrast to noise of the wall above it, bias of the wall's counts."""
    values = {
        "defect_contrast": defect_contrast(x, case.defect, case.wall),
        "contrast_to_noise": contrast_to_noise(x, case.wall, case.defect),
        "wall_bias": count_bias(x, case.truth, case.wall),
    }
    return {name: f"{value:.3f}" for name, value in values.items()}


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    measure(folder)
