"""The scripts for measuring on a GPU: they import, and say what they need."""

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from mvrecon_bench import gpu

SCRIPTS = sorted(Path(gpu.__file__).parent.glob("[!_]*.py"))
RUN = {
    "check": ["--out", "OUT"],
    "models": ["--out", "OUT"],
    "operators": ["--out", "OUT"],
    "learn": ["--out", "OUT", "--train", "a.h5", "--test", "b.h5"],
    "pinholes": ["--out", "OUT"],
}
#: Few steps of SIRT before the network.
SHORT = "method.start=2 method.consistency=1"
#: The same on a stand-in for a GPU, as small as can be: every line of the scripts that needs one.
SMALL = {
    "check": ["--n", "8", "--modes"],
    "models": [
        "--n",
        "12",
        "--methods",
        "cross_view",
        "--variants",
        f"method.support=hull {SHORT}",
    ],
    "operators": ["--cases", "12:2:12", "--volumes", "1"],
    "learn": [
        *"--method world_unet --n 8 --views 2".split(),
        *"--cases 2 --val 1 --tests 1 --steps 2 --profile 1 --batch 1".split(),
        "method.widths=[4,8]",
        *SHORT.split(),
    ],
    "pinholes": [
        *"--profile 1 grid.size=[8,8,8] grid.spacing=40.0 data.batch_size=1".split(),
        *"camera.pixels=8 camera.columns=[0] camera.rows=[0,1]".split(),
        *"acquisition.disturbed=null method.widths=[4,8,8]".split(),
        *"method.start.subsets=2 method.consistency.steps=1".split(),
    ],
}
#: Files of results whose name depends on no option.
ONCE = ("check.json", "models.json", "pinholes.json")
#: Where there is a GPU, scripts would measure.
COMMANDS = {} if torch.cuda.is_available() else RUN
#: Imports every script, then runs each command as a shell would; what each of them ended with.
CODE = """
import contextlib, importlib, io, json, sys
names, commands, dry, ends = *map(json.loads, sys.argv[1:]), {}
for name in names:
    importlib.import_module(f"mvrecon_bench.gpu.{name}")
for name, words in commands.items():
    sys.argv = [f"{name}.py", *words]
    try:
        importlib.import_module(f"mvrecon_bench.gpu.{name}").main()
    except SystemExit as end:
        ends[name] = end.code
for name, words in dry.items():
    sys.argv = [f"{name}.py", *words]
    with contextlib.redirect_stdout(io.StringIO()):
        importlib.import_module(f"mvrecon_bench.gpu.{name}").main()
sys.exit(json.dumps(ends))
"""


class Ends(NamedTuple):
    """What a process that ran the scripts printed, how each ended, and the folder that they were
    to make; those that ran on the stand-in made "dry" beside it.
    """

    printed: str
    codes: dict[str, object]
    out: Path


@pytest.fixture(scope="module")
def ends(tmp_path_factory: pytest.TempPathFactory) -> Ends:
    """Every script without a GPU, in one process: to start one takes longer than they do."""
    out = tmp_path_factory.mktemp("scripts") / "out"
    commands = {
        name: [str(out) if word == "OUT" else word for word in words]
        for name, words in COMMANDS.items()
    }
    there = ["--out", str(out.with_name("dry")), "--device", "dry"]
    dry = {name: [*there, *words] for name, words in SMALL.items()} if commands else {}
    names = [script.stem for script in SCRIPTS]
    texts = [json.dumps(argument) for argument in (names, commands, dry)]
    done = subprocess.run(
        [sys.executable, "-c", CODE, *texts],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    *_, last = done.stderr.splitlines()
    assert last.startswith("{"), done.stderr
    return Ends(done.stdout, json.loads(last), out)


def test_every_script_imports_and_prints_nothing(ends: Ends):
    assert SCRIPTS and ends.printed == ""


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("name", RUN)
def test_a_script_without_a_gpu_says_so(name: str, ends: Ends):
    """Before it makes anything."""
    assert f"{name}.py needs a GPU, and torch" in str(ends.codes[name])
    assert not ends.out.exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_every_script_runs_to_its_end_on_a_stand_in(ends: Ends):
    """No part of it fails but what needs CUDA's driver, or a program that is not installed."""
    out = ends.out.with_name("dry")
    facts = {
        path.stem: json.loads(path.read_text())
        for path in (*map(out.joinpath, ONCE), *out.glob("learn_*.json"))
    }
    failed = [
        (script, what, value)
        for script, results in facts.items()
        for what, value in results.items()
        if str(value).startswith(("FAILED", "no time left"))
    ]
    assert len(facts) == 4 and not failed
    (learned,) = (results for script, results in facts.items() if script.startswith("learn_"))
    assert {"profile", "ms per step"} <= learned.keys()
    with open(out / "learn_world_unet_8_bf16.csv") as file:
        (row,) = csv.DictReader(file)
    assert float(row["ms per step"]) == learned["ms per step"] and row["ms_per_step"]
    with open(out / "operators.csv") as file:
        rows = {row["program"]: row for row in csv.DictReader(file)}
    for program in ("mvrecon joseph", "mvrecon siddon skip=off"):
        assert not rows[program]["note"]
        assert all(rows[program][f"{what}_ms"] for what in ("forward", "adjoint", "pose"))
    assert "CUDA's driver cannot be loaded" in rows["mvrecon joseph scatter"]["note"]
