"""Writes docs/trust.md: puts everything under stress, and tells what came of it: `python
scripts/trust.py`.

About half an hour, and the soak's time on top. What a step found stays in `docs/trust`, which is
committed; an interrupted run resumes with the next step, and a step is repeated when its file there
is removed.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mvrecon.core.files.atomic import written_whole
from mvrecon.training.run_folder import versions
from mvrecon_bench.benchmarks.report import markdown
from mvrecon_bench.stresses.verdict import FAIL, LEFT_OUT, PASS

ROOT = Path(__file__).resolve().parents[1]
FOUND = ROOT / "docs" / "trust"
VERDICTS = (PASS, FAIL, LEFT_OUT)


def done(*command: str, **environment: str) -> str:
    """What a command says; it may fail, since what it found is told anyway."""
    there = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run(
        command, cwd=ROOT, env=there, stdout=subprocess.PIPE, text=True, check=False
    ).stdout


def stress(_: argparse.Namespace) -> Any:
    """The verdicts of the stress plan: rows by part and verdict, the cases, and what failed."""
    with tempfile.TemporaryDirectory() as folder:
        done(sys.executable, "-m", "mvrecon_bench.stress", f"out={folder}/stress")
        rows = json.loads((Path(folder) / "stress" / "verdicts.json").read_text())
    parts: dict[str, Counter] = {}
    for row in rows:
        parts.setdefault(f"{row['part']}, {row['dtype']}", Counter())[row["verdict"]] += 1
    failed = [
        f"{row['number']:.0f} {row['case']}, {row['part']}"
        for row in rows
        if row["verdict"] == FAIL
    ]
    cases, numbers = {(row["number"], row["case"]) for row in rows}, {row["number"] for row in rows}
    return {
        "parts": parts,
        "rows": len(rows),
        "cases": len(cases),
        "numbers": len(numbers),
        "failed": failed,
    }


def fuzz(given: argparse.Namespace) -> Any:
    """What became of damaged files, reader by reader."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        done(
            sys.executable, "-m", "tests.faults.fuzzing", str(given.seed), str(given.fuzz), str(out)
        )
        return json.loads(out.read_text())


def kills(given: argparse.Namespace) -> Any:
    """Trainings that were killed at random and went on."""
    said = done(sys.executable, "-m", "tests.training.lives", str(given.kills), str(given.seed))
    return json.loads(said.splitlines()[-1])


def properties(_: argparse.Namespace) -> Any:
    """Random geometries that the properties were tried on."""
    options = ("-q", "--hypothesis-show-statistics", "-p", "no:cacheprovider")
    said = done(sys.executable, "-m", "pytest", "tests/properties", *options)
    # what shrinks a failure does not count
    told = r"during generate phase.*?(\d+) passing, (\d+) failing"
    counted = [tuple(map(int, found)) for found in re.findall(told, said, re.S)]
    return {
        "properties": len(counted),
        "examples": sum(a for a, _ in counted),
        "failing": sum(b for _, b in counted),
    }


def soak(given: argparse.Namespace) -> Any:
    """Training and evaluating in a loop."""
    said = done(sys.executable, "scripts/soak.py", "--seconds", str(given.soak))
    return {"seconds": given.soak, **json.loads(said.splitlines()[-1])}


STEPS: dict[str, Callable[[argparse.Namespace], Any]] = {
    "stress": stress,
    "properties": properties,
    "fuzz": fuzz,
    "kills": kills,
    "soak": soak,
}


PROSE = """# What the numbers can be trusted with

**Promises.** For every registered operator, rig and method: <A x, y> = <x, A^T y> within 1e-5 of
|A x| |y| in float32 and 1e-12 in float64; twice the object, twice the views. The same bits in every
run and with any number of threads: operators, warps and classical methods. Networks: in every run
on as many threads; on any number with `trainer.deterministic=true`. Geometry is float64 until it is
in voxels, so neither voxel sizes of 1e-6 to 1e6 mm nor offsets to 1e6 mm cost a digit. What does
not fit (shape, device, dtype, NaN, handedness, units) is refused, with what was got and what was
expected.

`mvrecon-stress` does the plan to any part, a plugin's included:
`mvrecon-stress 'parts=[my_projector]' plugins=[my_module]`. Each row says what must hold, what was
measured and what is allowed; n/a is what a part is not made for, with the reason. Where half
precision is safe:
[operators.md](operators.md). Hostile files: [SECURITY.md](../SECURITY.md).

"""


