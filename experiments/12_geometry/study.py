"""Where does geometry inside a network pay? One protocol for all arms and regimes.

    python experiments/12_geometry/study.py pace  # seconds of a step of each arm in each regime
    python experiments/12_geometry/study.py train --seconds 400  # every run that is not there yet
    python experiments/12_geometry/study.py table  # results.csv, paired.csv, curves.png

A run is a folder of `mvrecon-train`; one that broke off goes on, one that ended is skipped. Every
arm trains for the same processor time of one thread, steps = seconds / pace; an ablation for the
steps of the arm that it varies.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from contextlib import suppress
from itertools import product
from pathlib import Path
from statistics import fmean, median

import torch
from arms import ABLATIONS, ARMS, CLASSICAL, EVERY, OTHERS, REGIMES, paths, settings

from mvrecon.config import compose
from mvrecon.engine.fit import build_data, build_module
from mvrecon.engine.module import ReconstructionModule
from mvrecon.files.tables import read_rows, renewed, write_rows

HERE = Path(__file__).parent
PACE = HERE / "pace.csv"
#: What a row is about.
KEYS = ("regime", "arm", "seconds", "seed")
#: What arms are compared with.
AGAINST = (
    "cross_view",
    "one_round",
    "world_rounds",
    "world_unet",
    "world_unet_finer",
    "world_unet_missed",
    "world_unet_aligned",
)


def pace(options: argparse.Namespace) -> None:
    """Measure the processor seconds of a batch's reconstruction and of a training step of each arm
    in each regime that was asked for, medians over real cases; alignment is not in it, since it is
    computed once a case.
    """
    torch.set_num_threads(1)
    rows = _paces()
    cases = ("data.sizes={train: 24, val: 1, test: 1}", f"data.cache={options.runs / 'cases'}")
    for regime, arm in product(
        options.regimes, (arm for arm in ARMS | OTHERS if arm in options.arms)
    ):
        run = compose(*settings(REGIMES[regime], arm), *paths(options.data), *cases)
        data = build_data(run)
        data.prepare_data()
        data.setup("fit")
        module = build_module(run, run["model"], data.data_range)
        seconds = _seconds(module, data.train_dataloader())
        rows[regime, arm] = {name: f"{value:.3f}" for name, value in seconds.items()}
        keyed = ((dict(zip(("regime", "arm"), key, strict=True)), rows[key]) for key in rows)
        write_rows(PACE, [key | values for key, values in keyed])


def _seconds(module: ReconstructionModule, batches: Iterable[dict]) -> dict[str, float]:
    """Median processor time of a training step and of a reconstruction; the first of either makes
    the geometry and does not count."""
    optimizer = torch.optim.AdamW(module.parameters(), 1e-4)
    steps, forward = [], []
    for batch in batches:
        start = time.process_time()
        module.terms(batch)["total"].backward()
        optimizer.step()
        optimizer.zero_grad()
        steps.append(time.process_time() - start)
        start = time.process_time()
        with torch.inference_mode():
            module.model(batch["views"])
        forward.append(time.process_time() - start)
    return {"seconds_per_step": median(steps[1:]), "seconds_forward": median(forward[1:])}


def _paces() -> dict[tuple[str, str], dict[str, str]]:
    """Of each regime and arm, the measured seconds by their names."""
    return {(row.pop("regime"), row.pop("arm")): row for row in read_rows(PACE)}


def steps(regime: str, arm: str, seconds: int) -> int:
    """Training steps of an arm in so many processor seconds."""
    same = "cross_view" if arm in ABLATIONS else re.sub("_(aligned|finer|missed)$", "", arm)
    paces = _paces()[REGIMES[regime].pace, same]
    return round(seconds / float(paces["seconds_per_step"]))


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
        command = [sys.executable, "-m", "mvrecon.train", *settings(REGIMES[regime], arm)]
        command += [*paths(options.data), f"data.cache={options.runs / 'cases'}", f"seed={seed}"]
        command += [f"trainer.max_steps={count}", f"trainer.val_check_interval={min(count, 400)}"]
        command += [f"hydra.run.dir={folder}", *REGIMES[regime].start(options.runs, arm, seed)]
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
    """Each arm less each world arm, `cross_view` and `one_round`, of the same regime, length and
    seed, patient by patient.
    """
    pairs = []
    for one, other in product(rows, rows):
        same = all(one[key] == other[key] for key in ("regime", "seconds", "seed"))
        if not same or one["arm"] == other["arm"] or other["arm"] not in AGAINST:
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
    """Mean PSNR over patients and seeds against training time, a panel for each regime with several
    lengths; ablations are in the table alone.
    """
    import matplotlib.pyplot as plt

    arms = [arm for arm in EVERY if arm not in CLASSICAL | ABLATIONS]
    spectrum = plt.get_cmap("nipy_spectral", len(arms) + 1)
    colours = {arm: spectrum(place) for place, arm in enumerate(arms)}
    trained = {(r["regime"], r["seconds"]) for r in rows if r["seconds"]}
    lengths = Counter(regime for regime, _ in trained)
    regimes = [name for name in REGIMES if lengths[name] > 1]
    figure, panels = plt.subplots(1, len(regimes), figsize=(6 * len(regimes), 3.6), squeeze=False)
    for panel, regime in zip(panels[0], regimes, strict=True):
        lines = [row for row in rows if row["regime"] == regime]
        for arm in arms:
            seeds = defaultdict(list)
            for row in (row for row in lines if row["arm"] == arm):
                seeds[row["seconds"]].append(row["psnr"])
            line = sorted((seconds, fmean(values)) for seconds, values in seeds.items())
            if line:
                panel.plot(*zip(*line, strict=True), "o-", color=colours[arm], label=arm)
        for arm, style in zip(CLASSICAL, (":", "--", "-.", (0, (1, 4))), strict=True):
            level = [row["psnr"] for row in lines if row["arm"] == arm]
            if level:
                panel.axhline(level[0], color="grey", linestyle=style, label=arm)
        panel.set(title=regime, xlabel="processor seconds of training", ylabel="PSNR in dB")
        panel.set_xscale("log")
        panel.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def table(options: argparse.Namespace) -> None:
    """Write the rows of all runs, their paired differences, and the curves; rows of runs that are
    no longer there stay.
    """
    lines = renewed(HERE / "results.csv", collected(options.runs), KEYS)
    rows = [{key: _number(str(line[key])) for key in line} for line in lines]
    rows.sort(key=lambda row: [row[key] for key in KEYS])
    for name, lines in (("results.csv", rows), ("paired.csv", paired(rows))):
        write_rows(HERE / name, lines)
    curves(rows, HERE / "curves.png")


def _number(text: str) -> int | float | str:
    """A cell of a table as the number that it shows, or else as it is."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=("pace", "train", "table"))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the patients")
    parser.add_argument("--runs", type=Path, default=Path("outputs/12_geometry"))
    parser.add_argument("--regimes", nargs="+", choices=REGIMES, default=["clean", "rig"])
    parser.add_argument("--arms", nargs="+", choices=EVERY, default=list(EVERY))
    parser.add_argument("--seconds", type=int, default=400, help="of one thread, training")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    options = parser.parse_args()
    options.data, options.runs = options.data.resolve(), options.runs.resolve()
    {"pace": pace, "train": train, "table": table}[options.task](options)


if __name__ == "__main__":
    main()
