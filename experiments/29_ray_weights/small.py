"""Trains small networks on inconsistent views at 16^3 voxels, each step on four new cases:

    python experiments/29_ray_weights/small.py data STEPS SEEDS small.csv [ARM...]

Each ARM of `ARMS`, all by default, is trained for STEPS with the seeds 0 to SEEDS - 1, of its
weights and of the order of the cases. `data` has openkbp_train.h5 and openkbp_val.h5. The CSV file
gets a row for each of 33 patients; what it has already is skipped.
"""

import csv
import sys
import time
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.methods.method import build_method

FAULTS = {"views": 3, "rod": 0.25, "scatter": 0.15, "dead": 0.08, "probability": 0.5}
BATCH, RATE, RANGE = 4, 2e-3, 0.04
GRID = mv.Grid.centred(size=(16, 16, 16), spacing=(32.0, 20.0, 24.0))
DETECTOR = {"pixels": [24, 24], "pixel_mm": [36.0, 40.0]}
RIG = CAMERAS.build(
    "circular", n_views=8, arc_degrees=180.0, sid=1000.0, sdd=1500.0, detector=DETECTOR
)
SHARED: dict[str, Any] = {"widths": [8, 16, 32], "precision": "float32"}
OURS, PLAIN = {"name": "cross_view", "scale": 1, **SHARED}, {"name": "world_unet", **SHARED}
ROBUST = {"name": "robust_sirt", "iterations": 48}
ARMS = {
    "cross_view": OURS,
    "cross_view, ray_widths=[]": OURS | {"ray_widths": []},
    "cross_view, fusion=mean": OURS | {"fusion": "mean"},
    "cross_view from robust_sirt": OURS | {"start": ROBUST},
    "world_unet": PLAIN,
    "world_unet from robust_sirt": PLAIN | {"start": ROBUST},
    "robust_sirt": {"name": "robust_sirt"},
    "sirt": {"name": "sirt", "iterations": 25, "momentum": True},
}


def cases(path: Path, count: int, seed: int, vary: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Views, volumes and masks of the body."""
    scene = SCENES.build("hdf5", path=str(path), orientation="LPI", fine=2, rays=2, vary=vary)
    acquisition = Acquisition.of({"photons": float("inf"), "disturbed": FAULTS})
    acquired = Acquired(scene, {"name": "drr"}, acquisition)
    samples = [acquired.sample(i, seed, GRID, RIG) for i in range(count)]
    parts = ([getattr(one, name) for one in samples] for name in ("views", "volume", "inside"))
    views, volumes, inside = map(torch.stack, parts)
    return views, volumes, inside


def train(
    method: torch.nn.Module, A: mv.LinearOperator, views: Tensor, volumes: Tensor, seed: int
) -> None:
    """Train by AdamW with a cosine, on the squared error of the volume, once on each case."""
    adam = torch.optim.AdamW(method.parameters(), RATE, (0.9, 0.98), weight_decay=1e-4)
    rate = torch.optim.lr_scheduler.OneCycleLR(
        adam, RATE, total_steps=len(views) // BATCH, pct_start=0.05
    )
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(seed))
    for batch in order.split(BATCH):
        error = (method(views[batch], A).volume - volumes[batch]) / RANGE
        adam.zero_grad()
        error.square().mean().backward()
        torch.nn.utils.clip_grad_norm_(method.parameters(), 1.0)
        adam.step()
        rate.step()


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


def main() -> None:
    """Train, test, add to the file."""
    data, steps, seeds, out = (Path(sys.argv[1]), *map(int, sys.argv[2:4]), Path(sys.argv[4]))
    torch.set_num_threads(1)
    views, volumes, _ = cases(data / "openkbp_train.h5", BATCH * steps, 0, vary=True)
    tests, A = cases(data / "openkbp_val.h5", 33, 1, vary=False), mv.Drr(GRID, RIG)
    with out.open("a+", newline="") as file:
        file.seek(0)
        known = {tuple(row[:3]) for row in csv.reader(file)}
        writer = csv.writer(file)
        if not known:
            writer.writerow(("method", "seed", "steps", "case", "psnr", "psnr_inside", "seconds"))
        for seed, arm in product(range(seeds), sys.argv[5:] or ARMS):
            torch.manual_seed(seed)
            method, begun = build_method(ARMS[arm]), time.process_time()
            length = steps if any(True for _ in method.parameters()) else 0
            if (arm, str(seed), str(length)) in known or (seed and not length):
                continue
            if length:
                train(method, A, views, volumes, seed)
            seconds = round(time.process_time() - begun)
            for case, scores in enumerate(errors(method, A, *tests)):
                writer.writerow([arm, seed, length, case, *(round(x, 4) for x in scores), seconds])
            file.flush()


if __name__ == "__main__":
    main()
