"""Start-up: nothing heavy is imported before it is needed, and importing says nothing."""

import pytest

HEAVY = (
    "{'torch', 'lightning', 'kornia', 'torchmetrics', 'numba', 'h5py', 'tensorboard', 'matplotlib'}"
)
REPORT = (
    f"import atexit, sys; atexit.register(lambda: print('HEAVY', sorted({HEAVY} & "
    f"set(sys.modules))));"
)
COMMANDS = {
    "train --help": "train",
    "eval --help": "eval",
    "simulate --help": "simulate",
    "list": "list",
    "list --help": "list",
    "train --cfg job": "train",
    "train projectr=drr": "train",
    "train camera.n_views=abc": "train",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_quick_answer_imports_nothing_heavy(run_python, command: str):
    argv = [f"mvrecon-{command.split()[0]}", *command.split()[1:]]
    code = (
        f"{REPORT} sys.argv = {argv!r}; from mvrecon.apps.{COMMANDS[command]} import main; "
        "sys.exit(main())"
    )
    done = run_python("-c", code)
    assert "HEAVY []" in done.stdout, done.stdout + done.stderr
    assert done.returncode == ("=" in command), done.stderr
    if "--help" in command:  # Hydra's own help takes a second to compose
        assert done.stdout.lower().startswith(f"usage: {argv[0]}")


def test_importing_says_nothing_and_imports_nothing_heavy(run_python):
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
