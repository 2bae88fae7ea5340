"""Filtered back-projection of patients who are wider than the panel, compared with that of a panel
that sees them whole.

python experiments/30_scan_effects/bodies.py openkbp_val.h5 experiments/30_scan_effects
"""

import sys
import warnings
from pathlib import Path

import h5py
import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.attenuation import WATER
from mvrecon.geometry.grid import voxel_centres

VOXEL_MM, COLUMNS = 4.0, 184
SLICE = mv.Grid.centred(size=(128, 128, 1), spacing=VOXEL_MM)
SLICES, PANELS = (32, 64), (0.55, 0.75)
#: Least voxels of a body in a slice.
MIN_VOXELS = 1500
#: Voxels of air, in 1/mm, and the radius compared, relative to that of the field.
AIR, COMPARED = 0.2 * WATER, 0.95


def operator(beam: str, columns: int, grid: mv.Grid) -> mv.LinearOperator:
    """Views of one row, over half a turn of parallel beams or a turn of fans."""
    if beam == "parallel":
        rig = mv.parallel(180, {"pixels": [1, columns], "pixel_mm": VOXEL_MM})
        return mv.Radon(grid, rig)
    detector = {"pixels": [1, columns], "pixel_mm": VOXEL_MM * 1000 / 700}
    return mv.Drr(grid, mv.circular(240, 700.0, 1000.0, detector))


def main(path: Path, folder: Path) -> None:
    rows = []
    with h5py.File(path) as file:
        numbers = torch.from_numpy(file["ct"][::3, SLICES]).float()  # every third patient
    for number, slices in enumerate((1 + numbers / 1000).clamp_min(0) * WATER):
        for place, mu in zip(SLICES, slices, strict=True):
            mu = torch.where(mu > AIR, mu, 0)[None, None, None]
            body = mu[0, 0, 0] > AIR
            if body.sum() < MIN_VOXELS:
                continue
            width = max(int(body.any(dim=axis).sum()) for axis in (0, 1))
            for beam in ("parallel", "fan"):
                views = operator(beam, COLUMNS, SLICE)(mu)
                for share in PANELS:
                    columns = int(width * share) // 2 * 2
                    first = (COLUMNS - columns) // 2
                    seen = views[..., first : first + columns].contiguous()
                    n = int(0.94 * columns)
                    grid = mv.Grid.centred(size=(n, n, 1), spacing=VOXEL_MM)
                    whole = mv.fdk(operator(beam, COLUMNS, grid), views)
                    inside = voxel_centres(grid).norm(dim=-1) < COMPARED * n * VOXEL_MM / 2
                    for extrapolate in (False, True):
                        volume = mv.fdk(
                            operator(beam, columns, grid), seen, extrapolate=extrapolate
                        )
                        error = 100 * (volume - whole)[0, 0][inside] / WATER
                        rows.append(
                            {
                                "patient": 3 * number,
                                "slice": place,
                                "beam": beam,
                                "panel": share,
                                "extrapolate": str(extrapolate).lower(),
                                "mean": f"{error.mean():.2f}",
                                "q95": f"{error.abs().quantile(0.95):.2f}",
                            }
                        )
    write_rows(folder / "bodies.csv", rows)


if __name__ == "__main__":
    warnings.simplefilter("ignore", UserWarning)  # views end inside the patients
    main(Path(sys.argv[1]), Path(sys.argv[2]))
