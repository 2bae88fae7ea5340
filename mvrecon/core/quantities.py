"""Types of options whose range or length is known, so that a wrong one is refused before anything
is computed.

To a type checker they are plain numbers and sequences. Settings are compared with them by their
names (`mvrecon/apps/config/typed.py`), as these are written in a signature.
"""

from collections.abc import Sequence
from typing import TypeAlias, TypeVar

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
