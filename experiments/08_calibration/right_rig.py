"""Does a calibration leave a correct rig unchanged?

`python experiments/08_calibration/right_rig.py experiments/08_calibration/right_rig.csv`
"""

import sys
import warnings
from functools import partial

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.core.parts import SCENES

EDGE, SIZE, VIEWS = 96.0, 32, 60  # mm and voxels of the grid
OBJECTS = ("shepp_logan", "ellipsoids", "derenzo")
FREE = (
    ("slant",),
    ("offset_v",),
    ("offset_u", "offset_v", "tilt", "slant", "swivel"),
    ("offset_u", "tilt"),
    ("shifts",),
    ("gains",),
)


def scans():
    """Rows of the table: exact views of a correct rig, reconstructed with it and with the fitted
    one.
    """
    grid = mv.Grid.centred(SIZE, spacing=EDGE / SIZE)
    panel = {"pixels": [SIZE * 5 // 4, SIZE * 4 // 3], "pixel_mm": 1.6 * EDGE / SIZE}
    rig = mv.circular(VIEWS, 400.0, 600.0, panel)
    for name in OBJECTS:
        scene = SCENES.build(name).sample(0, 0, grid, rig)
        y, truth = scene.views[None], scene.volume[None]

        def error(cameras, y=y, truth=truth):
            x = mv.cgls(mv.Drr(grid, cameras), y, 12)
            return ((x - truth).norm() / truth.norm()).item()

        nominal = error(rig)
        for free in FREE:
            fit = mv.calibrated(partial(mv.Drr, grid), rig, y, free)
            by = fit.misalignment
            corrected = y / fit.gains[:, None, None].float()
            yield {
                "object": name,
                "free": " ".join(free),
                "error, nominal rig": f"{nominal:.4f}",
                "error, fitted rig": f"{error(fit.cameras, corrected):.4f}",
                "offset, px (largest)": f"{by.offset_px.abs().max():.3f}",
                "turn, degrees (largest)": f"{by.tilt_degrees.abs().max():.3f}",
                "rounds": len(fit.residual) - 1,
                "kept": " ".join(fit.kept),
            }


if __name__ == "__main__":
    warnings.simplefilter("ignore", UserWarning)  # what is kept is a column
    write_rows(sys.argv[1], list(scans()))
