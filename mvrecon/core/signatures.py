"""What a part is and takes, read from its source and not imported: docstring, options, defaults."""

import ast
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from typing import Any

from mvrecon.core.parts import LISTED, REGISTRIES
from mvrecon.core.registry import installed, locate

#: What the apps and the models pass in, no options.
GIVEN = {
    *("self", "cls", "grid", "cameras", "projector", "task", "params"),
    *("inputs", "outputs", "A", "views", "counts", "read"),
}
#: Kinds of the settings that are called otherwise.
KINDS = {"test_scene": "scene"}
#: Settings that are no parts, and what takes them.
SECTIONS = {
    "grid": "mvrecon.geometry.grid:Grid.centred",
    "data": "mvrecon.data.module:Loading",
    "acquisition": "mvrecon.data.acquisition.detector:Acquisition",
    "loss": "mvrecon.training.losses:Weights",
}

Definition = ast.ClassDef | ast.FunctionDef
#: The lines of a class or a function in a module, its decorators included.
LINES = re.compile(
    r"^(?:@.*\n(?:[ )\]}].*\n)*)*(?:class|def) (\w+)\b.*\n(?:(?:[ \t)\]}].*)?\n)*", re.M
)


@dataclass(frozen=True)
class Option:
    """One option of a part: its default and its type as written ("" is none), and its text in the
    docstring, with the unit.
    """

    default: str = ""
    type: str = ""
    text: str = ""


@dataclass(frozen=True)
class Part:
    """What a reader wants to know of one part: `catch_all` says that it takes further options;
    `error` says why it cannot be used or described.
    """

    kind: str
    name: str
    origin: str
    summary: str = ""
    options: Mapping[str, Option] = field(default_factory=dict)
    catch_all: bool = False
    error: str = ""


def describe(kind: str, name: str, check: bool = False) -> Part:
    """One part, from its source alone; with `check` it is imported too, and `error` tells what that
    raised.
    """
    origin = ""
    try:
        origin = LISTED[kind].origin(name)
        if check:
            LISTED[kind].get(name)
        module, _, attribute = origin.partition(":")
        module, node = definition(module, attribute)
    except (LookupError, ImportError, SyntaxError) as error:
        return Part(kind, name, origin, error=str(error))
    summary = (ast.get_docstring(node) or "").partition("\n\n")[0].replace("\n", " ")
    options, catch_all = _options(module, node)
    return Part(kind, name, origin + _release(kind, name), summary, options, catch_all)


def definition(module: str, name: str) -> tuple[str, Definition]:
    """Find where a class or a function is written, through `from ... import`, and its syntax tree.

    Raises:
        ImportError: there is no such module, or no such name in it.
    """
    with suppress(SyntaxError):  # a string whose lines begin at the margin; the module then tells
        body = ast.parse(_lines(module).get(name, "")).body
        if body and isinstance(body[0], Definition):
            return module, body[0]
    for node in _tree(module).body:  # ten times as slow as its lines alone
        if isinstance(node, Definition) and node.name == name:
            return module, node
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return definition(_absolute(module, node), alias.name)
    raise ImportError(f"{module} defines no class or function {name!r}")


def _absolute(module: str, node: ast.ImportFrom) -> str:
    """The module that `from ... import` in another names, its leading dots resolved."""
    spec = locate(module)
    is_package = spec is not None and spec.submodule_search_locations is not None
    package = module if is_package else module.rpartition(".")[0]
    return resolve_name("." * node.level + (node.module or ""), package)


def describe_section(section: str) -> Part:
    """A setting that is no part, one of `SECTIONS`, as a part of the kind "setting"."""
    summary = f"The options of `{section}.` in a configuration."
    return Part("setting", section, SECTIONS[section], summary, options_of(section))


def options_of(section: str) -> Mapping[str, Option]:
    """The options of a setting that is no part, one of `SECTIONS`."""
    module, _, name = SECTIONS[section].partition(":")
    owner, _, method = name.partition(".")
    module, node = definition(module, owner)
    if not method:
        return _options(module, node)[0]
    made = next(m for m in node.body if isinstance(m, ast.FunctionDef) and m.name == method)
    return _arguments(made, _texts(ast.get_docstring(made) or ""))[0]