def page(found: dict[str, Any], seed: int) -> str:
    """The page."""
    text = PROSE + markdown(("what", "figure", "command"), figures(**found), 3)
    tried = {
        part: counts
        for part, counts in found["stress"]["parts"].items()
        if set(counts) != {LEFT_OUT}
    }
    parts = [
        (part, *(str(counts.get(verdict, 0)) for verdict in VERDICTS))
        for part, counts in tried.items()
    ]
    text += (
        "\n## The stress plan, part by part\n\nWithout the parts of plugins whose packages "
        "are not installed.\n\n"
    )
    text += markdown(("part", *VERDICTS), parts)
    failed = *found["stress"]["failed"], *found["kills"]["runs that differ"]
    text += "".join(f"\nFailed: {line.removesuffix('.')}.\n" for line in failed)
    text += (
        "\n## Damaged files, reader by reader\n\nWhat has checksums (volume files written by "
        "mvrecon, packed NIfTI, checkpoints) is refused or has the values that were written. "
        "Plain .nii, HDF5 of others, JSON and YAML have none: a flipped bit in a value is not "
        "noticed.\n\n"
    )
    text += markdown(
        ("reader", "inputs", "read", "failures", "slowest s", "most MB"),
        list(readers(found["fuzz"])),
    )
    made = ", ".join(f"{name} {versions()[name]}" for name in ("python", "torch", "numba"))
    return f"{text}\nMade by `python scripts/trust.py --seed {seed}` with {made}.\n"


def total(rows: dict[str, dict[str, int]]) -> str:
    """The verdicts of all rows of a table, in words."""
    counts = sum(map(Counter, rows.values()), Counter())
    return ", ".join(f"{counts[name]} {name}" for name in VERDICTS)


def figures(
    stress: Any, properties: Any, fuzz: Any, kills: Any, soak: Any
) -> list[tuple[str, str, str]]:
    """What was done, how often, and the command that does it."""
    inputs, hurt = (
        sum(one["inputs"] for one in fuzz.values()),
        sum(len(one["failures"]) for one in fuzz.values()),
    )
    slowest, largest = (max(one[name] for one in fuzz.values()) for name in ("seconds", "peak"))
    lost = len(kills["runs that differ"])
    return [
        (
            "cases of the stress plan (numbers of the plan)",
            f"{stress['cases']} ({stress['numbers']})",
            "`mvrecon-stress`",
        ),
        ("verdicts on all parts", total(stress["parts"]), ""),
        ("properties", str(properties["properties"]), "`pytest tests/properties`"),
        ("random geometries that they were tried on", str(properties["examples"]), ""),
        ("of these, failures", str(properties["failing"]), ""),
        ("damaged files given to readers", str(inputs), "`python -m tests.faults.fuzzing`"),
        ("of these, failures", str(hurt), ""),
        ("the slowest; the most memory", f"{slowest:.2f} s; {largest / 2**20:.0f} MB", ""),
        (
            "trainings killed at random, and resumed",
            str(kills["kills"]),
            "`python -m tests.training.lives`",
        ),
        ("of these, with one byte lost or one bit of a weight changed", str(lost), ""),
        (
            "minutes of training and evaluating in a loop",
            f"{soak['seconds'] / 60:.0f}",
            "`python scripts/soak.py`",
        ),
        (
            "its rounds; growth of memory a round",
            f"{soak['rounds']}; {soak['mb_a_round']:.3f} MB",
            "",
        ),
    ]


def readers(fuzz: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """What became of each reader's damaged files."""
    for name, one in fuzz.items():
        counts = (str(one["inputs"]), str(one["read"]), str(len(one["failures"])))
        yield name, *counts, f"{one['seconds']:.2f}", f"{one['peak'] / 2**20:.0f}"


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=7, help="of all that is random (default: 7)")
    parser.add_argument(
        "--fuzz", type=int, default=9000, help="damaged files for each reader (default: 9000)"
    )
    parser.add_argument("--kills", type=int, default=72, help="trainings to kill (default: 72)")
    parser.add_argument(
        "--soak",
        type=float,
        default=3600.0,
        help="seconds of training in a loop (default: an hour)",
    )
    given, found = parser.parse_args(), {}
    FOUND.mkdir(parents=True, exist_ok=True)
    for name, step in STEPS.items():
        file = FOUND / f"{name}.json"
        if not file.exists():
            print(f"{name}: {step.__doc__}", flush=True)
            answer = json.dumps(step(given), indent=1)
            with written_whole(file) as part:
                part.write_text(answer)
        found[name] = json.loads(file.read_text())
    with written_whole(ROOT / "docs" / "trust.md") as part:
        part.write_text(page(found, given.seed))
    print("docs/trust.md is written")


if __name__ == "__main__":
    main()
