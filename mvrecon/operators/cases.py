"""Operators with something of a case's own, such as the attenuation map of a patient."""

from collections.abc import Mapping
from typing import Any, Protocol, TypeVar, runtime_checkable

Operator = TypeVar("Operator")


@runtime_checkable
class CaseOperator(Protocol):
    """An operator with something of a case's own."""

    def for_case(self, case: Mapping[str, Any]) -> Any:
        """Return the operator of a batch of cases, itself if nothing depends on them.

        Args:
            case: a batch of the data set, by name.
        """


def operator_for(A: Operator, case: Mapping[str, Any]) -> Operator:
    """Return the operator of a batch of cases: A itself if it has nothing of a case's own.

    Args:
        A: the operator.
        case: a batch of the data set, by name.
    """
    return A.for_case(case) if isinstance(A, CaseOperator) else A
