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


def mixed_tuples(source: str) -> list[str]:
    """Parameters of public functions that are annotated as a tuple of three or more members of
    different types: several parameters in one.
    """
    bundles = []
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef) or function.name.startswith("_"):
            continue
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        bundles += [
            f"{function.name}({argument.arg})"
            for argument in arguments
            for node in ast.walk(argument.annotation or ast.Constant(None))
            if isinstance(node, ast.Subscript)
            and ast.unparse(node.value) in ("tuple", "Tuple")
            and isinstance(node.slice, ast.Tuple)
            and len(node.slice.elts) > 2
            and len({ast.unparse(member) for member in node.slice.elts}) > 1
        ]
    return bundles


def test_a_tuple_that_bundles_parameters_is_recognised():
    assert mixed_tuples("def f(a: int, b: tuple[int, str, float] | None): ...") == ["f(b)"]
    assert mixed_tuples("class A:\n    def g(self, *, c: list[tuple[int, int, str]]): ...") == [
        "g(c)"
    ]
    assert not mixed_tuples("def f(a: tuple[int, int, int], b: tuple[int, ...]): ...")


@pytest.mark.parametrize(
    "file", sorted((ROOT / "mvrecon").rglob("*.py")), ids=lambda f: str(f.relative_to(ROOT))
)
def test_no_parameter_is_a_tuple_of_several(file: Path):
    assert mixed_tuples(file.read_text()) == []
