"""What do the plugin's experiments of SPECT show, with OSEM and BSREM tuned for each?

python experiments/20_dcspect/study.py tune   # tuned.csv: OSEM and BSREM on validation cases
python experiments/20_dcspect/study.py table  # results.csv, volumes.png, of runs that ended
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from mvrecon.engine.on_case import OwnAttenuation, reconstructed

from mvrecon.config import compose
from mvrecon.engine.evaluation import load_methods
from mvrecon.engine.fit import build_data, methods
from mvrecon.engine.module import build_projector
from mvrecon.engine.run_folder import read_settings
from mvrecon.files.tables import read_rows, write_rows
from mvrecon.metrics import nrmse
from mvrecon.parts import RECONSTRUCTORS

HERE = Path(__file__).parent
NAMES = ("cardiac", "ct", "derenzo", "derenzo_blurred", "labels")
#: Runs of `cardiac` with another loss, in the table alone.
OTHER_LOSSES = ("cardiac_mean", "cardiac_heart")
#: Of 16 cameras, the root of their number.
SUBSETS = 4
TRIALS: tuple[dict[str, Any], ...] = (
    {"name": "osem", "subsets": 1},
    {"name": "osem", "subsets": SUBSETS},
    *({"name": "bsrem", "subsets": SUBSETS, "weight": w} for w in (3e-3, 1e-2, 3e-2, 1e-1)),
)
#: Figures of the table, and the digits that their spread allows.
FIGURES = {"nrmse": 3, "psnr": 2, "ssim": 3, "view_nrmse": 3}


def settings_of(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """The settings of an experiment, its cases kept beside its runs."""
    return compose(f"experiment=dcspect_{name}", f"data.cache={options.runs / 'cases'}")


def operators(run: dict[str, Any], batch: dict[str, Any]) -> Iterator[Any]:
    """The operator of each case of a batch."""
    A = build_projector(run["grid"], run["camera"], run["projector"])
    if isinstance(A, OwnAttenuation):
        yield from (one for one, _ in A.of_cases(batch))
    else:
        yield from [A] * len(batch["views"])


def tune(options: argparse.Namespace) -> None:
    """Write the mean error of OSEM and BSREM on validation cases after each iteration."""
    for name in options.names:
        run = settings_of(name, options)
        data = build_data(run)
        data.setup("validate")
        batch = data.sets["val"].prepare()
        pairs = zip(operators(run, batch), batch["views"], batch["volume"], strict=True)
        cases = [(A, views[None], truth) for A, views, truth in pairs]
        rows = [row for row in read_rows(HERE / "tuned.csv") if row["experiment"] != name]
        for trial in TRIALS:
            how = {"experiment": name, "method": trial["name"], "subsets": trial["subsets"]}
            how["weight"] = trial.get("weight", "")
            for number, error in enumerate(errors(trial, cases, options.iterations), 1):
                rows.append({**how, "iterations": number, "nrmse": f"{error:.4f}"})
        write_rows(HERE / "tuned.csv", rows)


def errors(
    trial: dict[str, Any], cases: list[tuple[Any, torch.Tensor, torch.Tensor]], iterations: int
) -> list[float]:
    """Mean NRMSE of cases after each iteration."""
    sums = torch.zeros(iterations)
    for A, views, truth in cases:
        own: list[float] = []

        def watch(iterate: Any, own: list[float] = own, truth: torch.Tensor = truth) -> None:
            own.append(nrmse(iterate.volume[0], truth))

        how = {**trial, "iterations": iterations}
        RECONSTRUCTORS.from_config(how, A, views, monitor=watch)
        sums += torch.tensor(own)
    return (sums / len(cases)).tolist()


def table(options: argparse.Namespace) -> None:
    """Write a row for each method of each run that ended, and one case of each by all of them."""
    rows, pictures = [], {}
    for name in (*options.names, *OTHER_LOSSES):
        folder = options.runs / name
        if not (folder / "results.json").exists():
            print(f"{folder} has no results.json: not trained yet", file=sys.stderr)
            continue
        results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
        models = methods(read_settings(folder))
        for label, own in results["methods"].items():
            known = models[label].get("reconstructor", {})
            row = {"experiment": name, "method": label, "steps": own["train_steps"]}
            row |= {"iterations": known.get("iterations", "")}
            row |= {key: f"{own[key]['mean']:.{n}f}" for key, n in FIGURES.items()}
            row |= {"train_seconds": round(own["train_seconds"])}
            rows.append(row | {"ms_per_volume": round(own["ms_per_volume"])})
        if name in options.names:
            pictures[name] = case_of(folder)
    write_rows(HERE / "results.csv", rows)
    draw(pictures, HERE / "volumes.png")


@torch.no_grad()
def case_of(folder: Path) -> dict[str, torch.Tensor]:
    """The first test case of a run and what every method makes of it."""
    run = read_settings(folder)
    run["data"]["sizes"]["test"] = 1
    data = build_data(run)
    data.setup("test")
    case = next(iter(data.test_dataloader()))
    batch = {key: value[:1] for key, value in case.items()}
    volumes = {"truth": batch["volume"][0, 0]}
    for label, method in load_methods(run, folder, data.data_range).items():
        volumes[label] = reconstructed(method.module.own, batch).volume[0, 0]
    return volumes


def draw(pictures: dict[str, dict[str, torch.Tensor]], file: Path) -> None:
    """The slice of a case that has most, by every method."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    width = max(len(volumes) for volumes in pictures.values())
    shape = len(pictures), width
    figure, axes = pyplot.subplots(
        *shape, figsize=(1.8 * width, 1.9 * shape[0]), squeeze=False, layout="constrained"
    )
    for one in axes.flat:
        one.set_axis_off()
    for row, (name, volumes) in zip(axes, pictures.items(), strict=True):
        truth = volumes["truth"]
        k = int(truth.square().sum(dim=(1, 2)).argmax())
        for one, (label, volume) in zip(row, volumes.items(), strict=False):
            one.imshow(volume[k], cmap="gray_r", vmin=0, vmax=truth.max(), origin="lower")
            one.set_title(f"{name}: {label}", fontsize=7)
    figure.savefig(file, dpi=110)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=("tune", "table"))
    parser.add_argument("--names", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--runs", type=Path, default=Path("outputs/20_dcspect"))
    parser.add_argument("--iterations", type=int, default=16, help="of tune, at most")
    options = parser.parse_args()
    options.runs = options.runs.resolve()
    {"tune": tune, "table": table}[options.task](options)


if __name__ == "__main__":
    main()
