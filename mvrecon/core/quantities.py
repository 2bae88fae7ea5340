"""Types of options with a known range or length, so that invalid values raise an error before
anything is computed.

For type checkers they are plain numbers and sequences. Settings are checked against the names of
the types as written in a signature.
"""

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

T = TypeVar("T")

PositiveInt: TypeAlias = int
NonNegativeInt: TypeAlias = int
PositiveFloat: TypeAlias = float
NonNegativeFloat: TypeAlias = float
#: Along (v, u), or the least and the greatest.
Pair: TypeAlias = Sequence[T]
#: Along (x, y, z).
Triple: TypeAlias = Sequence[T]

#: A path of weights, or their name.
WeightsFile: TypeAlias = str | Path

#: Types of paths, which are texts in settings.
PATHS = ("Path", "WeightsFile")
#: Base type of a number, and its exclusive (">") or inclusive (">=") lower bound.
RANGES = {
    "PositiveInt": ("int", "> 0"),
    "NonNegativeInt": ("int", ">= 0"),
    "PositiveFloat": ("float", "> 0"),
    "NonNegativeFloat": ("float", ">= 0"),
}
LENGTHS = {"Pair": 2, "Triple": 3}
#: Types of values that only Python can give.
OBJECT = re.compile(r"(\w+\[Tensor, '[^']*'\]|Tensor|Cameras|Monitor|SirtWeights)( \| None)?")
#: Python types for a plain type; a whole number is a valid float.
PLAIN = {"int": (int,), "float": (int, float), "bool": (bool,)}
PLAIN |= dict.fromkeys(("str", *PATHS), (str,))


def settable(type: str) -> bool:
    """Whether a setting other than null may have a written type."""
    return not OBJECT.fullmatch(type)


def fits(value: Any, type: str) -> bool:
    """Whether a plain value has a written type; True for an unknown type or ""."""
    return not type or _fits(value, ast.parse(type, mode="eval").body)


def _fits(value: Any, type: ast.expr) -> bool:
    match type:
        case ast.BinOp(left, ast.BitOr(), right):
            return _fits(value, left) or _fits(value, right)
        case ast.Constant(None):
            return value is None
        case ast.Name(name) if name in RANGES:
            plain, least = RANGES[name]
            return _fits(value, ast.Name(plain)) and (value > 0 or (value == 0 and least == ">= 0"))
        case ast.Name(name) if name in PLAIN:
            # bool is an int in Python, but not here
            return isinstance(value, PLAIN[name]) and isinstance(value, bool) == (name == "bool")
        case ast.Subscript(ast.Name("Literal"), names):
            return value in _literals(names)
        case ast.Subscript(ast.Name("Sequence" | "list" | "tuple" | "Pair" | "Triple"), _):
            items, open_end = _items(type)
            if not isinstance(value, list) or not (open_end or len(value) == len(items)):
                return False
            expected = items * len(value) if open_end else items
            return all(map(_fits, value, expected))
        case ast.Subscript(ast.Name("Mapping" | "dict"), ast.Tuple([_, item])):
            return isinstance(value, Mapping) and all(_fits(each, item) for each in value.values())
    return settable(ast.unparse(type))


def with_paths(value: Any, type: str, change: Callable[[str, str], str]) -> Any:
    """Change every path in a plain value of a written type.

    A text is a path if the type has one of `PATHS`, unless it is one of the type's literals.

    Args:
        value: to copy.
        type: as written; "" if unknown.
        change: f(path, its type).
    """
    return _with_paths(value, ast.parse(type, mode="eval").body, change) if type else value


def _with_paths(value: Any, type: ast.expr, change: Callable[[str, str], str]) -> Any:
    match type:
        case ast.BinOp():
            types = _alternatives(type)
            literal = [t for t in types if ast.unparse(t).startswith("Literal[")]
            if any(_fits(value, t) for t in literal):
                return value
            changed = (_with_paths(value, t, change) for t in types)
            return next((new for new in changed if new != value), value)
        case ast.Name(name) | ast.Attribute(attr=name) if name in PATHS and isinstance(value, str):
            return change(value, name)
        case ast.Subscript(ast.Name("Sequence" | "list" | "tuple" | "Pair" | "Triple"), _):
            if isinstance(value, list):
                items, open_end = _items(type)
                items = items * len(value) if open_end else items
                return [_with_paths(v, t, change) for v, t in zip(value, items, strict=False)]
        case ast.Subscript(ast.Name("Mapping" | "dict"), ast.Tuple([_, item])):
            if isinstance(value, dict):
                return {key: _with_paths(v, item, change) for key, v in value.items()}
    return value


def _alternatives(type: ast.expr) -> list[ast.expr]:
    if isinstance(type, ast.BinOp) and isinstance(type.op, ast.BitOr):
        return [*_alternatives(type.left), *_alternatives(type.right)]
    return [type]


def in_words(type: str) -> str:
    """Describe a written type in a YAML user's terms; "" stays."""
    return _spoken(ast.parse(type, mode="eval").body) if type else ""


def _spoken(type: ast.expr) -> str:
    match type:
        case ast.BinOp(left, ast.BitOr(), right):
            return f"{_spoken(left)} or {_spoken(right)}"
        case ast.Constant(None):
            return "null"
        case ast.Name(name) if name in RANGES:
            return " ".join(RANGES[name])
        case ast.Name(name) if name in PATHS:
            return "path"
        case ast.Subscript(ast.Name("Literal"), names):
            return " or ".join(map(str, _literals(names)))
        case ast.Subscript(ast.Name("Sequence" | "list" | "tuple" | "Pair" | "Triple"), _):
            items, open_end = _items(type)
            return f"[{', '.join(map(_spoken, items))}{', ...' if open_end else ''}]"
        case ast.Subscript(ast.Name("Mapping" | "dict"), _):
            return "a mapping of settings"
    return ast.unparse(type)


def _literals(names: ast.expr) -> list[Any]:
    return [ast.literal_eval(n) for n in (names.elts if isinstance(names, ast.Tuple) else [names])]


def _items(type: ast.Subscript) -> tuple[list[ast.expr], bool]:
    """The types of a list's entries, and whether the first may repeat."""
    name = type.value.id if isinstance(type.value, ast.Name) else ""
    if name in LENGTHS:
        return [type.slice] * LENGTHS[name], False
    if name != "tuple" or not isinstance(type.slice, ast.Tuple):
        return [type.slice], True
    first, *others = type.slice.elts
    if others and isinstance(others[-1], ast.Constant) and others[-1].value is ...:
        return [first], True
    return [first, *others], False