def parts_in(
    settings: Mapping[str, Any], path: str = ""
) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Every part that plain settings name, at any depth: its path, its kind and its node."""
    for key, node in settings.items():
        if not isinstance(node, Mapping):
            continue
        kind = "method" if path == "compare." else KINDS.get(str(key), str(key))
        if kind in REGISTRIES and isinstance(node.get("name"), str):
            yield f"{path}{key}", kind, node
        yield from parts_in(node, f"{path}{key}.")


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_source(module))


@cache
def _lines(module: str) -> dict[str, str]:
    """The lines of each class and function of a module, the first of a name."""
    return {m[1]: m[0] for m in reversed([*LINES.finditer(_source(module))])}


@cache
def _source(module: str) -> str:
    spec = locate(module)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        raise ImportError(f"No source found for module {module!r}")
    return Path(spec.origin).read_text(encoding="utf-8")


def _options(module: str, node: Definition) -> tuple[dict[str, Option], bool]:
    """The options of a function, of a class's `__init__`, or a dataclass's fields with its bases';
    and whether it takes others.
    """
    texts = _texts(ast.get_docstring(node) or "")
    if isinstance(node, ast.FunctionDef):
        return _arguments(node, texts)
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            return _arguments(member, texts | _texts(ast.get_docstring(member) or ""))
    options, catch_all = {}, False
    for base in node.bases:
        with suppress(ImportError):  # a base of another library has no options of ours
            if isinstance(base, ast.Name):
                inherited, others = _options(*definition(module, base.id))
                options, catch_all = options | inherited, catch_all or others
    if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
        for name, option in _fields(node, texts).items():
            inherited_text = options.get(name, option).text
            options[name] = replace(option, text=option.text or inherited_text)
    return {
        name: replace(option, text=option.text or texts.get(name, ""))
        for name, option in options.items()
    }, catch_all


def _texts(docstring: str) -> dict[str, str]:
    """The text of each argument in a docstring's section `Args`."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", docstring, re.M | re.S)
    entries = re.findall(
        r"^    (\w[\w, ]*): (.*?)(?=^    \w|\Z)", section[1] if section else "", re.M | re.S
    )
    return {
        name: " ".join(text.split())
        for names, text in entries
        for name in re.findall(r"\w+", names)
    }


def _arguments(
    function: ast.FunctionDef, texts: Mapping[str, str]
) -> tuple[dict[str, Option], bool]:
    a = function.args
    positional = [*a.posonlyargs, *a.args]
    defaults = [None] * (len(positional) - len(a.defaults)) + a.defaults
    pairs = [
        *zip(positional, defaults, strict=True),
        *zip(a.kwonlyargs, a.kw_defaults, strict=True),
    ]
    options = {
        argument.arg: Option(
            _written(default), _written(argument.annotation), texts.get(argument.arg, "")
        )
        for argument, default in pairs
        if argument.arg not in GIVEN
    }
    return options, a.kwarg is not None


def _fields(node: ast.ClassDef, texts: Mapping[str, str]) -> dict[str, Option]:
    return {
        member.target.id: Option(
            _written(member.value), _written(member.annotation), texts.get(member.target.id, "")
        )
        for member in node.body
        if isinstance(member, ast.AnnAssign)
        and isinstance(member.target, ast.Name)
        and "ClassVar" not in ast.unparse(member.annotation)
        and "init=False" not in _written(member.value)
    }


def _written(expression: ast.expr | None) -> str:
    return "" if expression is None else ast.unparse(expression)


def _release(kind: str, name: str) -> str:
    """Which release of which plugin a part comes from; nothing for mvrecon's own."""
    for point in installed():
        if point.name == f"{kind}.{name}" and point.dist is not None:
            return f" ({point.dist.name} {point.dist.version})"
    return ""
