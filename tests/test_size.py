"""Files stay within 300 lines and functions within 60; nothing prints."""

import ast
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGE = sorted((ROOT / "mvrecon").rglob("*.py"))
FILES = sorted(
    f for folder in ("mvrecon", "scripts", "plugins") for f in (ROOT / folder).rglob("*.py")
)
SHELL = sorted((ROOT / "scripts").glob("*.sh"))


class Function(NamedTuple):
    """A function or method: its name, its length, and what it takes."""

    name: str
    lines: int
    parameters: set[str]


class Source(NamedTuple):
    """What the rules ask of a file: its functions, and the lines that print."""

    functions: list[Function]
    prints: list[int]


@cache
def source(file: Path) -> Source:
    """A file, read once for several rules; its syntax itself would fill the memory."""
    functions, prints = [], []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            parameters = {a.arg for a in node.args.args + node.args.kwonlyargs} - {"self", "cls"}
            lines = (node.end_lineno or 0) - node.lineno + 1
            functions.append(Function(node.name, lines, parameters))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            prints += [node.lineno] * (node.func.id == "print")
    return Source(functions, prints)


def broken(files: list[Path], rule: Callable[[Path], object]) -> dict[str, object]:
    """What a rule objects to in each file; files that keep it are left out."""
    return {str(f.relative_to(ROOT)): objection for f in files if (objection := rule(f))}


def length(file: Path) -> int:
    return len(file.read_text().splitlines())


def test_no_file_is_too_long():
    assert broken([*FILES, *SHELL], lambda f: max(0, length(f) - 300)) == {}


def test_no_function_is_too_long():
    assert broken(FILES, lambda f: [x for x in source(f).functions if x.lines > 60]) == {}


def test_no_function_has_too_many_parameters():
    assert broken(FILES, lambda f: [x for x in source(f).functions if len(x.parameters) > 7]) == {}


def test_the_package_does_not_print():
    assert broken(PACKAGE, lambda f: source(f).prints) == {}


def test_the_median_file_is_short():
    lengths = sorted(filter(None, map(length, PACKAGE)))
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


def test_no_parameter_is_a_tuple_of_several():
    assert broken(PACKAGE, lambda f: mixed_tuples(f.read_text())) == {}
