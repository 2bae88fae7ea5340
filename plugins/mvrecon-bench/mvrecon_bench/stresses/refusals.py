"""Refusals: the right type of exception, with a message that names the fault."""

import re
from collections.abc import Callable, Mapping


def refusal(
    act: Callable[[], object],
    saying: str = "",
    kinds: type[Exception] | tuple[type[Exception], ...] = ValueError,
) -> str:
    """Empty where an act is refused as it should be; else what happened instead.

    Args:
        act: what must not go well.
        saying: a pattern that the message must match somewhere.
        kinds: of error that may be raised.
    """
    try:
        act()
    except kinds as error:
        text = f"{error}{error.__cause__ or ''}"
        return (
            ""
            if re.search(saying, text, re.DOTALL)
            else f"says {text[:160]!r}, expected {saying!r}"
        )
    except Exception as error:  # whatever else is raised is no refusal
        return f"raises {type(error).__name__}: {str(error)[:160]}"
    return "goes well"


def none_of(faults: Mapping[str, str]) -> float:
    """0 where no sample did anything wrong.

    Args:
        wrong: what each sample did wrong, by its name; empty: nothing.

    Raises:
        AssertionError: some did; the message begins with how many, and names them.
    """
    if failures := {name: text for name, text in faults.items() if text}:
        listed = "; ".join(f"{name}: {text}" for name, text in failures.items())
        raise AssertionError(f"{len(failures)} of {len(faults)}: {listed}")
    return 0.0
