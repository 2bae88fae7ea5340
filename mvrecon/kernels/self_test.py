"""Whether the CUDA back end may be trusted on a device: each operator is tried once against the
reference.
"""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

#: The greatest difference to the reference, by its greatest value: rounding, and where a ray falls
#: on an edge.
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
#: Types that kernels read; another is cast to float32 first.
STORED = (torch.float64, torch.float16, torch.bfloat16)

#: Names of what was tried, and the greatest differences to the reference, see `error_of`.
Errors = Iterator[tuple[str, float]]
#: A self-test, of (device, type that volumes are stored in, purpose).
Tests = Callable[[str, torch.dtype, str], Errors]


#: Why kernels cannot be used, or None, by what was tried: device, purpose, type of numbers.
_verdicts: dict[tuple[str, str, torch.dtype], str | None] = {}
_lock = Lock()


def failure(
    device: torch.device | str, purpose: str, dtype: torch.dtype, tests: Tests
) -> str | None:
    """Why kernels cannot be used on a device, or None. Tried and logged once; only what is true of
    the device is remembered.

    Args:
        device: a CUDA device.
        purpose: what the kernels are for: a method of rays, "warp" ...
        dtype: of the volumes or views.
        tests: what is tried.
    """
    place = torch.device(device)
    if place.type == "cuda" and place.index is None:
        place = torch.device(
            "cuda", torch.cuda.current_device() if torch.cuda.is_available() else 0
        )
    case = str(place), purpose, dtype if dtype in STORED else torch.float32
    with _lock:
        if case in _verdicts:
            return _verdicts[case]
        # in a thread of its own: inference mode, autocast, derivatives and maps of `torch.func`
        # hold for the thread that asks, and a test inside them would fail
        with ThreadPoolExecutor(1) as fresh:
            why, lasting = fresh.submit(_tried, *case, tests).result()
        if lasting:
            _verdicts[case] = why
    if why:
        logger.warning("The reference computes %s of %s on %s: %s", purpose, case[2], place, why)
    return why


# as torch.compiler.assume_constant_result does, but that imports torch._dynamo, which takes as
# long as torch itself
failure._dynamo_marked_constant = True  # pyright: ignore[reportFunctionMemberAccess]


def forget() -> None:
    """Forget every verdict, so that the next call tries again."""
    with _lock:
        _verdicts.clear()


def _tried(device: str, purpose: str, dtype: torch.dtype, tests: Tests) -> tuple[str | None, bool]:
    """Why kernels cannot be used, or None, and whether that is so for good."""
    bound = TOLERANCE[torch.promote_types(dtype, torch.float32)]
    try:
        for what, error in tests(device, dtype, purpose):
            if not error <= bound:
                why = f"{what} differs from the reference by {error:.1e}, expected at most "
                return f"{why}{bound:.0e}", True
    except torch.OutOfMemoryError as problem:  # another time there may be room
        return str(problem), False
    # a missing package, no driver, no compiler, a kernel that fails: all mean the same
    except Exception as problem:
        return f"{type(problem).__name__}: {problem}", True
    return None, True


def error_of(got: Tensor, expected: Tensor) -> float:
    """The greatest difference, by the greatest value of what is expected."""
    return float((got - expected.detach()).abs().max() / expected.detach().abs().max())
