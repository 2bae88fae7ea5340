"""A case of the stress plan, a row of data: what is measured, on which parts, and the bound."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from mvrecon.testing.measures import greatest

#: Subjects of cases: a kind of part, or the common base of all parts (tensors, geometry, threads),
#: tested once.
KINDS = ("projector", "camera", "scene", "head", "method", "mvrecon")
#: What a case's function returns.
Measure = Callable[[Any], "float | Iterator[float]"]
DOUBLE, SINGLE = (torch.float64,), (torch.float32,)
BOTH, HALVES = DOUBLE + SINGLE, (torch.bfloat16, torch.float16)
EVERY = BOTH + HALVES


def bound(double: float, single: float) -> dict[torch.dtype, float]:
    """Tolerances by dtype; half precision is storage only, summed in float32."""
    return {torch.float64: double} | dict.fromkeys(SINGLE + HALVES, single)


#: Exact in float64 except for the rotation of rays into voxel space; float32 rounds about ten sums.
EXACT = bound(1e-13, 1e-6)
#: Geometry in float64, relative to the volume, before it is cast; sums of rounded terms.
DIGITS, PRECISE = bound(1e-12, 2e-6), bound(1e-12, 1e-5)


class DoesNotApply(Exception):
    """Raised if a case does not apply to a part; the message contains the reason."""


@dataclass(frozen=True)
class Case:
    """A row of the plan.

    Args:
        number: number in the plan.
        name: name of the case.
        holds: the tested property, which defines the measured number (largest error, count of
            violations, ...).
        kind: kind of the tested parts; one of `KINDS`.
        measure: runs the case on a subject and returns the number that must not exceed the
            tolerance. May raise `DoesNotApply`; any other exception is a failure.
        tolerance: largest error that passes, for all dtypes or per dtype; 0 for exact equality.
        dtypes: supported dtypes; others are skipped.
    """

    number: int
    name: str
    holds: str
    kind: str
    measure: Callable[[Any], float]
    tolerance: float | Mapping[torch.dtype, float] = 0.0
    dtypes: Sequence[torch.dtype] = BOTH

    def allowed(self, dtype: torch.dtype) -> float:
        """The tolerance for a dtype."""
        return self.tolerance[dtype] if isinstance(self.tolerance, Mapping) else self.tolerance


def case(
    kind: str,
    number: int,
    tolerance: float | Mapping[torch.dtype, float] = 0.0,
    dtypes: Sequence[torch.dtype] = BOTH,
) -> Callable[[Measure], Measure]:
    """Make a function a case, whose docstring is `name: property`; see `Case` for the arguments.

    The function returns the measured number, or yields several: errors, of which the greatest
    counts, or with a tolerance of zero numbers of violations, which add up.
    """

    def described(function: Measure) -> Measure:
        def measure(subject: Any) -> float:
            found = function(subject)
            if not isinstance(found, Iterator):
                return found
            return float(sum(found)) if tolerance == 0 else greatest(found)

        name, _, holds = " ".join(str(function.__doc__).split()).rstrip(".").partition(": ")
        row = Case(number, name, holds, kind, measure, tolerance, dtypes)
        function.case = row  # pyrefly: ignore[missing-attribute]
        return function

    return described


def refused(acts: Mapping[str, Callable[[], object]], saying: str | Callable[[str], str]) -> float:
    """Return 0 if every act raises a ValueError.

    Args:
        acts: the calls that must fail, by name.
        saying: regular expression that the message must contain, or a function of the name.

    Raises:
        AssertionError: some acts do not fail so; the message begins with their number.
    """
    faults = {}
    for name, act in acts.items():
        words = saying if isinstance(saying, str) else saying(name)
        try:
            act()
            faults[name] = "raises no error"
        except ValueError as error:
            text = f"{error}{error.__cause__ or ''}"
            if not re.search(words, text, re.DOTALL):
                faults[name] = f"raises {text[:160]!r}, expected {words!r}"
        except Exception as error:  # any other exception is a fault
            faults[name] = f"raises {type(error).__name__}: {str(error)[:160]}"
    return none_of({name: faults.get(name, "") for name in acts})


def none_of(faults: Mapping[str, str]) -> float:
    """Return 0 if no sample has a fault, by name; an empty text is none.

    Raises:
        AssertionError: some samples have faults; the message begins with their number.
    """
    if found := [f"{name}: {text}" for name, text in faults.items() if text]:
        raise AssertionError(f"{len(found)} of {len(faults)}: {'; '.join(found)}")
    return 0.0


@contextmanager
def inapplicable(ours: bool, why: str) -> Iterator[None]:
    """A plugin's part may refuse what ours must support."""
    try:
        yield
    except ValueError as error:
        if ours:
            raise
        raise DoesNotApply(f"{why}: {error}") from error
