"""Networks, BSREM and OSEM on counts behind pinholes, with correct and with faulty cameras.

    python experiments/22_dcspect/study.py tune RUN_FOLDER... experiments/22_dcspect/tuning.csv
    python experiments/22_dcspect/study.py cases RUN_FOLDER... experiments/22_dcspect/cases.csv
    python experiments/22_dcspect/study.py faults RUN_FOLDER... experiments/22_dcspect/faults.csv
    python experiments/22_dcspect/study.py step RUN_FOLDER... experiments/22_dcspect/step.csv
    python experiments/22_dcspect/study.py start RUN_FOLDER... experiments/22_dcspect/start.csv
    python experiments/22_dcspect/study.py picture RUN_FOLDER... experiments/22_dcspect/planes.png

`tune` runs OSEM and BSREM with several options on the validation cases of each run's faults;
`cases` computes a row for each test case of each run's network, and of OSEM and BSREM with the best
options once for each faults; `faults` computes those of the networks for each fault alone; `step`
times a training step; `start` computes the error of OSEM by its updates on the validation cases;
`picture` draws one test case.
"""

import argparse
import statistics
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib import pyplot as plt
from torch import Tensor

import mvrecon as mv
from mvrecon.core.files.runs import read_rows, write_rows
from mvrecon.data.dataset import single_cases
from mvrecon.data.module import TEST_SERIES
from mvrecon.data.scenes.solids import Phantom, voxelise
from mvrecon.geometry.cameras.field import common_field
from mvrecon.geometry.grid import Box
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.methods.method import build_method
from mvrecon.report.metrics import auc, nrmse, volume_metrics
from mvrecon.training.fit import build_data
from mvrecon.training.module import build_projector
from mvrecon.training.run_folder import read_settings
from mvrecon.training.settings import TrainSettings
from mvrecon_spect.metrics.contrast import count_bias, defect_contrast
from mvrecon_spect.scenes.cardiac import Defect, Heart, RandomCardiac, Uptake

SUBSETS = 4
#: Iterations of OSEM whose error `start` computes.
UPDATED = (1, 2, 5, 11)
OPTIONS = [
    *({"name": "osem", "iterations": n, "subsets": SUBSETS} for n in (1, 2, 3, 4)),
    *(
        {"name": "bsrem", "iterations": n, "subsets": SUBSETS, "weight": w}
        for n in (3, 5, 10, 20)
        for w in (3e-3, 1e-2, 3e-2, 1e-1)
    ),
    {"name": "bsrem", "iterations": 80, "subsets": SUBSETS, "weight": 3e-2},
]
#: Each fault alone, in four of the cameras or two pinholes of every patient.
ALONE = {
    "none": {},
    "detectors shifted": {"views": 4, "shift_px": 3.0},
    "gains wrong": {"views": 4, "gain": 0.3},
    "pinholes blocked": {"lost": 2},
}
CASES, DRAWN, ROUNDS = 33, 8, 12


class Regions(NamedTuple):
    """Voxels of a patient's heart.

    Args:
        heart: walls and cavities of both ventricles.
        wall: of the left ventricle, with its defect.
        normal: of that wall, beside the place of the defect.
        defect: where the patient has the defect, or would have it.
        ill: whether there is one.
    """

    heart: Tensor
    wall: Tensor
    normal: Tensor
    defect: Tensor
    ill: bool


def regions(case: int, grid: mv.Grid) -> Regions:
    """The regions of a test case, from its parameters."""
    numbers = RandomCardiac().parameters(case, TEST_SERIES, grid)
    angles = [numbers[f"{name}_degrees"] for name in ("phi", "theta", "psi")]
    R = euler_rotation(angles, "zyz")
    t = torch.tensor([numbers[f"{name}_mm"] for name in "xyz"], dtype=torch.float64)
    sizes = {name: numbers[f"{name}_mm"] for name in ("radius", "length", "wall")}
    place = ("azimuth_degrees", "width_degrees", "low", "high")
    gone = Defect(*(numbers[f"defect_{name}"] for name in place), contrast=1.0)

    def share(heart: Heart, uptake: Uptake) -> Tensor:
        return voxelise(Phantom(tuple(part.moved(R, t) for part in heart.solids(uptake))), grid)

    left = Uptake(wall=1.0, right=0.0)
    wall = share(Heart(**sizes), left)
    lost = wall - share(Heart(**sizes, defect=gone), left)
    return Regions(
        share(Heart(**sizes), Uptake(1.0, 1.0, 1.0)) > 0.5,
        wall > 0.5,
        (wall > 0.5) & (lost < 0.1),
        lost > 0.5,
        numbers["defect_contrast"] > 0,
    )


def measured(settings: TrainSettings, part: str) -> Iterator[tuple[dict[str, Any], Any]]:
    """Each case of "val" or "test" with the operator that all methods assume."""
    sizes = {"train": 1, "val": 8, "test": CASES}
    scenes = build_data(replace(settings, data={**settings.data, "sizes": sizes}))
    scenes.setup("validate" if part == "val" else "test")
    A = build_projector(settings.grid, settings.camera, settings.projector)
    loader = scenes.val_dataloader() if part == "val" else scenes.test_dataloader()
    for case in chain.from_iterable(map(single_cases, loader)):
        yield case, A.for_case(case)


