"""Utilities of the scripts: incremental results, and timing on both devices."""

import faulthandler
import json
import statistics
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mvrecon.core.files.runs import write_rows
from mvrecon_bench.benchmarks.rows import Row
from mvrecon_bench.benchmarks.trial import reason

#: Seconds after which a script starts no new measurement, and after which it is terminated.
SLICE, END = 500.0, 540.0


def on_device(device: str) -> str:
    """Return the device if it is available, and start the script's clock.

    Args:
        device: "cuda", "cpu", or "dry", which emulates "cuda" without a GPU.

    Raises:
        SystemExit: "cuda" is requested, but torch finds no GPU.
    """
    if device == "dry":
        from mvrecon_bench.gpu.dry import stand_in

        stand_in()
        device = "cuda"
    if device.startswith("cuda") and not torch.cuda.is_available():
        sys.exit(
            f"{Path(sys.argv[0]).name} needs a GPU, and torch {torch.__version__} sees none here; "
            "--device dry tries the script on a stand-in, where its numbers mean nothing"
        )
    faulthandler.dump_traceback_later(END, exit=True)
    return device


class Results:
    """Results that are written to disk immediately (`<name>.json`, and `<name>.csv` for rows), and
    the script's clock.
    """

    def __init__(self, folder: Path, name: str):
        self.begun = time.perf_counter()
        folder.mkdir(parents=True, exist_ok=True)
        self.json, self.csv = folder / f"{name}.json", folder / f"{name}.csv"
        self.facts: dict[str, Any] = {}
        self.rows: list[Row] = []

    def left(self) -> float:
        """Remaining seconds in which measurements may start."""
        return SLICE - (time.perf_counter() - self.begun)

    def add(self, what: str, value: Any) -> None:
        """Print and write one result."""
        self.facts[what] = value
        print(f"{what}: {value}", flush=True)
        self.json.write_text(json.dumps(self.facts, indent=1, default=str) + "\n")

    def row(self, **values: Any) -> None:
        """Print and write one row."""
        self.rows.append(values)
        names = dict.fromkeys(key for row in self.rows for key in row)
        write_rows(self.csv, [{**names, **row} for row in self.rows])
        shown = (f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
        print("  ".join(shown), flush=True)

    def attempt(self, what: str, measure: Callable[[], Any]) -> Any:
        """Record the result of `measure`, or its failure."""
        if self.left() < 0:
            self.add(what, "no time left")
            return None
        try:
            value = measure()
        except Exception as error:
            stack = traceback.extract_tb(error.__traceback__)[-3:]
            places = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in stack]
            self.add(what, f"FAILED {reason(error)} at {places}")
            return None
        if value is not None:
            self.add(what, value)
        return value


def wait(device: str) -> None:
    """Wait until the device is idle."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def latency(call: Callable[[], Any], device: str, rounds: int = 9) -> float:
    """Median milliseconds of one call on an idle device until completion."""
    call()
    times = []
    for _ in range(rounds):
        wait(device)
        start = time.perf_counter()
        call()
        wait(device)
        times.append(time.perf_counter() - start)
        if sum(times) > 3:
            break
    return 1e3 * statistics.median(times)


def throughput(call: Callable[[], Any], device: str, seconds: float = 0.15) -> tuple[float, float]:
    """Milliseconds per call for many queued calls, on the device and on the host (the overhead of
    Python).
    """
    if not device.startswith("cuda"):
        start = time.perf_counter()
        call()
        took = 1e3 * (time.perf_counter() - start)
        return took, took
    one = latency(call, device, 2) / 1e3
    count = max(2, min(300, int(seconds / max(one, 1e-6))))
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize()
    begin.record()
    start = time.perf_counter()
    for _ in range(count):
        call()
    host = time.perf_counter() - start
    end.record()
    end.synchronize()
    return begin.elapsed_time(end) / count, 1e3 * host / count


def peak_mb(call: Callable[[], Any], device: str) -> float:
    """Peak device memory of a call in MB beyond the memory in use before."""
    if not device.startswith("cuda"):
        return float("nan")
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    call()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 2**20
