"""The scripts for measuring on a GPU: they import, and say what they need."""

import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "scripts" / "gpu").glob("*.py"))
RUN = {
    "check": ["--out", "OUT"],
    "models": ["--out", "OUT"],
    "operators": ["--out", "OUT"],
    "learn": ["--out", "OUT", "--train", "a.h5", "--test", "b.h5"],
}
#: Where there is a GPU, scripts would measure.
COMMANDS = {} if torch.cuda.is_available() else RUN
#: Imports every script, then runs each command as a shell would; what each of them ended with.
CODE = """
import importlib, json, runpy, sys
names, commands, ends = *map(json.loads, sys.argv[1:]), {}
sys.path.insert(0, "scripts/gpu")
for name in names:
    importlib.import_module(name)
for name, words in commands.items():
    sys.argv = [f"scripts/gpu/{name}.py", *words]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as end:
        ends[name] = end.code
sys.exit(json.dumps(ends))
"""


class Ends(NamedTuple):
    """What a process that ran the scripts printed, how each ended, and the folder that they were
    to make.
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
    texts = json.dumps([script.stem for script in SCRIPTS]), json.dumps(commands)
    done = subprocess.run(
        [sys.executable, "-c", CODE, *texts],
        cwd=ROOT,
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
