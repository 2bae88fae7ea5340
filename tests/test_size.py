"""Files stay within 300 lines and functions within 60; nothing prints."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted(
    f for folder in ("mvrecon", "scripts", "plugins") for f in (ROOT / folder).rglob("*.py")
)
SHELL = sorted((ROOT / "scripts").glob("*.sh"))


@pytest.mark.parametrize("file", [*FILES, *SHELL], ids=lambda f: str(f.relative_to(ROOT)))
def test_a_file_is_not_too_long(file: Path):
    assert len(file.read_text().splitlines()) <= 300


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_no_function_is_too_long(file: Path):
    functions = (
        n
        for n in ast.walk(ast.parse(file.read_text()))
        if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
    )
    long = {f.name: lines for f in functions if (lines := (f.end_lineno or 0) - f.lineno + 1) > 60}
    assert not long


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_no_function_has_too_many_parameters(file: Path):
    functions = (n for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.FunctionDef))
    taken = {
        f.name: {a.arg for a in f.args.args + f.args.kwonlyargs} - {"self", "cls"}
        for f in functions
    }
    assert not {name: names for name, names in taken.items() if len(names) > 7}


@pytest.mark.parametrize(
    "file", sorted((ROOT / "mvrecon").rglob("*.py")), ids=lambda f: str(f.relative_to(ROOT))
)
def test_the_package_does_not_print(file: Path):
    calls = (n for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.Call))
    assert not [c.lineno for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"]


def test_the_median_file_is_short():
    lengths = sorted(
        n for f in (ROOT / "mvrecon").rglob("*.py") if (n := len(f.read_text().splitlines()))
    )
    assert lengths[len(lengths) // 2] <= 120
