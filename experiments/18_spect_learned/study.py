"""What does a network gain on counts of SPECT, over OSEM and BSREM tuned for them?

    python experiments/18_spect_learned/study.py all --seconds 150  # these in turn:
    python experiments/18_spect_learned/study.py tune  # tuned.csv: OSEM and BSREM on other events
    python experiments/18_spect_learned/study.py pace  # pace.csv: seconds of a step of each arm
    python experiments/18_spect_learned/study.py train --totals 5e5 --seeds 0 1 2
    python experiments/18_spect_learned/study.py table  # results.csv, volumes.png

A run is a folder of `mvrecon-train`; one that broke off goes on, one that ended is skipped. Every
arm trains for the same processor time of one thread: steps = seconds / pace; an ablation for the
steps of the arm that it varies.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
from arms import ARMS, BASE, HEIGHT, MAIN, RADIUS, SUBSETS, WELLS

import mvrecon as mv
from mvrecon.config import compose
from mvrecon.data.module import TEST, SceneData
from mvrecon.engine.fit import build_data, build_module
from mvrecon.files.tables import read_rows, renewed, write_rows
from mvrecon.metrics import nrmse, volume_metrics
from mvrecon_spect.metrics.derenzo import valley_to_peak

HERE = Path(__file__).parent
WEIGHTS = (1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1)
ITERATIONS = 12

#: From counts of several cases to their volumes.
Method = Callable[[torch.Tensor], torch.Tensor]


class Classical(NamedTuple):
    """A method without training, and how far it is let run.

    Args:
        name: of the reconstructor.
        iterations: over all counts.
        options: others.
    """

    name: str
    iterations: int
    options: dict[str, Any]

    def __call__(self, A: Any, counts: torch.Tensor, monitor: Any = None) -> torch.Tensor:
        """The volumes of counts."""
        return getattr(mv, self.name)(A, counts, self.iterations, monitor=monitor, **self.options)


def settings(total: str, arm: str, options: argparse.Namespace) -> list[str]:
    """The overrides of an arm at a number of counts."""
    sizes = f"{{train: {options.cases}, val: 8, test: {options.events}}}"
    precision = [] if arm.startswith("mean_fusion") else ["model.precision=auto"]
    loading = [f"data.sizes={sizes}", f"data.cache={options.runs / 'cases'}"]
    return [*BASE, f"acquisition.counts={total}", *loading, *ARMS[arm], *precision]


def cases(part: str, total: str, options: argparse.Namespace) -> tuple[SceneData, dict[str, Any]]:
    """The data of a run, and its cases of one part as batches."""
    data = build_data(compose(*settings(total, "world_unet", options)))
    data.setup({"val": "validate", "test": "test"}[part])
    return data, data.sets[part].prepare()


def operator(options: argparse.Namespace) -> Any:
    """The operator of the study's rig."""
    run = compose(*settings("5e5", "world_unet", options))
    return build_module(run, run["model"], 1.0).projector


def tune(options: argparse.Namespace) -> None:
    """Write the error of OSEM and BSREM on validation cases after each iteration."""
    A, rows = operator(options), read_rows(HERE / "tuned.csv")
    trials = [Classical("osem", ITERATIONS, {"subsets": n}) for n in (1, SUBSETS)]
    for weight in WEIGHTS:
        trials.append(Classical("bsrem", ITERATIONS, {"subsets": SUBSETS, "weight": weight}))
    for total in options.totals:
        _, known = cases("val", total, options)
        rows = [row for row in rows if row["total"] != total]
        for trial in trials:
            how = {"total": total, "method": trial.name, "weight": "", **trial.options}
            for number, error in enumerate(errors(A, trial, known), 1):
                rows.append(how | {"iterations": number, "nrmse": f"{error:.5f}"})
    write_rows(HERE / "tuned.csv", rows)


def errors(A: Any, method: Classical, known: dict[str, Any]) -> list[float]:
    """Mean NRMSE of cases after each iteration."""
    means: list[float] = []

    def watch(iterate: Any) -> None:
        pairs = zip(iterate.volume, known["volume"], strict=True)
        means.append(sum(nrmse(x, truth) for x, truth in pairs) / len(known["volume"]))

    method(A, known["views"], watch)
    return means


def tuned(total: str) -> dict[str, Classical]:
    """The best of each method on validation cases, and OSEM as networks start from it."""
    rows = [row for row in read_rows(HERE / "tuned.csv") if row["total"] == total]
    chosen = {"osem, 5 iterations": Classical("osem", 5, {"subsets": SUBSETS})}
    for name in ("osem", "bsrem"):
        best = min((r for r in rows if r["method"] == name), key=lambda r: float(r["nrmse"]))
        more = {"weight": float(best["weight"])} if best["weight"] else {}
        options = {"subsets": int(best["subsets"]), **more}
        chosen[f"{name}, tuned"] = Classical(name, int(best["iterations"]), options)
    return chosen


def pace(options: argparse.Namespace) -> None:
    """Measure the processor seconds of a training step of each arm."""
    torch.set_num_threads(1)
    _, known = cases("val", "5e5", options)
    batch = {key: known[key][:2] for key in ("views", "volume", "inside")}
    rows = {row["arm"]: row["seconds_per_step"] for row in read_rows(HERE / "pace.csv")}
    for arm in options.arms:
        run = compose(*settings("5e5", arm, options))
        module, times = build_module(run, run["model"], 1.0), []
        optimizer = torch.optim.AdamW(module.parameters(), 1e-4)
        for _ in range(5):
            start = time.process_time()
            module.terms(batch)["total"].backward()
            optimizer.step()
            optimizer.zero_grad()
            times.append(time.process_time() - start)
        rows[arm] = f"{min(times[1:]):.3f}"
    write_rows(HERE / "pace.csv", [{"arm": k, "seconds_per_step": v} for k, v in rows.items()])


