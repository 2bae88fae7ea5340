"""Trains and evaluates in a loop, and fails unless memory and open files stay flat:
`python scripts/checks/soak.py`.

Each round is a whole run of a small experiment in a folder of its own (every second one with worker
processes), and its evaluation again. After the first rounds, which fill caches, neither open files
nor memory may grow.
"""

import argparse
import gc
import json
import logging
import os
import statistics
import tempfile
import time
import warnings
from pathlib import Path

import torch

from mvrecon.apps import eval as evaluation, train
from mvrecon.apps.config import compose
from mvrecon.apps.settings import EvalSettings, TrainSettings

OPTIONS = (
    "experiment=smoke",
    "grid.size=[8,8,8]",
    "grid.spacing=16.0",
    "camera.detector.pixels=[12,12]",
    "camera.detector.pixel_mm=22.0",
    "logger=default",
)
WARM = 4


def footprint() -> tuple[float, int]:
    """Resident memory of this process in MB, and how many files it has open."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, len(os.listdir("/proc/self/fd"))


def once(turn: int) -> None:
    """One run and its evaluation."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        settings = compose(*OPTIONS, f"data.workers={turn % 2}", f"seed={turn}")
        train.train(TrainSettings(**settings), run)
        settings = compose(f"checkpoint={run}", "device=cpu", config_name="eval")
        evaluation.evaluate(EvalSettings(**settings), Path(folder) / "eval")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="how long (default: an hour)")
    parser.add_argument(
        "--allowed", type=float, default=0.2, help="MB that a round may add (default: 0.2)"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    end, seen = time.monotonic() + given.seconds, []
    while time.monotonic() < end or len(seen) < WARM + 3:
        once(len(seen))
        seen.append(footprint())
    megabytes, files = [m for m, _ in seen], [f for _, f in seen[WARM:]]
    # MB a round, by the line through all rounds after the first ones
    growth = statistics.linear_regression(range(len(files)), megabytes[WARM:]).slope
    found = {
        "rounds": len(seen),
        "mb_a_round": round(growth, 4),
        "mb": round(megabytes[-1]),
        "files": files[-1],
    }
    print(json.dumps(found))
    if growth > given.allowed or max(files) > files[0]:
        raise SystemExit(
            f"Not flat: {[round(m, 1) for m in megabytes]} MB, {[f for _, f in seen]} files"
        )


if __name__ == "__main__":
    main()