def faults_of(run: Path) -> str:
    """Whether a run's cameras have faults: "all" or "none"."""
    disturbed = (read_settings(run).acquisition or {})["disturbed"] or {}
    return "all" if any(disturbed.values()) else "none"


@torch.no_grad()
def tune(runs: Mapping[str, list[Path]]) -> Iterator[dict[str, Any]]:
    """Mean loss of each method with each of its options on the validation cases: that of the
    networks' training.
    """
    for faults, folders in runs.items():
        settings = read_settings(folders[0])
        cases = list(measured(settings, "val"))
        field = common_field(cases[0][1].cameras, cases[0][1].grid)
        for options in OPTIONS:
            method, found = build_method(options), []
            for case, A in cases:
                error = (method(case["views"], A).volume - case["volume"])[0].square()
                within = error[field].mean().item()
                found.append(error.mean().item() + settings.loss["common_field"] * within)
            yield {
                "faults": faults,
                "method": options["name"],
                "iterations": options["iterations"],
                "weight": options.get("weight"),
                "loss": round(sum(found) / len(found), 5),
            }


def chosen(file: Path, faults: str) -> dict[str, Any]:
    """OSEM and BSREM with the options that `tune` has found best."""
    rows = [row for row in read_rows(file) if row["faults"] == faults]
    best = {row["method"]: row for row in sorted(rows, key=lambda row: -float(row["loss"]))}
    methods = {}
    for name, row in best.items():
        weight = {"weight": float(row["weight"])} if row["weight"] else {}
        options = {"name": name, "iterations": int(row["iterations"]), "subsets": SUBSETS}
        methods[name] = build_method({**options, **weight})
    return methods


@torch.no_grad()
def compared(runs: Mapping[str, list[Path]], tuning: Path) -> Iterator[dict[str, Any]]:
    """Figures of every method on every test case."""
    for faults, folders in runs.items():
        classical = chosen(tuning, faults)
        methods = [((name, "", 0), method) for name, method in classical.items()]
        for folder in folders:
            settings, trained = read_settings(folder), mv.load(folder)
            names = (settings.label, settings.seed, trained.steps)
            methods.append((names, trained.module.method.eval()))
        for number, (case, A) in enumerate(measured(settings, "test")):
            parts, views = regions(number, A.grid), case["views"]
            found = [(names, method(views, A)) for names, method in methods]
            if "wrong" in case:
                right = (~case["wrong"][0].bool()).nonzero()[:, 0].tolist()
                B = A.cropped(Box.whole(A.grid.shape), right)
                out = classical["osem"](views[:, :, right], B)
                found.append((("osem, without faulty cameras", "", 0), out))
            for (name, seed, steps), out in found:
                names = {"faults": faults, "method": name, "seed": seed, "steps": steps}
                yield {**names, "case": number, **figures(out, case, parts)}


@torch.no_grad()
def alone(folders: list[Path]) -> Iterator[dict[str, Any]]:
    """Figures of each run's network on every test case with each fault alone."""
    runs = [(read_settings(run), mv.load(run)) for run in folders]
    settings = runs[0][0]
    for fault, options in ALONE.items():
        disturbed = {**options, "probability": 1.0}
        acquisition = {**(settings.acquisition or {}), "disturbed": disturbed if options else None}
        cases = measured(replace(settings, acquisition=acquisition), "test")
        for number, (case, A) in enumerate(cases):
            parts = regions(number, A.grid)
            for run, trained in runs:
                out = trained.module.method.eval()(case["views"], A)
                names = {"label": run.label, "seed": run.seed, "steps": trained.steps}
                yield {"fault": fault, **names, "case": number, **figures(out, case, parts)}


def figures(out: Any, case: dict[str, Any], parts: Regions) -> dict[str, Any]:
    """PSNR in dB, NRMSE of the volume and of the heart, bias of the wall's counts, contrast of the
    defect and its error, and the AUC of the cameras' weights.
    """
    volume, truth = out.volume[0, 0], case["volume"][0, 0]
    contrast = defect_contrast(volume, parts.defect, parts.normal)
    weights, wrong = out.camera_weights, case.get("wrong")
    known = weights is not None and wrong is not None and 0 < wrong.sum() < wrong.numel()
    values = {
        "psnr": volume_metrics(volume[None], truth[None], case["inside"][0], 1.0)["psnr"],
        "nrmse": nrmse(volume, truth),
        "heart_nrmse": nrmse(volume[parts.heart], truth[parts.heart]),
        "wall_bias": count_bias(volume, truth, parts.wall),
        "contrast": contrast,
        "contrast_error": contrast - defect_contrast(truth, parts.defect, parts.normal),
    }
    row: dict[str, Any] = {name: round(value, 4) for name, value in values.items()}
    return {
        **row,
        "ill": int(parts.ill),
        "auc": round(auc(-weights, wrong.bool()), 4) if known else None,
    }


