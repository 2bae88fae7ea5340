"""The frame of the scripts: options, device, clock, and results that are written at once."""

import argparse
import faulthandler
import json
import sys
import time
import traceback
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mvrecon.core.files.runs import write_rows
from mvrecon_bench.rows import Row, reason

#: Seconds after which a script starts no new measurement, and after which it is terminated.
SLICE, END = 500.0, 540.0


def options_of(doc: str | None, settings: bool = False, **defaults: Any) -> Namespace:
    """The options of a script's command line: `--out` and `--device`, and others by name and
    default, whose type is the option's; with `settings`, also those of an experiment.
    """
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda", help="cuda, cpu, or dry: a stand-in for a GPU")
    for name, value in defaults.items():
        kind: dict[str, Any] = {"type": type(value)}
        if isinstance(value, bool):
            kind = {"action": "store_true"}
        elif isinstance(value, list | tuple):
            kind = {"nargs": "*", "type": type(value[0])}
        parser.add_argument(f"--{name}", default=value, help=f"default: {value}", **kind)
    if settings:
        parser.add_argument(
            "settings", nargs="*", help="settings of the experiment, such as method.support=hull"
        )
    return parser.parse_args()


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

    def attempt(self, what: str, measure: Callable[..., Any], *inputs: Any) -> Any:
        """Record the result of a measurement, or its failure."""
        if self.left() < 0:
            self.add(what, "no time left")
            return None
        try:
            value = measure(*inputs)
        except Exception as error:
            stack = traceback.extract_tb(error.__traceback__)[-3:]
            places = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in stack]
            self.add(what, f"FAILED {reason(error)} at {places}")
            return None
        if value is not None:
            self.add(what, value)
        return value
