"""Trouble at a chosen moment of this process, and whether what was left is the same to the last
bit.
"""

import os
from collections.abc import Callable
from typing import Any

import torch


def counted(owner: Any, name: str, n: int, what: Callable[[], object]) -> None:
    """Let something happen at the n-th call of a function, before the function does anything."""
    function, calls = getattr(owner, name), []

    def called(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        if len(calls) == n:
            what()
        return function(*args, **kwargs)

    setattr(owner, name, called)


def signalled(number: int) -> Callable[[], None]:
    """What sends this process a signal; SIGKILL is how the kernel ends it: nothing is caught,
    nothing flushed.
    """
    return lambda: os.kill(os.getpid(), number)


def raising(error: BaseException) -> Callable[[], None]:
    """What raises an error."""

    def what() -> None:
        raise error

    return what


def different(a: Any, b: Any, where: str = "") -> list[str]:
    """The places where two checkpoints do not hold the same bits."""
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [place for key in a for place in different(a[key], b[key], f"{where}/{key}")]
    if isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        return [
            place
            for i, pair in enumerate(zip(a, b, strict=True))
            for place in different(*pair, f"{where}/{i}")
        ]
    same = (
        torch.equal(a, b) if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor) else a == b
    )
    return [] if same else [where]
