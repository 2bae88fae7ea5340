"""Self-test of the CUDA back end on a device: each operator is compared with the reference once."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

#: Tolerance relative to the reference's greatest value: rounding, and rays on an edge.
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
#: Types that kernels read; others are cast to float32 first.
STORED = (torch.float64, torch.float16, torch.bfloat16)

#: Names of tested functions, and greatest differences to the reference, see `error_of`.
Errors = Iterator[tuple[str, float]]
#: A self-test, of (device, stored type of volumes, purpose).
Tests = Callable[[str, torch.dtype, str], Errors]


#: Reason why kernels are unavailable, or None, by device, purpose and type of numbers.
_verdicts: dict[tuple[str, str, torch.dtype], str | None] = {}
_lock = Lock()


def failure(
    device: torch.device | str, purpose: str, dtype: torch.dtype, tests: Tests
) -> str | None:
    """Return the reason why kernels are unavailable on a device, or None. Tested and logged once;
    only permanent results are cached.

    Args:
        device: a CUDA device.
        purpose: what the kernels compute: a method of rays, "warp" ...
        dtype: type of the volumes or views.
        tests: the self-tests.
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
        # in a new thread: inference mode, autocast and `torch.func` transforms hold for the calling
        # thread, and would make a test fail
        with ThreadPoolExecutor(1) as fresh:
            why, lasting = fresh.submit(_tried, *case, tests).result()
        if lasting:
            _verdicts[case] = why
    if why:
        logger.warning("The reference computes %s of %s on %s: %s", purpose, case[2], place, why)
    return why


# as torch.compiler.assume_constant_result does, but that imports torch._dynamo, which takes as
# long as torch itself
failure._dynamo_marked_constant = True  # pyrefly: ignore[missing-attribute]


def forget() -> None:
    """Clear all results, so that the next call tests again."""
    with _lock:
        _verdicts.clear()


def _tried(device: str, purpose: str, dtype: torch.dtype, tests: Tests) -> tuple[str | None, bool]:
    """The reason why kernels are unavailable, or None, and whether that is permanent."""
    bound = TOLERANCE[torch.promote_types(dtype, torch.float32)]
    try:
        for what, error in tests(device, dtype, purpose):
            if not error <= bound:
                why = f"{what} differs from the reference by {error:.1e}, expected at most "
                return f"{why}{bound:.0e}", True
    except torch.OutOfMemoryError as problem:  # temporary
        return str(problem), False
    # a missing package, no driver, no compiler, a failing kernel: all the same
    except Exception as problem:
        return f"{type(problem).__name__}: {problem}", True
    return None, True


def error_of(got: Tensor, expected: Tensor) -> float:
    """The greatest difference relative to the greatest expected value."""
    return float((got - expected.detach()).abs().max() / expected.detach().abs().max())
