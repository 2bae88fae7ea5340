"""The shipped network `any_rig` on unseen rigs, on faulty views and on other objects than patients,
compared with SIRT and FISTA-TV, whose best number of iterations and weight are chosen with the
ground truth of each case:
python experiments/16_any_rig/domains.py data experiments/16_any_rig/domains.csv
"""

import sys

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.core.parts import SCENES
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.report.metrics import psnr

#: Seeds of rigs, which the training of `experiment=any_rig` (1 to 48) does not contain.
RIGS = range(100, 106)
RIG = {"pixels": [32, 48], "sid": [700.0, 1300.0], "magnification": [1.3, 1.8]}
FIELD = [576.0, 640.0]
GRID = {"size": (32, 32, 32), "spacing": (16.0, 10.0, 12.0)}
ITERATIONS = (12, 25, 50, 100, 200)
WEIGHTS = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
CASES = 2
#: The faults of the network's training, but in three views of every case.
FAULTS = {"views": 3, "shift_px": 1.0, "gain": 0.05, "tilt_deg": 3.0, "motion_mm": 10.0}


@torch.no_grad()
def main(folder: str, out: str) -> None:
    """Reconstruct cases of each scene with each rig by all methods.

    Args:
        folder: with the files of scripts/data/prepare_openkbp.py.
        out: CSV file to write.
    """
    trained, grid, rows = mv.load("any_rig"), mv.Grid.centred(**GRID), []
    patients = SCENES.build("hdf5", path=f"{folder}/openkbp_val.h5", orientation="LPI")
    faulty = Acquisition.of({"disturbed": FAULTS})
    scenes = {
        "patients": patients,
        "patients, 3 wrong views": Acquired(patients, acquisition=faulty),
        "ellipsoids": SCENES.build("ellipsoids"),
        "rods": SCENES.build("derenzo"),
    }
    for seed in RIGS:
        cameras = mv.random_rig(seed=seed, n_views=[6, 14], field_mm=FIELD, **RIG)
        A = mv.Drr(grid, cameras)
        for name, scene in scenes.items():
            for case in range(CASES):
                sample = scene.sample(case, seed, grid, cameras)
                views, truth = sample.views[None], sample.volume[None]
                level = truth.max().item()

                def error(volume: Tensor, truth=truth, level=level) -> float:
                    return psnr(volume, truth, truth > 0, level)

                sirt = {n: error(mv.sirt(A, views, n, momentum=True)) for n in ITERATIONS}
                row = {"scene": name, "rig": seed, "views": len(cameras), "case": case}
                row["any_rig"] = error(trained(views, cameras, grid))
                row["without_fallback"] = error(trained(views, cameras, grid, fallback=False))
                row |= {"sirt": max(sirt.values()), "sirt_12": sirt[12]}
                row["fista_tv"] = max(
                    error(mv.fista_tv(A, views, weight=w * level, iterations=60)) for w in WEIGHTS
                )
                rows.append({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()})
    write_rows(out, rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
