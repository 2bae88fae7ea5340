"""Types of options with a known range or length; settings are checked against them before anything
is computed.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeAlias, TypeVar

from annotated_types import Ge, Gt, Len

T = TypeVar("T")

PositiveInt: TypeAlias = Annotated[int, Gt(0)]
NonNegativeInt: TypeAlias = Annotated[int, Ge(0)]
PositiveFloat: TypeAlias = Annotated[float, Gt(0)]
NonNegativeFloat: TypeAlias = Annotated[float, Ge(0)]
#: Along (v, u), or the least and the greatest.
Pair: TypeAlias = Annotated[Sequence[T], Len(2, 2)]
#: Along (x, y, z).
Triple: TypeAlias = Annotated[Sequence[T], Len(3, 3)]

#: Marks a path that may also be the name of weights that mvrecon ships.
WEIGHTS_MARK = "weights"
#: Mark a path that may also be the name of a data set in the scan's file, and one of no folder.
INSIDE_MARK, FILE_MARK = "inside", "file"
#: A path of weights, or their name.
WeightsFile: TypeAlias = Annotated[str | Path, WEIGHTS_MARK]
#: A path, or that of a file, or else the name of a data set in the scan's file.
InsideOrPath: TypeAlias = Annotated[str | Path, INSIDE_MARK]
InsideOrFile: TypeAlias = Annotated[InsideOrPath, FILE_MARK]
