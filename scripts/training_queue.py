"""Runs a queue of trainings at low priority, each with one thread:

    python scripts/training_queue.py experiments/29_ray_weights/queue.txt --jobs 2

A line holds a run folder and the options of mvrecon-train. A folder with results is skipped, an
unfinished one is resumed, so the queue can be stopped and started again. The output of a run is
`log.txt` in its folder.
"""

import argparse
import os
import shlex
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mvrecon.core.files.runs import RESULTS

#: One thread a run: as fast for small volumes, and fair to other programs.
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


def run(line: str) -> str:
    """Run, resume or skip a line; returns its folder and what became of it."""
    name, *options = shlex.split(line)
    folder = Path(name)
    if (folder / RESULTS).exists():
        return f"{folder}: finished before"
    if any((folder / "checkpoints").rglob("*.ckpt")):
        options = [f"resume={folder}"]
    else:
        options = [*options, f"hydra.run.dir={folder}"]
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "log.txt").open("a") as log:
        command = ["nice", "-n", "19", "mvrecon-train", *options]
        code = subprocess.run(command, stdout=log, stderr=log, env=ENVIRONMENT, check=False)
    return f"{folder}: finished" if code.returncode == 0 else f"{folder}: failed, see log.txt"


def main() -> None:
    """Run all lines of the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("queue", type=Path, help="text file; # begins a comment")
    parser.add_argument("--jobs", type=int, default=2, help="runs at the same time (2)")
    given = parser.parse_args()
    lines = [line for line in given.queue.read_text().splitlines() if line.split("#")[0].strip()]
    with ThreadPoolExecutor(given.jobs) as pool:
        for report in pool.map(run, lines):
            print(report, flush=True)


if __name__ == "__main__":
    main()
