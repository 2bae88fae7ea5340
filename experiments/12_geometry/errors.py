"""Networks of the regimes `rig` and `rig_cases` where cameras err by less or more than in their
training.

python experiments/12_geometry/errors.py  # errors.csv, errors.png
"""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from arms import Regime, paths, settings

import mvrecon as mv
from mvrecon.config import compose
from mvrecon.engine.fit import build_data
from mvrecon.files.tables import write_rows
from mvrecon.metrics import volume_metrics

HERE = Path(__file__).parent
SHIFTS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0)  # pixels, the greatest; gains err by 5 % a pixel
ARMS = ("cross_view", "world_unet", "one_round_aligned")


def cases_at(shift: float, data: Path) -> Iterable[dict[str, Any]]:
    """Unseen patients of whose eight views three are wrong by up to so many pixels."""
    views = f"acquisition={{disturbed: {{views: 3, shift_px: {shift}, gain: {0.05 * shift}}}}}"
    regime = Regime((views,) if shift else ())
    sizes = ("data.sizes={train: 4, val: 1, test: 33}", "data.batch_size=1")
    scenes = build_data(compose(*settings(regime, "sirt"), *paths(data), *sizes))
    scenes.prepare_data()
    scenes.setup("test")
    return scenes.test_dataloader()


def sirt(A: mv.LinearOperator) -> Callable[[torch.Tensor], torch.Tensor]:
    """25 iterations of SIRT with momentum."""
    return lambda views: mv.sirt(A, views, 25, momentum=True)


def longest(runs: Path) -> dict[str, Path]:
    """Of each arm the run of the longest training, of `rig_cases` where two are equal."""
    regimes = ("rig_cases", "rig")
    results = [file for name in regimes for file in runs.glob(f"{name}/*/*s_0/results.json")]
    folders = {arm: [file.parent for file in results if file.parts[-3] == arm] for arm in ARMS}
    return {arm: max(choice, key=seconds) for arm, choice in folders.items() if choice}


def seconds(folder: Path) -> int:
    """Processor seconds of a run's training."""
    return int(folder.name.split("s_")[0])


def rows(options: argparse.Namespace) -> Iterable[dict[str, Any]]:
    """Mean PSNR of every method at every size of the errors."""
    folders = longest(options.runs)
    networks = {arm: mv.load(folder) for arm, folder in folders.items()}
    methods = networks | {"sirt": sirt(next(iter(networks.values())).module.projector)}
    trained = {arm: seconds(folder) for arm, folder in folders.items()}
    for shift in SHIFTS:
        scores: dict[str, list[float]] = {arm: [] for arm in methods}
        for case in cases_at(shift, options.data):
            for arm, method in methods.items():
                volume, truth, inside = method(case["views"])[0], case["volume"][0], case["inside"]
                scores[arm].append(volume_metrics(volume, truth, inside[0], 0.04)["psnr"])
        for arm, values in scores.items():
            yield {
                "shift_px": shift,
                "method": arm,
                "trained_s": trained.get(arm, 0),
                "psnr": f"{sum(values) / len(values):.3f}",
                "patients": " ".join(f"{value:.3f}" for value in values),
            }


def draw(table: list[dict[str, Any]], path: Path) -> None:
    """Mean PSNR against the size of the errors."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5, 3.6))
    for method in dict.fromkeys(row["method"] for row in table):
        line = [(row["shift_px"], float(row["psnr"])) for row in table if row["method"] == method]
        axes.plot(*zip(*line, strict=True), "o-", label=method)
    axes.axvline(1.0, color="grey", linestyle=":")
    axes.set(xlabel="greatest shift in pixels (gain: 5 % a pixel)", ylabel="PSNR in dB")
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the patients")
    parser.add_argument("--runs", type=Path, default=Path("outputs/12_geometry"))
    options = parser.parse_args()
    options.data, options.runs = options.data.resolve(), options.runs.resolve()
    table = list(rows(options))
    write_rows(HERE / "errors.csv", table)
    draw(table, HERE / "errors.png")


if __name__ == "__main__":
    main()
