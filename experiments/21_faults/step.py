"""Processor time of a training step of the networks of this study, measured alternately, one
thread:
python experiments/21_faults/step.py experiments/21_faults/step.csv
"""

import statistics
import sys
import time

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.methods.method import build_method

#: Of the networks of this study, without weights of single rays and reweighted iterations.
EARLIER = {"name": "cross_view", "ray_widths": [], "weight_widths": [8], "reweight": 0}
METHODS = {
    "world_unet": {"name": "world_unet"},
    "world_unet, 18 channels": {"name": "world_unet", "widths": (18, 36, 72)},
    "world_unet, 24 channels": {"name": "world_unet", "widths": (24, 48, 96)},
    "cross_view": EARLIER,
    "cross_view, reweight=12": EARLIER | {"reweight": 12},
    "cross_view, fine frusta": EARLIER
    | {"depth_widths": (16, 32), "depths": 16, "binning": 3, "consistency": 2},
    "cross_view, default of today": {"name": "cross_view"},
}
BATCH, ROUNDS = 4, 12


def main(out: str) -> None:
    """Time a step of each method in each round."""
    torch.set_num_threads(1)
    grid = mv.Grid.centred(size=(32, 32, 32), spacing=(16.0, 10.0, 12.0))
    detector = {"pixels": [48, 48], "pixel_mm": [18.0, 20.0]}
    A = mv.Drr(grid, mv.circular(8, 1000.0, 1500.0, detector))
    truth = torch.zeros(BATCH, 1, 32, 32, 32)
    truth[..., 6:26, 8:24, 6:26] = 0.02
    views = A(truth)
    methods = {name: build_method(options).train() for name, options in METHODS.items()}
    optimisers = {name: torch.optim.AdamW(m.parameters(), 1e-4) for name, m in methods.items()}
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(ROUNDS):
        for name, method in methods.items():
            begin = time.process_time()
            loss = (method(views, A).volume - truth).square().mean()
            optimisers[name].zero_grad()
            loss.backward()
            optimisers[name].step()
            seconds[name].append(time.process_time() - begin)
    least = statistics.median(seconds["world_unet"][2:])
    rows = [
        {
            "method": name,
            "parameters": sum(weight.numel() for weight in methods[name].parameters()),
            "seconds": round(statistics.median(times[2:]), 3),
            "ratio": round(statistics.median(times[2:]) / least, 2),
        }
        for name, times in seconds.items()
    ]
    write_rows(out, rows)


if __name__ == "__main__":
    main(sys.argv[1])
