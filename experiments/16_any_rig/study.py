"""What does one network for any rig lose against one for each? Resumable, run by run.

python experiments/16_any_rig/study.py train --seconds 4800  # every run that is not there yet
python experiments/16_any_rig/study.py table  # results.csv
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import torch

HERE = Path(__file__).parent
#: Processor seconds of a training step, the mean over rigs.
STEP = 0.86
#: Cases, rigs and patients of the study, and of a trial of the script in a minute.
SIZES = {"whole": ("1920", "48", "33"), "trial": ("8", "2", "1")}


def overrides(options: argparse.Namespace, seed: int, rigs: int) -> list[str]:
    """The command line of a training, judged on the rig `seed`."""
    cases, _, patients = SIZES[options.size]
    steps = max(2, round(options.seconds / STEP))
    every = min(steps, 480)
    return [
        "experiment=any_rig",
        *(["~compare.sirt"] if rigs else []),
        f"camera.seed={seed}",
        f"data.rigs={rigs}",
        f"data.sizes={{train: {cases}, val: 1, test: {patients}}}",
        f"data.cache={options.runs / 'cases'}",
        f"scene.path={options.data / 'openkbp_train.h5'}",
        f"test_scene.path={options.data / 'openkbp_val.h5'}",
        f"trainer.max_steps={steps}",
        f"trainer.val_check_interval={every}",
        "callbacks=quiet",
        "logger=csv",
    ]


def run(app: str, folder: Path, *arguments: str) -> None:
    """One run of an app, unless it has ended already."""
    if (folder / "results.json").exists():
        return
    command = [sys.executable, "-m", f"mvrecon.{app}", *arguments, f"hydra.run.dir={folder}"]
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def train(options: argparse.Namespace) -> None:
    """Train the network for any rig, judge it on every rig, and train one for each rig."""
    whole = options.runs / "any"
    run("train", whole, *overrides(options, 0, int(SIZES[options.size][1])))
    for seed in options.rigs:
        folder = options.runs / str(seed)
        run("eval", folder / "any", f"checkpoint={whole}", f"+camera.seed={seed}")
        run("train", folder / "own", *overrides(options, seed, 0))


def psnr(path: Path, method: str) -> torch.Tensor:
    """PSNR in dB of every patient."""
    return torch.tensor(json.loads(path.read_text())["methods"][method]["psnr"]["values"])


def table(options: argparse.Namespace) -> None:
    """Write a row for each rig: the mean PSNR of each arm, and the paired difference."""
    with open(HERE / "results.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("rig", "views", "any_rig", "own_rig", "sirt", "any_less_own", "half_95"))
        for seed in options.rigs:
            folder = options.runs / str(seed)
            views = len(json.loads((folder / "own" / "rig.json").read_text())["cameras"])
            ours = psnr(folder / "any" / "results.json", "cross_view")
            own, sirt = (psnr(folder / "own" / "results.json", m) for m in ("cross_view", "sirt"))
            difference = ours - own
            half = 1.96 * difference.std() / len(difference) ** 0.5
            figures = (ours.mean(), own.mean(), sirt.mean(), difference.mean(), half)
            writer.writerow((seed, views, *(f"{value:.3f}" for value in figures)))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=("train", "table"))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the patients")
    parser.add_argument("--runs", type=Path, default=Path("outputs/16_any_rig"))
    parser.add_argument("--rigs", nargs="+", type=int, default=[1000, 2000, 3000], help="seeds")
    parser.add_argument("--seconds", type=float, default=4800, help="of one thread, training")
    parser.add_argument("--size", choices=SIZES, default="whole")
    options = parser.parse_args()
    options.data, options.runs = options.data.resolve(), options.runs.resolve()
    {"train": train, "table": table}[options.task](options)


if __name__ == "__main__":
    main()
