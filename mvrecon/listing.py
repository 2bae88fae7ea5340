"""`mvrecon-list`: every part by name, what it is, its options, and where it comes from.

Sources are read, not imported, so the answer comes at once and a broken plugin disturbs nobody;
`--check` imports.
"""

import argparse
import ast
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from mvrecon.parts import REGISTRIES
from mvrecon.registry import installed, locate

#: What the apps and the models pass in, no options.
GIVEN = {
    *("self", "grid", "cameras", "projector", "task"),
    *("inputs", "outputs", "A", "views", "counts"),
}

Definition = ast.ClassDef | ast.FunctionDef


@dataclass(frozen=True)
class Part:
    """What a reader wants to know of one part: `options` maps names to defaults as written ("" is
    none); `error` says why it cannot be used or described."""

    kind: str
    name: str
    origin: str
    summary: str = ""
    options: Mapping[str, str] = field(default_factory=dict)
    error: str = ""


def describe(kind: str, name: str, check: bool = False) -> Part:
    """One part, from its source alone; with `check` it is imported too, and `error` tells what that
    raised.
    """
    origin = ""
    try:
        origin = REGISTRIES[kind].origin(name)
        if check:
            REGISTRIES[kind].get(name)
        module, _, attribute = origin.partition(":")
        module, node = definition(module, attribute)
    except (LookupError, ImportError, SyntaxError) as error:
        return Part(kind, name, origin, error=str(error))
    summary = (ast.get_docstring(node) or "").partition("\n\n")[0].replace("\n", " ")
    return Part(kind, name, origin + _release(kind, name), summary, _options(module, node))


def definition(module: str, name: str) -> tuple[str, Definition]:
    """Find where a class or a function is written, through `from ... import`, and its syntax tree.

    Raises:
        ImportError: there is no such module, or no such name in it.
    """
    for node in _tree(module).body:
        if isinstance(node, Definition) and node.name == name:
            return module, node
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return definition(node.module, alias.name)
    raise ImportError(f"{module} defines no class or function {name!r}")


@cache
def _tree(module: str) -> ast.Module:
    spec = locate(module)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        raise ImportError(f"No source found for module {module!r}")
    return ast.parse(Path(spec.origin).read_text(encoding="utf-8"))


def _options(module: str, node: Definition) -> dict[str, str]:
    """Each option's default: a function's, a class's `__init__`'s, or a dataclass's fields with its
    bases'.
    """
    if isinstance(node, ast.FunctionDef):
        return _arguments(node)
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            return _arguments(member)
    options = {}
    for base in node.bases:
        with suppress(ImportError):  # a base of another library has no options of ours
            if isinstance(base, ast.Name):
                options |= _options(*definition(module, base.id))
    if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
        options |= _fields(node)
    return options


def _arguments(function: ast.FunctionDef) -> dict[str, str]:
    a = function.args
    positional = [*a.posonlyargs, *a.args]
    defaults = [None] * (len(positional) - len(a.defaults)) + a.defaults
    pairs = [
        *zip(positional, defaults, strict=True),
        *zip(a.kwonlyargs, a.kw_defaults, strict=True),
    ]
    return {
        argument.arg: _written(default) for argument, default in pairs if argument.arg not in GIVEN
    }


def _fields(node: ast.ClassDef) -> dict[str, str]:
    return {
        member.target.id: _written(member.value)
        for member in node.body
        if isinstance(member, ast.AnnAssign)
        and isinstance(member.target, ast.Name)
        and "ClassVar" not in ast.unparse(member.annotation)
        and "init=False" not in _written(member.value)
    }


def _written(default: ast.expr | None) -> str:
    return "" if default is None else ast.unparse(default)


def _release(kind: str, name: str) -> str:
    """Which release of which plugin a part comes from; nothing for mvrecon's own."""
    for point in installed():
        if point.name == f"{kind}.{name}" and point.dist is not None:
            return f" ({point.dist.name} {point.dist.version})"
    return ""


def show(parts: Sequence[Part]) -> None:
    """Write the parts to the console, one block each under their kind."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console, table, kind = Console(highlight=False), Table.grid(padding=(0, 2)), ""
    for part in parts:
        if part.kind != kind:
            kind = part.kind
            table.add_row(Text(f"\n{kind}", style="bold"))
        rest = Text(part.summary)
        if part.error:
            rest.append(f"broken: {part.error}", style="red")
        options = ", ".join(
            f"{name}={default}" if default else name for name, default in part.options.items()
        )
        for line in (options, part.origin):
            rest.append(f"\n{line}" if line else "", style="dim")
        table.add_row(Text(f"  {part.name}", style="cyan"), rest)
    console.print(table)


def main(arguments: Sequence[str] | None = None) -> int:
    """The console script; its exit status is 1 if a part that was checked is broken."""
    parser = argparse.ArgumentParser(
        prog="mvrecon-list", description="Lists the parts that a configuration can name."
    )
    parser.add_argument(
        "kind", nargs="?", choices=sorted(REGISTRIES), help="only this kind of part"
    )
    parser.add_argument(
        "--check", action="store_true", help="import every part, and say which are broken and why"
    )
    options = parser.parse_args(arguments)
    kinds = [options.kind] if options.kind else REGISTRIES
    parts = [
        describe(kind, name, options.check) for kind in kinds for name in REGISTRIES[kind].names()
    ]
    show(parts)
    return int(options.check and any(part.error for part in parts))


if __name__ == "__main__":
    raise SystemExit(main())
