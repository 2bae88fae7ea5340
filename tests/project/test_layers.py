"""Imports run downward only, and each outside library is known where it should be (contracts in
pyproject.toml).
"""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest


def test_the_layers_hold(run_python):
    code = (
        "from importlinter.cli import lint_imports; import sys; "
        "sys.exit(lint_imports(no_cache=True))"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def imported(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


@pytest.mark.parametrize(
    ("name", "home"),
    [
        ("torch.utils.tensorboard", "training/callbacks.py"),
        ("torch.nn.functional.grid_sample", "geometry/lattice.py"),
    ],
)
def test_a_part_of_torch_is_imported_in_one_place(root: Path, name: str, home: str):
    users = {f for f in (root / "mvrecon").rglob("*.py") if name in imported(f)}
    assert users <= {root / "mvrecon" / home}


def test_grid_sample_is_called_in_one_place(root: Path):
    users = {f for f in (root / "mvrecon").rglob("*.py") if "grid_sample(" in f.read_text()}
    assert users == {root / "mvrecon" / "geometry" / "lattice.py"}


def test_modules_of_plugins_import_one_another_in_no_circle(root: Path):
    """Imports in functions count: an attenuation map was checked by the operators that read it."""
    files = {}
    for package in (f.parent for f in (root / "plugins").glob("*/mvrecon_*/__init__.py")):
        for file in package.rglob("*.py"):
            parts = file.relative_to(package.parent).with_suffix("").parts
            files[".".join(parts).removesuffix(".__init__")] = file
    graph = {name: (imported(file) & files.keys()) - {name} for name, file in files.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError
    assert "mvrecon_spect.files.interfile_volume" in graph["mvrecon_spect.operators.matter"]