def train(options: argparse.Namespace) -> None:
    """Train every arm that was asked for and is not trained yet, one after the other."""
    paces = {row["arm"]: float(row["seconds_per_step"]) for row in read_rows(HERE / "pace.csv")}
    for seed, total, arm in product(options.seeds, options.totals, options.arms):
        folder = options.runs / total / arm / f"{options.seconds}s_{seed}"
        if (folder / "results.json").exists():
            continue
        varied = arm.removesuffix("_density").removesuffix("_own")
        count = max(2, round(options.seconds / paces[varied]))
        command = [sys.executable, "-m", "mvrecon.train", *settings(total, arm, options)]
        command += [f"seed={seed}", f"trainer.max_steps={count}", f"hydra.run.dir={folder}"]
        command += [f"trainer.val_check_interval={min(count, 200)}"]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def figures(volumes: torch.Tensor, data: SceneData, known: dict[str, Any]) -> dict[str, str]:
    """Means over the cases: error, PSNR, activity in the wells and beside them relative to the true
    one in the wells, and the share of resolved pairs of wells by their diameter.
    """
    sums: dict[str, list[float]] = {}
    for index, (x, truth) in enumerate(zip(volumes, known["volume"], strict=True)):
        inside = known["inside"][index]
        whole = volume_metrics(x, truth, inside, data.data_range)
        wells, empty = truth > 0.5, truth == 0
        values = {name: whole[name] for name in ("nrmse", "psnr", "ssim")}
        values["recovery"] = (x[wells].mean() / truth[wells].mean()).item()
        values["spill"] = (x[empty].mean() / truth[wells].mean()).item()
        pose = data.scenes["test"].parameters(index, TEST, data.grid)
        place = [pose[f"{axis}_mm"] for axis in "xyz"]
        turn = [pose[f"{angle}_degrees"] for angle in ("phi", "theta", "psi")]
        for sector in valley_to_peak(x[0], data.grid, WELLS, RADIUS, HEIGHT, place, turn):
            if len(sector.ratios):
                values[f"resolved_{sector.diameter:g}mm"] = sector.resolved
        for name, value in values.items():
            sums.setdefault(name, []).append(value)
    return {name: f"{sum(values) / len(values):.4f}" for name, values in sums.items()}


def methods(total: str, options: argparse.Namespace) -> dict[tuple[str, int, int], Method]:
    """What the table compares at a number of counts, by name, seconds and seed."""
    A = operator(options)
    entries: dict[tuple[str, int, int], Method] = {}
    for name, method in tuned(total).items():
        entries[name, 0, 0] = lambda counts, method=method: method(A, counts)
    for path in sorted(options.runs.glob(f"{total}/*/*/results.json")):
        seconds, seed = path.parent.name.split("s_")
        trained = mv.load(path.parent)
        entries[path.parent.parent.name, int(seconds), int(seed)] = trained
    return entries


def table(options: argparse.Namespace) -> None:
    """Write a row for each method, and a picture of one case at each number of counts; rows of runs
    that are no longer there stay.
    """
    rows, pictures = [], {}
    for total in options.totals:
        data, known = cases("test", total, options)
        pictures[total] = {"truth": known["volume"][0, 0]}
        for (name, seconds, seed), method in methods(total, options).items():
            volumes = torch.cat([method(one) for one in known["views"].split(1)])
            row = {"total": total, "method": name, "seconds": seconds, "seed": seed}
            rows.append(row | figures(volumes, data, known))
            pictures[total][name] = volumes[0, 0]
    keys = ("total", "method", "seconds", "seed")
    write_rows(HERE / "results.csv", renewed(HERE / "results.csv", rows, keys))
    draw(pictures, HERE / "volumes.png")


def draw(pictures: dict[str, dict[str, torch.Tensor]], file: Path) -> None:
    """The brightest slice of a case by every method, and its difference from the truth."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(dict.fromkeys(name for row in pictures.values() for name in row))
    shape = 2 * len(pictures), len(names)
    figure, axes = pyplot.subplots(
        *shape, figsize=(1.9 * shape[1], 2.1 * shape[0]), squeeze=False, layout="constrained"
    )
    for row, (total, volumes) in enumerate(pictures.items()):
        truth = volumes["truth"]
        k = int(truth.sum(dim=(1, 2)).argmax())
        for column, name in enumerate(names):
            image, difference = axes[2 * row : 2 * row + 2, column]
            image.set_axis_off(), difference.set_axis_off()
            if name in volumes:
                image.imshow(volumes[name][k], cmap="gray_r", vmin=0, vmax=1, origin="lower")
                image.set_title(f"{name}\n{total} counts", fontsize=7)
                error = (volumes[name] - truth)[k]
                difference.imshow(error, cmap="RdBu_r", vmin=-0.7, vmax=0.7, origin="lower")
    figure.savefig(file, dpi=110)


def main() -> None:
    """Entry point."""
    tasks = {"tune": tune, "pace": pace, "train": train, "table": table}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=(*tasks, "all"))
    parser.add_argument("--runs", type=Path, default=Path("outputs/18_spect_learned"))
    parser.add_argument("--totals", nargs="+", default=["5e5"], help="counts: 5e4 5e5 5e6")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=MAIN)
    parser.add_argument("--seconds", type=int, default=150, help="of one thread, training")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--cases", type=int, default=512, help="events that training sees")
    parser.add_argument("--events", type=int, default=16, help="unseen events of the table")
    options = parser.parse_args()
    options.runs = options.runs.resolve()
    for name in tasks if options.task == "all" else [options.task]:
        tasks[name](options)


if __name__ == "__main__":
    main()
