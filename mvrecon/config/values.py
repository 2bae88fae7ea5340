"""Whether a plain value has the type that is written in a signature, and such a type in words."""

import ast
from typing import Any

from mvrecon.quantities import LENGTHS, RANGES

#: What a value of a plain type may be; a whole number serves as a float.
PLAIN = {"int": (int,), "float": (int, float), "bool": (bool,), "str": (str,)}


def fits(value: Any, type: ast.expr) -> bool:
    """Whether a plain value has a written type; True where the type is none of those known here."""
    match type:
        case ast.BinOp(left, ast.BitOr(), right):
            return fits(value, left) or fits(value, right)
        case ast.Constant(None):
            return value is None
        case ast.Name(name) if name in RANGES:
            plain, least = RANGES[name]
            return fits(value, ast.Name(plain)) and (value > 0 or (value == 0 and least == ">= 0"))
        case ast.Name(name) if name in PLAIN:
            # bool is a kind of int for Python, not for a reader
            return isinstance(value, PLAIN[name]) and isinstance(value, bool) == (name == "bool")
        case ast.Subscript(ast.Name("Literal"), names):
            return value in _literals(names)
        case ast.Subscript(ast.Name("Sequence" | "list" | "tuple" | "Pair" | "Triple"), _):
            items, open_end = _items(type)
            if not isinstance(value, list) or not (open_end or len(value) == len(items)):
                return False
            expected = items * len(value) if open_end else items
            return all(map(fits, value, expected))
    return True


def in_words(type: str) -> str:
    """A written type as a user would write a value of it in YAML; "" stays."""
    return _spoken(parsed(type)) if type else ""


def parsed(type: str) -> ast.expr:
    """The syntax tree of a written type."""
    return ast.parse(type, mode="eval").body


def _spoken(type: ast.expr) -> str:
    match type:
        case ast.BinOp(left, ast.BitOr(), right):
            return f"{_spoken(left)} or {_spoken(right)}"
        case ast.Constant(None):
            return "null"
        case ast.Name(name) if name in RANGES:
            return " ".join(RANGES[name])
        case ast.Subscript(ast.Name("Literal"), names):
            return " or ".join(map(str, _literals(names)))
        case ast.Subscript(ast.Name("Sequence" | "list" | "tuple" | "Pair" | "Triple"), _):
            items, open_end = _items(type)
            return f"[{', '.join(map(_spoken, items))}{', ...' if open_end else ''}]"
    return ast.unparse(type)


def _literals(names: ast.expr) -> list[Any]:
    return [ast.literal_eval(n) for n in (names.elts if isinstance(names, ast.Tuple) else [names])]


def _items(type: ast.Subscript) -> tuple[list[ast.expr], bool]:
    """The types of a list's entries, and whether there may be any number of the first."""
    name = type.value.id if isinstance(type.value, ast.Name) else ""
    if name in LENGTHS:
        return [type.slice] * LENGTHS[name], False
    if name != "tuple" or not isinstance(type.slice, ast.Tuple):
        return [type.slice], True
    first, *others = type.slice.elts
    if others and isinstance(others[-1], ast.Constant) and others[-1].value is ...:
        return [first], True
    return [first, *others], False
