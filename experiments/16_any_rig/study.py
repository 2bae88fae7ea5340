"""What does one network for any rig lose against one for each? Resumable, run by run.

python experiments/16_any_rig/study.py train --own 1000  # every run that is not there yet
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

from mvrecon.parts import CAMERAS

HERE = Path(__file__).parent
#: Settings of a trial of the script in a minute.
TRIAL = ("data.sizes={train: 8, val: 1, test: 1}", "data.rigs=2")
TRIAL_STEPS = ("trainer.max_steps=2", "trainer.val_check_interval=2")


def overrides(options: argparse.Namespace, seed: int, rigs: bool) -> list[str]:
    """The command line of a training, judged on the rig `seed`."""
    return [
        "experiment=any_rig",
        *(["~compare.sirt"] if rigs else []),
        *((*TRIAL, *TRIAL_STEPS) if options.trial else ()),
        f"camera.seed={seed}",
        *([] if rigs else ["data.rigs=0"]),
        f"data.cache={options.runs / 'cases'}",
        f"scene.path={options.data / 'openkbp_train.h5'}",
        f"test_scene.path={options.data / 'openkbp_val.h5'}",
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
    """Train the network for any rig, judge it and SIRT on every rig, and train one for each rig of
    `own`.
    """
    whole = options.runs / "any"
    run("train", whole, *overrides(options, 0, rigs=True))
    sirt = "{name: sirt, iterations: 25, momentum: true}"
    compared = f"+compare.sirt={{name: classical, reconstructor: {sirt}}}"
    for seed in options.rigs:
        folder = options.runs / str(seed)
        run("eval", folder / "any", f"checkpoint={whole}", f"+camera.seed={seed}", compared)
        if seed in options.own:
            run("train", folder / "own", *overrides(options, seed, rigs=False))


def psnr(path: Path, method: str) -> torch.Tensor:
    """PSNR in dB of every patient."""
    return torch.tensor(json.loads(path.read_text())["methods"][method]["psnr"]["values"])


def table(options: argparse.Namespace) -> None:
    """Write a row for each rig: the mean PSNR of each arm, and the paired difference."""
    with open(HERE / "results.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("rig", "views", "any_rig", "sirt", "own_rig", "any_less_own", "half_95"))
        for seed in options.rigs:
            folder = options.runs / str(seed)
            settings = json.loads((folder / "any" / "results.json").read_text())["geometry"]
            views = len(CAMERAS.from_config(settings["camera"]))
            ours, sirt = (psnr(folder / "any" / "results.json", m) for m in ("cross_view", "sirt"))
            row = [seed, views, f"{ours.mean():.3f}", f"{sirt.mean():.3f}"]
            if (own := folder / "own" / "results.json").exists():
                alone = psnr(own, "cross_view")
                difference = ours - alone
                half = 1.96 * difference.std() / len(difference) ** 0.5
                row += [f"{v:.3f}" for v in (alone.mean(), difference.mean(), half)]
            writer.writerow(row)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=("train", "table"))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the patients")
    parser.add_argument("--runs", type=Path, default=Path("outputs/16_any_rig"))
    parser.add_argument("--rigs", nargs="+", type=int, default=[1000, 2000, 3000], help="seeds")
    parser.add_argument(
        "--own", nargs="*", type=int, default=[], help="rigs with their own network"
    )
    parser.add_argument("--trial", action="store_true", help="a few steps on a few cases")
    options = parser.parse_args()
    options.data, options.runs = options.data.resolve(), options.runs.resolve()
    {"train": train, "table": table}[options.task](options)


if __name__ == "__main__":
    main()
