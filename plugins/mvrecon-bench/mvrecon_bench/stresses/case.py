"""A case of the stress plan: measure and tolerance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

#: Subjects of cases: a kind of part, or the common base of all parts (tensors, geometry, threads),
#: tested once.
KINDS = ("projector", "camera", "scene", "head", "method", "mvrecon")
#: Default relative tolerances; half precision is storage only, summed in float32.
PRECISE = {torch.float64: 1e-12, torch.float32: 1e-5, torch.bfloat16: 1e-5, torch.float16: 1e-5}


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
        tolerance: for all dtypes, or per dtype; 0 for exact equality.
        dtypes: supported dtypes; others are skipped.
    """

    number: int
    name: str
    holds: str
    kind: str
    measure: Callable[[Any], float]
    tolerance: float | Mapping[torch.dtype, float] = 0.0
    dtypes: Sequence[torch.dtype] = field(default=(torch.float64, torch.float32))

    def allowed(self, dtype: torch.dtype) -> float:
        """The tolerance for a dtype."""
        return self.tolerance[dtype] if isinstance(self.tolerance, Mapping) else self.tolerance
