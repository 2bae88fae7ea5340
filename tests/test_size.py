"""Files stay within 300 lines and functions within 60; nothing prints."""

import ast
from collections.abc import Callable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = sorted((ROOT / "mvrecon").rglob("*.py"))
FILES = sorted(
    f for folder in ("mvrecon", "scripts", "plugins") for f in (ROOT / folder).rglob("*.py")
)
SHELL = sorted((ROOT / "scripts").glob("*.sh"))


@cache
def nodes(file: Path) -> list[ast.AST]:
    """The syntax of a file, read once for all rules."""
    return list(ast.walk(ast.parse(file.read_text())))


def functions(file: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    kinds = ast.FunctionDef | ast.AsyncFunctionDef
    return [node for node in nodes(file) if isinstance(node, kinds)]


def broken(files: list[Path], rule: Callable[[Path], object]) -> dict[str, object]:
    """What a rule objects to in each file; files that keep it are left out."""
    return {str(f.relative_to(ROOT)): objection for f in files if (objection := rule(f))}


def length(file: Path) -> int:
    return len(file.read_text().splitlines())


def test_no_file_is_too_long():
    assert broken([*FILES, *SHELL], lambda f: max(0, length(f) - 300)) == {}


def long_functions(file: Path) -> dict[str, int]:
    return {
        f.name: lines for f in functions(file) if (lines := (f.end_lineno or 0) - f.lineno + 1) > 60
    }


def test_no_function_is_too_long():
    assert broken(FILES, long_functions) == {}


def many_parameters(file: Path) -> dict[str, set[str]]:
    taken = {
        f.name: {a.arg for a in f.args.args + f.args.kwonlyargs} - {"self", "cls"}
        for f in functions(file)
    }
    return {name: names for name, names in taken.items() if len(names) > 7}


def test_no_function_has_too_many_parameters():
    assert broken(FILES, many_parameters) == {}


def prints(file: Path) -> list[int]:
    calls = (n for n in nodes(file) if isinstance(n, ast.Call))
    return [c.lineno for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"]


def test_the_package_does_not_print():
    assert broken(PACKAGE, prints) == {}


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
