"""Repeats every measurement of docs/trust.md: `python scripts/checks/trust.py`, about half an hour
and the duration of the soak test.

Each step writes a CSV file to `docs/trust`, from which `scripts/docs/tables.py` makes the tables of
docs/trust.md and docs/stress.md. An interrupted run resumes with the next step; to repeat a step,
remove its file.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from mvrecon.core.files.runs import VERSIONS, read_rows, write_rows
from mvrecon.training.run_folder import versions
from mvrecon_bench.runner import TABLE
from mvrecon_bench.stresses.verdict import FAIL, LEFT_OUT, PASS

ROOT = Path(__file__).resolve().parents[2]
FOUND = ROOT / "docs" / "trust"
#: Seed of all that is random, damaged files for each reader, trainings to kill, and seconds of
#: training in a loop.
SEED, FILES, KILLS, SOAK = 7, 9000, 72, 3600.0
Rows = list[dict[str, Any]]


def output_of(*command: str, **environment: str) -> str:
    """The standard output of a command, which may fail: the output tells what it found."""
    there = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run(
        command, cwd=ROOT, env=there, stdout=subprocess.PIPE, text=True, check=False
    ).stdout


def stress() -> Rows:
    """The stress plan: the verdicts on each part, and the cases in which it failed."""
    with tempfile.TemporaryDirectory() as folder:
        output_of(sys.executable, "-m", "mvrecon_bench.stress", f"out={folder}/stress")
        rows = read_rows(Path(folder) / "stress" / TABLE)
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        names = {"part": row["part"], "dtype": row["dtype"]}
        empty = {**names, PASS: 0, FAIL: 0, LEFT_OUT: 0, "failed": ""}
        part = found.setdefault((row["part"], row["dtype"]), empty)
        part[row["verdict"]] += 1
        if row["verdict"] == FAIL:
            part["failed"] += f"{row['number']} {row['case']}; "
    return list(found.values())


def properties() -> Rows:
    """Random geometries that the properties were tried on."""
    options = ("-q", "--hypothesis-show-statistics", "-p", "no:cacheprovider")
    said = output_of(sys.executable, "-m", "pytest", "tests/properties", *options)
    # what shrinks a failure does not count
    told = r"during generate phase.*?(\d+) passing, (\d+) failing"
    counted = [tuple(map(int, found)) for found in re.findall(told, said, re.S)]
    examples, failing = sum(a for a, _ in counted), sum(b for _, b in counted)
    return [{"properties": len(counted), "examples": examples, "failing": failing}]


def fuzz() -> Rows:
    """What became of damaged files, reader by reader."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        output_of(sys.executable, "-m", "tests.faults.fuzzing", f"{SEED}", f"{FILES}", str(out))
        found = json.loads(out.read_text())
    return [
        {
            "reader": name,
            "inputs": one["inputs"],
            "read": one["read"],
            "failures": len(one["failures"]),
            "seconds": f"{one['seconds']:.2g}",
            "peak_mb": f"{one['peak'] / 2**20:.3g}",
        }
        for name, one in found.items()
    ]


def kills() -> Rows:
    """Trainings that were killed at random and went on."""
    said = output_of(sys.executable, "-m", "tests.training.lives", f"{KILLS}", f"{SEED}")
    found = json.loads(said.splitlines()[-1])
    return [{"kills": found["kills"], "differ": len(found["runs that differ"])}]


def soak() -> Rows:
    """Training and evaluating in a loop."""
    said = output_of(sys.executable, "scripts/checks/soak.py", "--seconds", f"{SOAK}")
    return [{"seconds": SOAK, **json.loads(said.splitlines()[-1])}]


def main() -> None:
    """Entry point."""
    FOUND.mkdir(parents=True, exist_ok=True)
    for step in (stress, properties, fuzz, kills, soak):
        file = FOUND / f"{step.__name__}.csv"
        if not file.exists():
            print(f"{step.__name__}: {step.__doc__}", flush=True)
            write_rows(file, step())
    made = "".join(f"{name} {versions()[name]}\n" for name in ("python", "torch", "numba"))
    (FOUND / VERSIONS).write_text(made)
    print("Now run python scripts/docs/tables.py, which writes the tables of its pages")


if __name__ == "__main__":
    main()
