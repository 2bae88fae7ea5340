"""Check the names, options and types of all parts in plain settings, before anything heavy is
imported.
"""

import ast
from collections.abc import Mapping
from typing import Any

from mvrecon.files.checks import shown
from mvrecon.parts import REGISTRIES
from mvrecon.registry import check_options, hint
from mvrecon.signatures import Option, describe, options_of_grid, parts_in

#: What a value of a plain type may be; a whole number serves as a float.
PLAIN = {"int": (int,), "float": (int, float), "bool": (bool,), "str": (str,)}


def check_parts(settings: Mapping[str, Any]) -> None:
    """Check every part that the settings name against its source: the name, the options, and the
    values whose type is plain; those of the grid, too.

    A name or an option that the modules of `plugins` may bring is left to them.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that a part does not have, or a value of another type.
    """
    if isinstance(grid := settings.get("grid"), Mapping):
        for key, option in options_of_grid().items():
            if (value := grid.get(key)) is not None:  # null: chosen by the app
                _check_type(f"grid.{key}", value, option)
    for path, kind, node in parts_in(settings):
        registry, name = REGISTRIES[kind], node["name"]
        if _later(name):
            continue
        if name not in registry.names():
            if settings.get("plugins"):
                continue
            raise LookupError(f"{path}.name: no {kind} is {name!r}{hint(name, registry.names())}")
        options = {key: value for key, value in node.items() if key != "name"}
        if path == "model" or path.rpartition(".")[0] == "compare":
            _check_assumed(path, options.pop("assume", None), settings.get("projector"))
        _check_options(path, kind, name, options)


def _check_options(path: str, kind: str, name: str, options: Mapping[str, Any]) -> None:
    part = describe(kind, name)
    if part.error:
        return  # whoever builds it says what is wrong
    if not part.catch_all:
        check_options(f"{path} (the {kind} {name!r})", options, part.options)
    for key, value in options.items():
        _check_type(f"{path}.{key}", value, part.options.get(key, Option()))


def _check_assumed(path: str, assumed: Any, projector: Mapping[str, Any] | None) -> None:
    """Check what a method takes the projector for: some of its options."""
    if assumed is None or not projector or "name" not in projector:
        return
    if not isinstance(assumed, Mapping):
        raise TypeError(f"{path}.assume: expected options of the projector, got {shown(assumed)}")
    part = describe("projector", projector["name"])
    if not part.error and not part.catch_all:
        where = f"{path}.assume (the projector {projector['name']!r})"
        check_options(where, assumed, part.options)


def _check_type(path: str, value: Any, option: Option) -> None:
    if (
        option.type
        and not _later(value)
        and not fits(value, ast.parse(option.type, mode="eval").body)
    ):
        text = f" ({option.text})" if option.text else ""
        raise TypeError(f"{path}: expected {option.type}, got {shown(value)}{text}")


def _later(value: Any) -> bool:
    """Whether a setting has its value from another one, or is not given yet."""
    return isinstance(value, str) and (value == "???" or "${" in value)


def fits(value: Any, type: ast.expr) -> bool:
    """Whether a plain value has a written type; True where the type is none of the plain ones."""
    match type:
        case ast.BinOp(left, ast.BitOr(), right):
            return fits(value, left) or fits(value, right)
        case ast.Constant(None):
            return value is None
        case ast.Name(name) if name in PLAIN:
            # bool is a kind of int for Python, not for a reader
            return isinstance(value, PLAIN[name]) and isinstance(value, bool) == (name == "bool")
        case ast.Subscript(ast.Name("Literal"), ast.Tuple(names)):
            return value in [ast.literal_eval(name) for name in names]
        case ast.Subscript(ast.Name("Sequence" | "list"), item):
            return isinstance(value, list) and all(fits(entry, item) for entry in value)
    return True
