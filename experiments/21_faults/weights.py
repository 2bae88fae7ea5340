"""What could weights of cameras gain? SIRT in which faulty cameras count less, by the truth:
python experiments/21_faults/weights.py data experiments/21_faults/weights.csv
"""

import sys

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.module import SceneData
from mvrecon.methods.calibration.self_alignment import self_aligned
from mvrecon.methods.classical.sirt import SirtWeights, inverse_sums, sirt, sirt_weights

CAMERA = {
    "name": "circular",
    "n_views": 8,
    "arc_degrees": 180.0,
    "sid": 1000.0,
    "sdd": 1500.0,
    "detector": {"pixels": [48, 48], "pixel_mm": [18.0, 20.0]},
}
FAULTS = {
    "views": 3,
    "shift_px": 1.0,
    "gain": 0.05,
    "tilt_deg": 3.0,
    "motion_mm": 10.0,
    "lost": 1,
    "probability": 0.5,
}
MEASUREMENT = {
    "grid": {"size": [32, 32, 32], "spacing": [16.0, 10.0, 12.0]},
    "camera": CAMERA,
    "projector": {"name": "drr"},
    "acquisition": {"disturbed": FAULTS},
}


@torch.no_grad()
def main(folder: str, out: str) -> None:
    """Reconstruct every test case of `experiment=open_kbp_faults` with several weights.

    Args:
        folder: with the files of scripts/data/prepare_openkbp.py.
        out: CSV file to write.
    """
    scenes = {
        part: {"name": "hdf5", "orientation": "LPI", "path": f"{folder}/openkbp_{file}.h5"}
        for part, file in (("train", "train"), ("test", "val"))
    }
    data = SceneData(scenes, MEASUREMENT, sizes={"train": 8, "val": 8, "test": 33})
    data.setup("test")
    A, rows = mv.Drr(data.grid, data.cameras), []
    row, _ = sirt_weights(A)
    for case, batch in enumerate(data.test_dataloader()):
        aligned, by = self_aligned(A, batch["views"])
        filled = by.gain == 0  # a lost view is replaced by the projection of the others' volume
        for name, views, wrong in (
            ("as measured", batch["views"], batch["wrong"].bool()),
            ("aligned", aligned, batch["wrong"].bool() & ~filled),
        ):
            for weight in (1.0, 0.3, 0.1, 0.0):
                share = torch.where(wrong, weight, 1.0)[:, None, :, None, None].expand_as(views)
                weights = SirtWeights(row * share, inverse_sums(A.T(share.contiguous())))
                volume = sirt(A, views, 25, weights=weights, momentum=True)
                error = (volume - batch["volume"]).square().mean().sqrt()
                psnr = 20 * torch.log10(data.data_range / error).item()
                rows.append({"case": case, "views": name, "weight": weight, "psnr": round(psnr, 4)})
    write_rows(out, rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
