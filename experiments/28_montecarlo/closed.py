"""Footprints over closed forms and over an independent integration over a finite hole.

PYTHONPATH=plugins/mvrecon-spect/tests python experiments/28_montecarlo/closed.py TABLE.csv
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from test_footprints import (
    BLOBS,
    BLUR,
    FIELDS,
    WIDTHS,
    blob_errors,
    body_totals,
    excess_widths,
    over_law,
)

from mvrecon.core.files.runs import write_rows

#: Figures and the values expected of them.
SENSITIVITY = "sensitivity of one camera over the law"
WIDTH = "excess variance of a blob's view, pitch^2 / 12"
SHAPE, TOTAL = "view of a blob, hole {} mm: L2 error", "view of a blob: total over truth"
BODY = "body of activity and water: total over truth"
EXPECTED = {
    SENSITIVITY: "0.997 to 1.003",
    WIDTH: "-0.1 to 0.1",
    SHAPE.format(2.3): "up to 0.012",
    TOTAL: "0.999 to 1.001",
    BODY: "0.996 to 1.004",
}


def figures() -> Iterator[tuple[str, str, list[float]]]:
    """Figure, case and values."""
    for name, (rig, grid) in FIELDS.items():
        for model, options in (("plain", {}), ("blur", BLUR)):
            ratios = [over_law(camera, grid, options) for camera in rig]
            ends = [end(ratio).item() for ratio in ratios for end in (torch.amin, torch.amax)]
            yield SENSITIVITY, f"{name}, {model}", ends
    for pixels, voxel, n in WIDTHS:
        for hole in (2.3, 4.0):
            for intrinsic in (0.0, 2.0):
                case = f"{pixels}^2, voxels of {voxel} mm, hole {hole} mm, intrinsic {intrinsic} mm"
                yield WIDTH, case, excess_widths(pixels, voxel, n, hole, intrinsic)
    for name, (camera, centre) in BLOBS.items():
        for hole in (2.3, 4.0):
            error, total = blob_errors(camera, centre, hole)
            yield SHAPE.format(hole), name, [error]
            yield TOTAL, f"{name}, hole {hole} mm", [total]
    yield BODY, "three sides", body_totals()


def main(table: Path) -> None:
    """The least and the greatest value of each case."""
    rows = []
    for figure, case, values in figures():
        ends = {"least": f"{min(values):.4f}", "greatest": f"{max(values):.4f}"}
        rows.append({"figure": figure, "case": case} | ends | {"expected": EXPECTED.get(figure)})
    write_rows(table, rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
