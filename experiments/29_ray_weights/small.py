"""Trains one arm on inconsistent views at 16^3 voxels, a check that takes a minute:

    python experiments/29_ray_weights/small.py data ARM SEED experiments/29_ray_weights/small.csv

ARM is one of `ARMS`, SEED that of its weights and of the order of the cases. `data` has
openkbp_train.h5 and openkbp_val.h5; a row for each of 33 patients is added to the CSV file.
"""

import csv
import sys
import time
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
STEPS, BATCH, RATE, RANGE = 200, 4, 2e-3, 0.04
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


def trained(method: torch.nn.Module, A: mv.LinearOperator, data: Path, seed: int) -> None:
    """Train by AdamW with a cosine, on the squared error of the volume."""
    views, volumes, _ = cases(data / "openkbp_train.h5", 486, 0, vary=True)
    adam = torch.optim.AdamW(method.parameters(), RATE, (0.9, 0.98), weight_decay=1e-4)
    rate = torch.optim.lr_scheduler.OneCycleLR(adam, RATE, total_steps=STEPS, pct_start=0.05)
    draw = torch.Generator().manual_seed(seed)
    epochs = -(-BATCH * STEPS // len(views))
    order = torch.cat([torch.randperm(len(views), generator=draw) for _ in range(epochs)])
    for batch in order.split(BATCH)[:STEPS]:
        error = (method(views[batch], A).volume - volumes[batch]) / RANGE
        adam.zero_grad()
        error.square().mean().backward()
        torch.nn.utils.clip_grad_norm_(method.parameters(), 1.0)
        adam.step()
        rate.step()


def main() -> None:
    """Train, test, add to the file."""
    data, arm, seed, out = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    A, method, begun = mv.Drr(GRID, RIG), build_method(ARMS[arm]), time.process_time()
    if any(True for _ in method.parameters()):
        trained(method, A, data, seed)
    views, truth, inside = cases(data / "openkbp_val.h5", 33, 1, vary=False)
    with torch.no_grad():
        volume = torch.cat([method.eval()(part, A).volume for part in views.split(3)])
    square = ((volume - truth) / RANGE).square()
    whole = -10 * square.mean(dim=(1, 2, 3, 4)).log10()
    body = -10 * ((square * inside).flatten(1).sum(1) / inside.flatten(1).sum(1)).log10()
    fresh = not out.exists()
    with out.open("a", newline="") as file:
        writer = csv.writer(file)
        if fresh:
            writer.writerow(["method", "seed", "case", "psnr", "psnr_inside", "seconds"])
        seconds = round(time.process_time() - begun)
        pairs = zip(whole.tolist(), body.tolist(), strict=True)
        for case, (one, other) in enumerate(pairs):
            writer.writerow([arm, seed, case, round(one, 4), round(other, 4), seconds])


if __name__ == "__main__":
    main()
