"""Classical rows of the study: SIRT, CGLS and TV on the grid, and on a grid twice as fine whose
voxels are then averaged; iterations and weights are the best of eight training patients.

    python experiments/12_geometry/classical.py --regimes clean rig  # classical.csv
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from arms import REGIMES, paths, settings
from torch.nn.functional import avg_pool3d

import mvrecon as mv
from mvrecon.config import compose
from mvrecon.engine.fit import build_data
from mvrecon.files.tables import renewed, write_rows
from mvrecon.metrics import volume_metrics

HERE = Path(__file__).parent
ROWS = (("sirt", 1), ("cgls", 1), ("fista_tv", 1), ("sirt", 2), ("fista_tv", 2))
WEIGHTS = (1e-4, 3e-4, 1e-3)
CHOICES = {
    "sirt": [{"iterations": n, "momentum": True} for n in (12, 25, 50, 100)],
    "cgls": [{"iterations": n} for n in (3, 6, 10, 15)],
    "fista_tv": [{"iterations": 100, "weight": w} for w in WEIGHTS],
}


class Row(NamedTuple):
    """A method on a grid `fine` times as fine, with `fine` rays each way in a pixel."""

    method: str
    fine: int
    options: dict[str, Any]

    def __call__(self, case: dict[str, Any], A: mv.LinearOperator) -> torch.Tensor:
        volume = getattr(mv, self.method)(A, case["views"], **self.options)
        return avg_pool3d(volume, self.fine)


def judged(
    row: Row, cases: list[dict[str, Any]], A: mv.LinearOperator, top: float
) -> list[dict[str, float]]:
    """Figures of merit of each case."""
    return [
        volume_metrics(row(case, A)[0], case["volume"][0], case["inside"][0], top) for case in cases
    ]


def rows(options: argparse.Namespace, regime: str) -> Iterator[dict[str, Any]]:
    """The best options of each method on training patients, and what they reach on the others."""
    sizes = (f"data.sizes={{train: 8, val: {options.tune}, test: 33}}", "data.batch_size=1")
    run = compose(*settings(REGIMES[regime], "sirt"), *paths(options.data), *sizes)
    data = build_data(run)
    data.prepare_data()
    data.setup("fit")
    data.setup("test")
    known, unseen = list(data.val_dataloader()), list(data.test_dataloader())
    for method, fine in ((method, fine) for method, fine in ROWS if fine in options.fine):
        A = mv.Drr(data.grid.refined(fine), data.cameras, rays_per_pixel=fine)
        trials = [Row(method, fine, choice) for choice in CHOICES[method]]
        best = max(trials, key=lambda row: mean(judged(row, known, A, data.data_range), "psnr"))
        scores = judged(best, unseen, A, data.data_range)
        figures = {name: f"{mean(scores, name):.4f}" for name in ("psnr", "psnr_inside", "ssim")}
        chosen = " ".join(f"{key}={value}" for key, value in best.options.items())
        patients = " ".join(f"{float(score['psnr']):.3f}" for score in scores)
        yield (
            {"regime": regime, "method": method, "fine": fine, "options": chosen}
            | figures
            | {"patients": patients}
        )


def mean(scores: list[dict], name: str) -> float:
    """Mean of a figure over the cases."""
    return sum(float(score[name]) for score in scores) / len(scores)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the patients")
    parser.add_argument("--regimes", nargs="+", choices=REGIMES, default=["clean", "rig"])
    parser.add_argument("--fine", nargs="+", type=int, choices=(1, 2), default=[1, 2])
    parser.add_argument("--tune", type=int, default=8, help="training patients to choose on")
    options = parser.parse_args()
    options.data = options.data.resolve()
    table: list[dict[str, Any]] = []
    path = HERE / "classical.csv"
    for regime in options.regimes:
        for row in rows(options, regime):
            table.append(row)
            write_rows(path, renewed(path, table, ("regime", "method", "fine")))


if __name__ == "__main__":
    main()
