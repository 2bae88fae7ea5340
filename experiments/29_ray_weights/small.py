"""Trains small networks at 16^3 voxels, each step on four cases, which repeat after 4000:

    python experiments/29_ray_weights/small.py data arms.yaml small.csv --steps 800 --seeds 3

The YAML file has the options of a method for each name. `data` has openkbp_train.h5 and
openkbp_val.h5. The CSV file gets a row for each test patient; what it has already is skipped.
"""

import argparse
import csv
import time
from collections.abc import Iterable, Iterator
from itertools import count, islice, product
from pathlib import Path

import torch
from omegaconf import OmegaConf
from torch import Tensor

import mvrecon as mv
from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.methods.calibration.self_alignment import self_aligned
from mvrecon.methods.method import build_method

CORRUPTED = {"views": 3, "rod": 0.25, "scatter": 0.15, "dead": 0.08, "probability": 0.5}
MISALIGNED = {
    "views": 3,
    "shift_px": 1.0,
    "gain": 0.05,
    "tilt_deg": 3.0,
    "motion_mm": 20.0,
    "probability": 0.5,
}
FAULTS = {
    "clean": None,
    "corrupted": CORRUPTED,
    "misaligned": MISALIGNED,
    "lost": MISALIGNED | {"lost": 1},
}
BATCH, RANGE = 4, 0.04
PATIENTS, HELD_OUT = 170, range(150, 170)
GRID = mv.Grid.centred(size=(16, 16, 16), spacing=(32.0, 20.0, 24.0))
DETECTOR = {"pixels": [24, 24], "pixel_mm": [36.0, 40.0]}
HEADER = "method,seed,steps,rate,patients,arc,case,psnr,psnr_inside,seconds".split(",")


def rig(arc_degrees: float = 180.0) -> mv.Cameras:
    """Eight cone-beam cameras."""
    return CAMERAS.build(
        "circular", n_views=8, arc_degrees=arc_degrees, sid=1000.0, sdd=1500.0, detector=DETECTOR
    )


def cases(
    path: Path, indices: Iterable[int], seed: int, vary: bool, faults: object
) -> tuple[Tensor, ...]:
    """Views, volumes and masks of the body. With `vary`, indices beyond the patients vary them."""
    scene = SCENES.build("hdf5", path=str(path), orientation="LPI", fine=2, rays=2, vary=vary)
    acquisition = Acquisition.of({"photons": float("inf"), "disturbed": faults})
    acquired = Acquired(scene, {"name": "drr"}, acquisition)
    cameras = rig()
    samples = [acquired.sample(i, seed, GRID, cameras) for i in indices]
    parts = ([getattr(one, name) for one in samples] for name in ("views", "volume", "inside"))
    return tuple(map(torch.stack, parts))


def aligned(views: Tensor, A: mv.LinearOperator) -> Tensor:
    """The views of each case, aligned to each other."""
    with torch.no_grad():
        return torch.cat([self_aligned(A, part).views for part in views.split(BATCH)])


def train(
    method: torch.nn.Module,
    A: mv.LinearOperator,
    views: Tensor,
    volumes: Tensor,
    seed: int,
    steps: int,
    rate: float,
) -> None:
    """Train by AdamW with a cosine, on the squared error of the volume."""
    adam = torch.optim.AdamW(method.parameters(), rate, (0.9, 0.98), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(adam, rate, total_steps=steps, pct_start=0.05)
    for batch in islice(batches(len(views), seed), steps):
        error = (method(views[batch], A).volume - volumes[batch]) / RANGE
        adam.zero_grad()
        error.square().mean().backward()
        torch.nn.utils.clip_grad_norm_(method.parameters(), 1.0)
        adam.step()
        schedule.step()


def batches(cases: int, seed: int) -> Iterator[Tensor]:
    """Indices of all cases in one random order after the other."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        yield from torch.randperm(cases, generator=generator).split(BATCH)


def errors(
    method: torch.nn.Module, A: mv.LinearOperator, views: Tensor, truth: Tensor, inside: Tensor
) -> list[tuple[float, float]]:
    """PSNR of each case, whole and inside the body."""
    with torch.no_grad():
        volume = torch.cat([method.eval()(part, A).volume for part in views.split(3)])
    square = ((volume - truth) / RANGE).square()
    whole = -10 * square.mean(dim=(1, 2, 3, 4)).log10()
    body = -10 * ((square * inside).flatten(1).sum(1) / inside.flatten(1).sum(1)).log10()
    return list(zip(whole.tolist(), body.tolist(), strict=True))


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of the two files")
    parser.add_argument("arms", type=Path, help="YAML file of methods")
    parser.add_argument("out", type=Path, help="CSV file")
    parser.add_argument("--only", nargs="*", default=[], help="names of methods (all)")
    parser.add_argument("--steps", type=int, default=800, help="steps of a training (800)")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each method (1)")
    parser.add_argument("--rates", type=float, nargs="*", default=[2e-3], help="learning rates")
    parser.add_argument(
        "--patients",
        type=int,
        help="train on so many patients, as they are (all, varied at random)",
    )
    parser.add_argument(
        "--arc",
        type=float,
        default=180.0,
        help="arc in degrees of the cameras that methods assume; views have 180 (180)",
    )
    parser.add_argument(
        "--faults", choices=FAULTS, default="corrupted", help="faults of the views (corrupted)"
    )
    parser.add_argument("--align", action="store_true", help="align the views of each case")
    parser.add_argument(
        "--validate", action="store_true", help="test on 20 patients that training leaves out"
    )
    return parser.parse_args()


def main() -> None:
    """Train, test, add to the file."""
    given = arguments()
    torch.set_num_threads(1)
    faults, A = FAULTS[given.faults], mv.Drr(GRID, rig(given.arc))
    train_file, test_file = (given.data / f"openkbp_{name}.h5" for name in ("train", "val"))
    left_out, tested = (HELD_OUT, train_file) if given.validate else (range(0), test_file)
    indices = (i for i in count() if i % PATIENTS not in left_out)
    indices = islice(indices, given.patients or min(BATCH * given.steps, 4000))
    views, volumes, _ = cases(train_file, indices, 0, given.patients is None, faults)
    seen, *truth = cases(tested, left_out or range(33), 1, False, faults)
    if given.align:
        views, seen = aligned(views, A), aligned(seen, A)
    arms = OmegaConf.to_container(OmegaConf.load(given.arms))
    with given.out.open("a+", newline="") as file:
        file.seek(0)
        known = {tuple(row[:6]) for row in csv.reader(file)}
        writer = csv.writer(file, lineterminator="\n")
        if not known:
            writer.writerow(HEADER)
        for seed, arm, rate in product(range(given.seeds), given.only or arms, given.rates):
            torch.manual_seed(seed)
            method, begun = build_method(arms[arm]), time.process_time()
            trained = any(True for _ in method.parameters())
            row = (arm, seed, given.steps if trained else 0, rate if trained else 0)
            row += (given.patients or "", given.arc)
            if tuple(map(str, row)) in known or (seed and not trained):
                continue
            if trained:
                train(method, A, views, volumes, seed, given.steps, rate)
            seconds = round(time.process_time() - begun)
            for case, scores in enumerate(errors(method, A, seen, *truth)):
                writer.writerow([*row, case, *(round(x, 4) for x in scores), seconds])
            file.flush()


if __name__ == "__main__":
    main()
