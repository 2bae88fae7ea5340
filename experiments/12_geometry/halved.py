"""What a perfect reconstruction on voxels twice as wide would have: the truth averaged over 2 x 2 x
2 voxels and interpolated back, against the truth. Less than that needs detail of single voxels.

python experiments/12_geometry/halved.py --regimes clean rig_64 rig_128  # halved.csv
"""

import argparse
from pathlib import Path
from statistics import fmean

from arms import REGIMES, paths, settings
from torch.nn.functional import avg_pool3d, interpolate

from mvrecon.config import compose
from mvrecon.engine.fit import build_data
from mvrecon.files.tables import write_rows
from mvrecon.metrics import volume_metrics

HERE = Path(__file__).parent
FIGURES = ("psnr", "psnr_inside")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the patients")
    parser.add_argument("--runs", type=Path, default=Path("outputs/12_geometry"))
    parser.add_argument("--regimes", nargs="+", choices=REGIMES, default=["rig_128"])
    options = parser.parse_args()
    rows = []
    for regime in options.regimes:
        overrides = settings(REGIMES[regime], "world_unet")
        cache = f"data.cache={options.runs / 'cases'}"
        data = build_data(compose(*overrides, *paths(options.data), cache))
        data.setup("test")
        figures = [figures_of(case, data.data_range) for case in data.sets["test"]]
        means = {name: f"{fmean(one[name] for one in figures):.3f}" for name in FIGURES}
        rows.append({"regime": regime, "patients": len(figures), **means})
        write_rows(HERE / "halved.csv", rows)


def figures_of(case: dict, data_range: float) -> dict[str, float]:
    """Figures of the halved truth of a case."""
    truth = case["volume"]
    coarse = interpolate(avg_pool3d(truth[None], 2), scale_factor=2, mode="trilinear")[0]
    return volume_metrics(coarse, truth, case["inside"], data_range)


if __name__ == "__main__":
    main()
