"""Where does geometry inside a network pay? One protocol for all arms and regimes.

    python experiments/12_geometry/study.py pace  # seconds of a step of each arm in each regime
    python experiments/12_geometry/study.py train --seconds 400  # every run that is not there yet
    python experiments/12_geometry/study.py table  # results.csv, paired.csv, curves.png

A run is a folder of `mvrecon-train`; one that broke off goes on, one that ended is skipped. Every
arm trains for the same processor time of one thread: steps = seconds / pace.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from itertools import product
from pathlib import Path
from typing import NamedTuple

import torch

from mvrecon.config import compose
from mvrecon.engine.fit import build_module

HERE = Path(__file__).parent
PACE = HERE / "pace.csv"
BASE = (
    "experiment=open_kbp_cross_view",
    "~compare.world_rounds",
    "~compare.world_unet",
    "scene.vary=exact",
    "data.sizes.train=648",
    "callbacks=quiet",
    "logger=csv",
)
NARROW = "rounds=[{resolution: full, widths: [16,32,64], cameras: null}]"
HALF = "{resolution: half, widths: [32,48,64]"
CAMERAS = "cameras: {name: rays2d}"

#: What differs between the models.
ARMS = {
    "cross_view": ("model=cross_view",),
    "no_opinions": ("model=cross_view", "model.rounds.0.opinions=null"),
    "one_round": (
        "model=cross_view",
        f"model.rounds=[{{resolution: full, widths: [16,32,64], {CAMERAS}}}]",
    ),
    "three_rounds": (
        "model=cross_view",
        f"model.rounds=[{HALF}, {CAMERAS}}}, {HALF}}}, {{resolution: full, widths: [16,32,64]}}]",
    ),
    "world_rounds": ("model=world_rounds",),
    "world_unet": ("model=world_unet", f"model.{NARROW}"),
}
ALIGNED = {
    "cross_view_aligned": ("model=corrected", "model@model.model=cross_view"),
    "world_unet_aligned": (
        "model=corrected",
        "model@model.model=world_unet",
        f"model.model.{NARROW}",
    ),
}
CLASSICAL = {
    "sirt": ("model=sirt", "model.iterations=25"),
    "sirt_aligned": ("model=corrected", "model@model.model=sirt", "model.model.iterations=25"),
    "tv": (
        "model=classical",
        "reconstructor@model.reconstructor=fista_tv",
        "model.reconstructor.weight=1e-4",
    ),
    "tv_aligned": (
        "model=corrected",
        "model@model.model=classical",
        "reconstructor@model.model.reconstructor=fista_tv",
        "model.model.reconstructor.weight=1e-4",
    ),
}


class Regime(NamedTuple):
    """What differs between the views of the regimes.

    Args:
        views: overrides of rig and acquisition.
        support: that the networks work in; a hull of views that err can cut into the object.
    """

    views: tuple[str, ...] = ()
    support: str = "hull"


def _disturbed(options: str) -> Regime:
    return Regime((f"acquisition={{disturbed: {{{options}}}}}",), "none")


REGIMES = {
    "clean": Regime(),
    "photons_1e4": Regime(("acquisition=photons", "acquisition.photons=1e4")),
    "photons_1e3": Regime(("acquisition=photons", "acquisition.photons=1e3"), "none"),
    "rig": _disturbed("views: 3, shift_px: 1.0, gain: 0.05"),
    "rig_one": _disturbed("views: 1, shift_px: 1.0, gain: 0.05"),
    "rig_all": _disturbed("views: 8, shift_px: 1.0, gain: 0.05"),
    "tilt": _disturbed("views: 3, tilt_deg: 5.0"),
    "motion": _disturbed("views: 3, motion_mm: 15.0"),
    "lost": _disturbed("views: 1, lost: 1"),
    "saturated": _disturbed("views: 3, saturated: 0.2"),
    "truncated": _disturbed("views: 1, truncated: 0.25"),
    "views_2": Regime(("camera.n_views=2",)),
    "views_3": Regime(("camera.n_views=3",)),
    "views_4": Regime(("camera.n_views=4",)),
    "views_16": Regime(("camera.n_views=16",)),
    "pixels_half": Regime(
        ("camera.detector.pixels=[96,96]", "camera.detector.pixel_mm=[9.0,10.0]")
    ),
    "pixels_third": Regime(
        ("camera.detector.pixels=[144,144]", "camera.detector.pixel_mm=[6.0,6.6667]")
    ),
}


def settings(regime: str, arm: str) -> list[str]:
    """The overrides of an arm in a regime."""
    views, support = REGIMES[regime]
    options = [*BASE, *(ARMS | ALIGNED | CLASSICAL)[arm], *views]
    if arm not in ARMS:  # options of the experiment's own model, which these have not
        options += ["~model.support", "~model.precision"]
    if arm in CLASSICAL:
        return options
    inside = "model.model" if arm in ALIGNED else "model"
    return [*options, f"{inside}.support={support}", f"{inside}.precision=auto"]


def paths(data: Path) -> list[str]:
    """The overrides that say where the patients lie."""
    files = ("scene.path", "openkbp_train.h5"), ("test_scene.path", "openkbp_val.h5")
    return [f"{key}={data / name}" for key, name in files]


def pace(options: argparse.Namespace) -> None:
    """Measure the processor seconds of a training step of each arm in each regime that was asked
    for; alignment is not in it, since it is computed once a case.
    """
    torch.set_num_threads(1)
    rows = _paces()
    for regime, arm in product(options.regimes, ARMS):
        run = compose(*settings(regime, arm), *paths(options.data))
        module = build_module(run, run["model"], 0.04)
        volume = torch.zeros(4, 1, 32, 32, 32)
        volume[:, :, 6:26, 8:24, 6:26] = 0.02
        views = module.projector(volume)
        batch = {"views": views, "volume": volume, "true_views": views}
        optimizer = torch.optim.AdamW(module.parameters(), 1e-4)
        times = []
        for _ in range(6):
            start = time.process_time()
            module._terms(module.model(views), batch)["total"].backward()
            optimizer.step()
            optimizer.zero_grad()
            times.append(time.process_time() - start)
        rows[regime, arm] = min(times[1:])
    with open(PACE, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("regime", "arm", "seconds_per_step"))
        writer.writerows((*key, f"{value:.3f}") for key, value in rows.items())


def _paces() -> dict[tuple[str, str], float]:
    if not PACE.exists():
        return {}
    with open(PACE, newline="") as file:
        return {(r["regime"], r["arm"]): float(r["seconds_per_step"]) for r in csv.DictReader(file)}


def steps(regime: str, arm: str, seconds: int) -> int:
    """Training steps of an arm in so many processor seconds."""
    return round(seconds / _paces()[regime, arm.removesuffix("_aligned")])


def train(options: argparse.Namespace) -> None:
    """Train every arm that was asked for and is not trained yet, one after the other."""
    for regime, arm, seed in product(options.regimes, options.arms, options.seeds):
        if "disturbed" not in "".join(REGIMES[regime].views) and arm.endswith("_aligned"):
            continue
        seconds = 0 if arm in CLASSICAL else options.seconds
        folder = options.runs / regime / arm / f"{seconds}s_{seed}"
        if (folder / "results.json").exists():
            continue
        count = max(1, steps(regime, arm, seconds)) if seconds else 1
        command = [sys.executable, "-m", "mvrecon.train", *settings(regime, arm)]
        command += [*paths(options.data), f"data.cache={options.runs / 'cases'}", f"seed={seed}"]
        command += [f"trainer.max_steps={count}", f"trainer.val_check_interval={min(count, 400)}"]
        command += [f"hydra.run.dir={folder}"]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def collected(runs: Path) -> list[dict]:
    """One row a run, with the PSNR of every patient."""
    rows = []
    for path in sorted(runs.glob("*/*/*/results.json")):
        regime, arm, run = path.relative_to(runs).parts[:3]
        seconds, seed = run.split("s_")
        result = next(iter(json.loads(path.read_text())["methods"].values()))
        rows.append(
            {
                "regime": regime,
                "arm": arm,
                "seconds": int(seconds),
                "seed": int(seed),
                "steps": result["train_steps"],
                "parameters": result["parameters"],
                **{
                    name: round(result[name]["mean"], 4)
                    for name in ("psnr", "psnr_inside", "ssim", "nrmse", "view_nrmse")
                },
                "ms_per_volume": round(result["ms_per_volume"]),
                "patients": " ".join(f"{value:.3f}" for value in result["psnr"]["values"]),
            }
        )
    return rows


def paired(rows: list[dict]) -> list[dict]:
    """Each arm less each world arm of the same regime, length and seed, patient by patient."""
    pairs = []
    for one, other in product(rows, rows):
        same = all(one[key] == other[key] for key in ("regime", "seconds", "seed"))
        if not same or one["arm"] == other["arm"] or not other["arm"].startswith("world"):
            continue
        a, b = (torch.tensor([float(v) for v in r["patients"].split()]) for r in (one, other))
        difference = a - b
        error = difference.std() / len(difference) ** 0.5
        pairs.append(
            {
                **{key: one[key] for key in ("regime", "seconds", "seed", "arm")},
                "over": other["arm"],
                "db": round(difference.mean().item(), 3),
                "half_95": round(1.96 * error.item(), 3),
                "ahead": int((difference > 0).sum()),
                "of": len(difference),
            }
        )
    return pairs


def curves(rows: list[dict], path: Path) -> None:
    """Mean PSNR against training time, a panel for each regime."""
    import matplotlib.pyplot as plt

    regimes = [name for name in REGIMES if any(r["regime"] == name for r in rows)]
    figure, panels = plt.subplots(1, len(regimes), figsize=(4.5 * len(regimes), 3.6), squeeze=False)
    for panel, regime in zip(panels[0], regimes, strict=True):
        lines = [row for row in rows if row["regime"] == regime]
        for arm in ARMS | ALIGNED:
            line = sorted((r["seconds"], r["psnr"]) for r in lines if r["arm"] == arm)
            if line:
                panel.plot(*zip(*line, strict=True), "o-", label=arm)
        for arm, style in zip(CLASSICAL, (":", "--", "-.", (0, (1, 4))), strict=True):
            level = [row["psnr"] for row in lines if row["arm"] == arm]
            if level:
                panel.axhline(level[0], color="grey", linestyle=style, label=arm)
        panel.set(title=regime, xlabel="processor seconds of training", ylabel="PSNR in dB")
        panel.set_xscale("log")
        panel.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def table(options: argparse.Namespace) -> None:
    """Write the rows of all runs, their paired differences, and the curves."""
    rows = collected(options.runs)
    for name, lines in (("results.csv", rows), ("paired.csv", paired(rows))):
        with open(HERE / name, "w", newline="") as file:
            writer = csv.DictWriter(file, list(lines[0]))
            writer.writeheader()
            writer.writerows(lines)
    curves(rows, HERE / "curves.png")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=("pace", "train", "table"))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the patients")
    parser.add_argument("--runs", type=Path, default=Path("outputs/12_geometry"))
    parser.add_argument("--regimes", nargs="+", choices=REGIMES, default=["clean", "rig"])
    every = [*ARMS, *ALIGNED, *CLASSICAL]
    parser.add_argument("--arms", nargs="+", choices=every, default=every)
    parser.add_argument("--seconds", type=int, default=400, help="of one thread, training")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    options = parser.parse_args()
    options.data, options.runs = options.data.resolve(), options.runs.resolve()
    {"pace": pace, "train": train, "table": table}[options.task](options)


if __name__ == "__main__":
    main()
