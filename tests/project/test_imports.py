"""Start-up: heavy modules are imported on demand, and imports print nothing."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = (
    "{'torch', 'lightning', 'kornia', 'torchmetrics', 'numba', 'h5py', 'tensorboard', 'matplotlib'}"
)
REPORT = (
    f"import atexit, sys; atexit.register(lambda: print('HEAVY', sorted({HEAVY} & "
    f"set(sys.modules))));"
)
COMMANDS = (
    *("list", "list --help", "simulate --help", "eval --help", "train --help", "train --cfg job"),
    "train projectr=drr",  # an error; a part whose option is wrong is imported
)
#: Each command in turn: what it printed, how it ended, and what of HEAVY has been imported by then.
CODE = f"""
import contextlib, importlib, io, json
answers = {{}}
for command in {COMMANDS}:
    app, *options = command.split()
    sys.argv, code = [f"mvrecon-{{app}}", *options], 0
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        try:
            code = importlib.import_module(f"mvrecon.apps.{{app}}").main()
        except SystemExit as end:
            code = end.code
    answers[command] = printed.getvalue(), bool(code), sorted({HEAVY} & set(sys.modules))
print(json.dumps(answers))
"""


@pytest.fixture(scope="module")
def quick() -> subprocess.CompletedProcess[str]:
    """All commands in one process, which takes less time than to start one for each."""
    command, root = [sys.executable, "-c", REPORT + CODE], Path(__file__).parents[2]
    return subprocess.run(
        command, cwd=root, capture_output=True, text=True, timeout=900, check=False
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_quick_commands_import_nothing_heavy(quick, command: str):
    assert quick.returncode == 0, quick.stderr
    answers, at_exit = quick.stdout.splitlines()
    printed, failed, heavy = json.loads(answers)[command]
    assert heavy == [] and at_exit == "HEAVY []"
    assert failed == ("=" in command), quick.stderr
    if "--help" in command:  # Hydra's own help takes a second to compose
        assert f"usage: mvrecon-{command.split()[0]}" in printed.lower()


def test_importing_prints_nothing_and_imports_nothing_heavy(run_python):
    names = ("core.registry", "core.parts", "apps.config")
    names += ("apps.train", "apps.eval", "apps.simulate", "apps.list")
    modules = ", ".join(["mvrecon", *(f"mvrecon.{name}" for name in names)])
    done = run_python("-W", "error", "-c", f"{REPORT} import {modules}")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "HEAVY []\n"
    assert done.stderr == ""


@pytest.fixture
def modules(root) -> list[str]:
    """Every module of mvrecon."""
    files = sorted((root / "mvrecon").rglob("*.py"))
    return [
        ".".join(f.relative_to(root).with_suffix("").parts).removesuffix(".__init__") for f in files
    ]


def test_every_module_is_imported_without_those_that_windows_lacks_and_changes_no_global_setting(
    run_python, modules
):
    lacking = ("resource", "fcntl", "pwd", "grp", "termios")
    code = (
        "import sys, torch, warnings, importlib, lightning, torchmetrics, kornia, h5py\n"
        f"sys.modules.update(dict.fromkeys({lacking}))\n"  # the imports before are not ours
        "def state(): return (torch.get_default_dtype(), torch.is_grad_enabled(), "
        "torch.get_num_threads(),"
        " torch.random.get_rng_state().sum().item(), len(warnings.filters))\n"
        "before = state()\n"
        f"for name in {modules}: importlib.import_module(name)\n"
        "assert state() == before, (state(), before)\n"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
