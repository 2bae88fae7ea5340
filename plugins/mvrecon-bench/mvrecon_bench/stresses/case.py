"""A case of the stress plan: its measure, and the tolerance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

#: What a case is about: a part of that kind, or what is under all parts (tensors, geometry,
#: threads), stressed once.
KINDS = ("projector", "camera", "scene", "head", "method", "mvrecon")
#: Relative, where a case does not say otherwise; halves are storage, summed in float32.
PRECISE = {torch.float64: 1e-12, torch.float32: 1e-5, torch.bfloat16: 1e-5, torch.float16: 1e-5}


class DoesNotApply(Exception):
    """What a case asks for is not what this part is made for; the message says why."""


@dataclass(frozen=True)
class Case:
    """A row of the plan.

    Args:
        number: in the plan.
        name: what is done.
        holds: what must hold, and so what the measured number is (largest error, count of
            violations, ...).
        kind: of the parts that it is done to; one of `KINDS`.
        measure: does it to a subject, and returns the number that must not exceed the tolerance. It
            may raise `DoesNotApply`; any other exception is a failure.
        tolerance: of all dtypes, or of each; 0 where it must hold to the last bit.
        dtypes: for which it is meant; others are left out.
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