def steps(folders: list[Path]) -> Iterator[dict[str, Any]]:
    """Processor time of a training step of each run's network, in turns, with one thread."""
    torch.set_num_threads(1)
    settings = read_settings(folders[0])
    cases = [case for case, _ in islice(measured(settings, "val"), 2)]
    pair = {key: torch.cat([case[key] for case in cases]) for key in ("views", "volume", "mu")}
    A = build_projector(settings.grid, settings.camera, settings.projector)
    methods = {read_settings(run).label: mv.load(run).module.method for run in folders}
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(ROUNDS):
        for name, method in methods.items():
            begin = time.process_time()
            volume = method.train()(pair["views"], A.for_case(pair)).volume
            (volume - pair["volume"]).square().mean().backward()
            seconds[name].append(time.process_time() - begin)
    median = {name: statistics.median(times[2:]) for name, times in seconds.items()}
    for name, method in methods.items():
        yield {
            "method": name,
            "parameters": sum(weight.numel() for weight in method.parameters()),
            "seconds": round(median[name], 3),
            "ratio": round(median[name] / min(median.values()), 2),
        }


@torch.no_grad()
def starts(folders: list[Path]) -> Iterator[dict[str, Any]]:
    """Mean squared error of OSEM, relative to the mean square of the activity, on each run's
    validation cases.
    """
    for run in folders:
        cases = list(measured(read_settings(run), "val"))
        for iterations in UPDATED:
            options = {"name": "osem", "iterations": iterations, "subsets": SUBSETS}
            method, found = build_method(options), []
            for case, A in cases:
                truth = case["volume"]
                error = method(case["views"], A).volume - truth
                found.append((error.square().sum() / truth.square().sum()).item())
            yield {
                "pinholes": len(cases[0][1].cameras),
                "cameras": "faulty" if faults_of(run) == "all" else "correct",
                "updates": iterations * SUBSETS,
                "error": round(statistics.fmean(found), 3),
            }


@torch.no_grad()
def picture(runs: Mapping[str, list[Path]], tuning: Path, out: Path) -> None:
    """The axial plane through the heart of one test case: truth, BSREM and the networks; anterior
    up, the patient's right on the left.
    """
    titles = {"bsrem": "BSREM", "world_unet": "volume U-Net", "cross_view": "cross-view"}
    rows = {}
    for faults, folders in runs.items():
        settings = read_settings(folders[0])
        case, A = next(islice(measured(settings, "test"), DRAWN, None))
        methods = {"bsrem": chosen(tuning, faults)["bsrem"]}
        for folder in folders:
            methods[read_settings(folder).label] = mv.load(folder).module.method.eval()
        volumes = {titles[n]: methods[n](case["views"], A).volume[0, 0] for n in titles}
        rows[faults] = {"truth": case["volume"][0, 0], **volumes}
    heart = regions(DRAWN, A.grid).heart
    plane = int(heart.flatten(1).sum(dim=1).argmax())
    shape = {"figsize": (9.2, 2.4 * len(rows)), "squeeze": False, "layout": "constrained"}
    figure, axes = plt.subplots(len(rows), 4, **shape)
    for line, (faults, volumes) in zip(axes, rows.items(), strict=True):
        for axis, (name, volume) in zip(line, volumes.items(), strict=True):
            shown = axis.imshow(volume[plane].flip(1), "inferno", vmin=0, vmax=1, origin="lower")
            axis.set(title=name, xticks=[], yticks=[])
            if name != "truth":
                error = nrmse(volume[heart], volumes["truth"][heart])
                axis.set_xlabel(f"NRMSE in the heart {error:.3f}")
        line[0].set_ylabel("correct cameras" if faults == "none" else "faulty cameras")
        for letter, place in (("A", (0.5, 0.97)), ("R", (0.03, 0.5))):
            line[0].text(*place, letter, c="w", transform=line[0].transAxes, ha="center", va="top")
    figure.colorbar(shown, ax=axes, label="activity relative to the normal wall's")
    figure.savefig(out, dpi=100)


def main() -> None:
    """Sort the runs by their faults, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=["tune", "cases", "faults", "step", "start", "picture"])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("out", type=Path, help="CSV file or picture to write")
    given = parser.parse_args()
    runs: dict[str, list[Path]] = {}
    for run in given.runs:
        runs.setdefault(faults_of(run), []).append(run)
    of_cases = given.out.name if given.task == "cases" else "cases.csv"
    tuning = given.out.with_name(of_cases.replace("cases", "tuning"))
    if given.task == "picture":
        picture(runs, tuning, given.out)
    else:
        rows = {
            "tune": lambda: tune(runs),
            "cases": lambda: compared(runs, tuning),
            "faults": lambda: alone(given.runs),
            "step": lambda: steps(given.runs),
            "start": lambda: starts(given.runs),
        }
        write_rows(given.out, list(rows[given.task]()))


if __name__ == "__main__":
    main()
