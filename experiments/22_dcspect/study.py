"""Networks, BSREM and OSEM on counts behind 16 pinholes, with right and with faulty cameras.

    python experiments/22_dcspect/study.py tune RUN_FOLDER... experiments/22_dcspect/tuning.csv
    python experiments/22_dcspect/study.py cases RUN_FOLDER... experiments/22_dcspect/cases.csv
    python experiments/22_dcspect/study.py picture RUN_FOLDER... experiments/22_dcspect/planes.png

`tune` runs OSEM and BSREM with several options on the validation cases of each run's faults;
`cases` computes a row for each test case of each run's network, and of OSEM and BSREM with the best
options once for each faults; `picture` draws one test case. `--faults` gives all runs the same.
"""

import argparse
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.core.files.runs import read_rows, write_rows
from mvrecon.data.dataset import single_cases
from mvrecon.data.module import TEST
from mvrecon.data.scenes.solids import Phantom, voxelise
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.methods.method import build_method
from mvrecon.report.metrics import auc, nrmse, volume_metrics
from mvrecon.training.fit import build_data
from mvrecon.training.module import build_projector
from mvrecon.training.run_folder import read_settings
from mvrecon_spect.metrics.contrast import count_bias, defect_contrast
from mvrecon_spect.scenes.cardiac import Defect, Heart, RandomCardiac, Uptake

FAULTS: dict[str, dict[str, float] | None] = {
    "none": None,
    "all": {"views": 4, "shift_px": 3.0, "gain": 0.3, "lost": 2, "probability": 0.7},
    "gain": {"views": 4, "gain": 0.3},
    "shift": {"views": 4, "shift_px": 3.0},
    "lost": {"views": 1, "lost": 2},
}
OPTIONS = [
    *({"name": "osem", "iterations": n} for n in (1, 2, 3, 4)),
    *({"name": "bsrem", "weight": w} for w in (3e-3, 1e-2, 3e-2, 1e-1)),
]
CASES, DRAWN = 33, 8


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
    numbers = RandomCardiac().parameters(case, TEST, grid)
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


def measured(
    settings: Mapping[str, Any], faults: str, part: str
) -> Iterator[tuple[dict[str, Any], Any]]:
    """Each case of "val" or "test" with the operator that all methods assume."""
    acquisition = {**settings["acquisition"], "disturbed": FAULTS[faults]}
    sizes = {"train": 1, "val": 8, "test": CASES}
    data = {**settings["data"], "sizes": sizes}
    scenes = build_data({**settings, "acquisition": acquisition, "data": data})
    scenes.setup("validate" if part == "val" else "test")
    A = build_projector(settings["grid"], settings["camera"], settings["projector"])
    loader = scenes.val_dataloader() if part == "val" else scenes.test_dataloader()
    for case in chain.from_iterable(map(single_cases, loader)):
        yield case, A.for_case(case)


def faults_of(run: Path) -> str:
    """The name of a run's faults."""
    known = read_settings(run)["acquisition"]["disturbed"]
    wrong = {key: value for key, value in (known or {}).items() if value}
    return next(name for name, each in FAULTS.items() if (each or {}) == wrong)


def tune(runs: Mapping[str, list[Path]]) -> Iterator[dict[str, Any]]:
    """Mean PSNR of each method with each of its options on the validation cases."""
    for faults, folders in runs.items():
        cases = list(measured(read_settings(folders[0]), faults, "val"))
        for options in OPTIONS:
            method = build_method(options)
            found = []
            for case, A in cases:
                volume, truth = method(case["views"], A).volume[0], case["volume"][0]
                found.append(volume_metrics(volume, truth, case["inside"][0], 1.0)["psnr"])
            name, (key, value) = options["name"], list(options.items())[1]
            psnr = round(sum(found) / len(found), 4)
            yield {"faults": faults, "method": name, "option": key, "value": value, "psnr": psnr}


def chosen(file: Path, faults: str) -> dict[str, Any]:
    """OSEM and BSREM with the options that `tune` has found best."""
    rows = [row for row in read_rows(file) if row["faults"] == faults]
    best = {row["method"]: row for row in sorted(rows, key=lambda row: float(row["psnr"]))}
    kinds = {"iterations": int, "weight": float}
    return {
        name: build_method({"name": name, row["option"]: kinds[row["option"]](row["value"])})
        for name, row in best.items()
    }


def compared(runs: Mapping[str, list[Path]], tuning: Path) -> Iterator[dict[str, Any]]:
    """Figures of every method on every test case."""
    for faults, folders in runs.items():
        methods = [(name, "", 0, method) for name, method in chosen(tuning, faults).items()]
        for folder in folders:
            settings, trained = read_settings(folder), mv.load(folder)
            name = settings["method"]["name"]
            methods.append((name, settings["seed"], trained.steps, trained.module.method.eval()))
        for number, (case, A) in enumerate(measured(settings, faults, "test")):
            parts = regions(number, A.grid)
            for name, seed, steps, method in methods:
                names = {"faults": faults, "method": name, "seed": seed, "steps": steps}
                yield {**names, "case": number, **figures(method(case["views"], A), case, parts)}


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


def picture(runs: Mapping[str, list[Path]], tuning: Path, out: Path) -> None:
    """The axial plane through the heart of one test case: truth, BSREM and the networks."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    titles = {"bsrem": "BSREM", "world_unet": "volume U-Net", "cross_view": "cross-view"}
    rows = {}
    for faults, folders in runs.items():
        settings = read_settings(folders[0])
        case, A = list(measured(settings, faults, "test"))[DRAWN]
        methods = {"bsrem": chosen(tuning, faults)["bsrem"]}
        for folder in folders:
            methods[read_settings(folder)["method"]["name"]] = mv.load(folder).module.method.eval()
        volumes = {titles[n]: methods[n](case["views"], A).volume[0, 0] for n in titles}
        rows[faults] = {"truth": case["volume"][0, 0], **volumes}
    heart = regions(DRAWN, A.grid).heart
    plane = int(heart.flatten(1).sum(dim=1).argmax())
    shape = {"figsize": (9.2, 2.4 * len(rows)), "squeeze": False, "layout": "constrained"}
    figure, axes = plt.subplots(len(rows), 4, **shape)
    for line, (faults, volumes) in zip(axes, rows.items(), strict=True):
        for axis, (name, volume) in zip(line, volumes.items(), strict=True):
            shown = axis.imshow(volume[plane], "inferno", vmin=0, vmax=1, origin="lower")
            axis.set(title=name, xticks=[], yticks=[])
            if name != "truth":
                error = nrmse(volume[heart], volumes["truth"][heart])
                axis.set_xlabel(f"NRMSE in the heart {error:.3f}")
        line[0].set_ylabel("right cameras" if faults == "none" else "faulty cameras")
    figure.colorbar(shown, ax=axes, label="activity relative to the normal wall's")
    figure.savefig(out, dpi=100)


@torch.no_grad()
def main() -> None:
    """Sort the runs by their faults, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=["tune", "cases", "picture"])
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("out", type=Path, help="CSV file or picture to write")
    parser.add_argument("--faults", choices=list(FAULTS), help="default: those of each run")
    given = parser.parse_args()
    runs: dict[str, list[Path]] = {}
    for run in given.runs:
        runs.setdefault(given.faults or faults_of(run), []).append(run)
    tuning = given.out.with_name("tuning.csv")
    if given.task == "picture":
        picture(runs, tuning, given.out)
    else:
        write_rows(given.out, list(tune(runs) if given.task == "tune" else compared(runs, tuning)))


if __name__ == "__main__":
    main()
