"""Rejection of invalid input: the correct type of exception, with a message that names the
fault.
"""

import re
from collections.abc import Callable, Mapping


def refusal(
    act: Callable[[], object],
    saying: str = "",
    kinds: type[Exception] | tuple[type[Exception], ...] = ValueError,
) -> str:
    """Empty if an act raises the expected error, otherwise a description of what happened.

    Args:
        act: the call that must fail.
        saying: regular expression that the message must contain.
        kinds: permitted types of errors.
    """
    try:
        act()
    except kinds as error:
        text = f"{error}{error.__cause__ or ''}"
        return (
            ""
            if re.search(saying, text, re.DOTALL)
            else f"raises {text[:160]!r}, expected {saying!r}"
        )
    except Exception as error:  # any other exception is a fault
        return f"raises {type(error).__name__}: {str(error)[:160]}"
    return "raises no error"


def none_of(faults: Mapping[str, str]) -> float:
    """Return 0 if no sample has a fault.

    Args:
        wrong: fault of each sample by name; empty: no fault.

    Raises:
        AssertionError: some samples have faults; the message begins with their number and lists
            them.
    """
    if failures := {name: text for name, text in faults.items() if text}:
        listed = "; ".join(f"{name}: {text}" for name, text in failures.items())
        raise AssertionError(f"{len(failures)} of {len(faults)}: {listed}")
    return 0.0
