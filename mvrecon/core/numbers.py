"""Numbers and the types of options: random numbers that depend on the seed and the case alone,
division where the divisor may be zero, and option types whose range or length is known, so that a
wrong value is refused before anything is computed.

To a type checker these types are plain numbers and sequences. Settings are compared with them by
their names, as these are written in a signature.
"""

import ast
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor


def generator(seed: int, index: int) -> torch.Generator:
    """The random numbers of one case.

    Torch's CPU generator takes 32 bits of seed: here the murmur3 finaliser, a bijection, of seed *
    2^32 / phi + index. No two indices of a series share a stream, nor do any two of the series 0 to
    999 below index 10^6.

    Raises:
        ValueError: a negative seed or index.
    """
    if seed < 0 or index < 0:
        raise ValueError(
            f"A case needs a seed and an index of at least 0, got seed {seed}, index {index}"
        )
    return torch.Generator().manual_seed(mixed(seed, index))


@contextmanager
def case_numbers(seed: int, index: int) -> Iterator[None]:
    """Context in which torch's global random numbers are those of one case, so that a scene that
    draws from them is a pure function, too.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(mixed(seed, index))
        yield


def mixed(seed: int, index: int) -> int:
    """The 32 bits that seed the case `index` of the series `seed`."""
    h = (seed * 0x9E3779B9 + index) & 0xFFFFFFFF
    h = ((h ^ h >> 16) * 0x85EBCA6B) & 0xFFFFFFFF
    h = ((h ^ h >> 13) * 0xC2B2AE35) & 0xFFFFFFFF
    return h ^ h >> 16


def uniform(rng: torch.Generator, low: float, high: float) -> float:
    """A number uniform between two others."""
    return low + (high - low) * torch.rand((), generator=rng, dtype=torch.float64).item()


def divided(
    dividend: Float[Tensor, "*#n"] | float, divisor: Float[Tensor, "*#n"], otherwise: float = 0.0
) -> Float[Tensor, "*n"]:
    """Ratio of two tensors where the divisor is positive, elsewhere a number; its gradient is
    finite in both.
    """
    positive = divisor > 0
    return torch.where(positive, dividend / torch.where(positive, divisor, 1), otherwise)


def positive_mean(values: Float[Tensor, "*n"], otherwise: float) -> float:
    """Mean of the positive values of a tensor, in their unit, or a number where there are none; a
    GPU is waited for once.
    """
    positive = values > 0
    mean = (torch.where(positive, values, 0).sum() / positive.sum()).item()
    return otherwise if math.isnan(mean) else mean


T = TypeVar("T")

PositiveInt: TypeAlias = int
NonNegativeInt: TypeAlias = int
PositiveFloat: TypeAlias = float
NonNegativeFloat: TypeAlias = float
#: Along (v, u), or the least and the greatest.
Pair: TypeAlias = Sequence[T]
#: Along (x, y, z).
Triple: TypeAlias = Sequence[T]

#: The plain type of a number, and what it is above (">") or not below (">=").
RANGES = {
    "PositiveInt": ("int", "> 0"),
    "NonNegativeInt": ("int", ">= 0"),
    "PositiveFloat": ("float", "> 0"),
    "NonNegativeFloat": ("float", ">= 0"),
}
LENGTHS = {"Pair": 2, "Triple": 3}
#: What a value of a plain type may be; a whole number serves as a float.
PLAIN = {"int": (int,), "float": (int, float), "bool": (bool,), "str": (str,)}


def fits(value: Any, type: str) -> bool:
    """Whether a plain value has a written type; True where the type is none of those known here, or
    "".
    """
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
            # bool is a kind of int for Python, not for a reader
            return isinstance(value, PLAIN[name]) and isinstance(value, bool) == (name == "bool")
        case ast.Subscript(ast.Name("Literal"), names):
            return value in _literals(names)
        case ast.Subscript(ast.Name("Sequence" | "list" | "tuple" | "Pair" | "Triple"), _):
            items, open_end = _items(type)
            if not isinstance(value, list) or not (open_end or len(value) == len(items)):
                return False
            expected = items * len(value) if open_end else items
            return all(map(_fits, value, expected))
    return True


def in_words(type: str) -> str:
    """A written type as a user would write a value of it in YAML; "" stays."""
    return _spoken(ast.parse(type, mode="eval").body) if type else ""


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
