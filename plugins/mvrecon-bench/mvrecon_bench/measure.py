"""Run time in ms and memory in MB of a call, including launch and synchronisation, on a CPU or a
GPU.
"""

import math
import os
import statistics
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import torch

from mvrecon.core.machine import peak_since, restarted_peak

Call = Callable[[], Any]
Key = TypeVar("Key", bound=Hashable)
#: A fast call is repeated up to this total time in seconds, or MORE times the requested number.
WORTH_S, MORE = 0.2, 4
#: Total time in seconds of the calls that are queued on a GPU.
QUEUED_S = 0.15


class Timing(NamedTuple):
    """Median time of a call in ms, and the number of calls."""

    ms: float
    calls: int


def wait(device: str) -> None:
    """Wait until a GPU has completed all work."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def once(
    call: Call, device: str, clock: Callable[[], float] = time.perf_counter
) -> tuple[Any, float]:
    """The result of a call and its duration in seconds."""
    wait(device)
    start = clock()
    result = call()
    wait(device)
    return result, clock() - start


def interleaved(
    calls: Mapping[Key, Call],
    first_s: Mapping[Key, float],
    repeats: int,
    device: str,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Key, Timing]:
    """Median time of each call, measured alternately so that background load affects all of them
    equally.

    Args:
        calls: calls that have been executed before, so that no compilation remains.
        first_s: seconds of those executions; fast calls are repeated more often than `repeats`.
        repeats: minimum number of calls.
        device: device of the calls.
        clock: wall clock, or `time.process_time`.
    """
    rounds = {
        key: max(repeats, min(MORE * repeats, round(WORTH_S / max(first_s[key], 1e-9))))
        for key in calls
    }
    times: dict[Key, list[float]] = {key: [] for key in calls}
    for turn in range(max(rounds.values(), default=0)):
        for key, call in calls.items():
            if turn < rounds[key]:
                times[key].append(once(call, device, clock)[1])
    return {key: Timing(1e3 * statistics.median(taken), len(taken)) for key, taken in times.items()}


def latency(call: Call, device: str, repeats: int = 3) -> float:
    """Median milliseconds of one call on an idle device until completion."""
    call()
    return interleaved({0: call}, {0: once(call, device)[1]}, repeats, device)[0].ms


def throughput(call: Call, device: str) -> tuple[float, float]:
    """Milliseconds per call for many queued calls, on the device and on the host (the overhead of
    Python).
    """
    one = once(call, device)[1]
    if not device.startswith("cuda"):
        return 1e3 * one, 1e3 * one
    one = once(call, device)[1]  # the first call may compile
    count = max(2, min(300, int(QUEUED_S / max(one, 1e-6))))
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    wait(device)
    begin.record()
    start = time.perf_counter()
    for _ in range(count):
        call()
    host = time.perf_counter() - start
    end.record()
    end.synchronize()
    return begin.elapsed_time(end) / count, 1e3 * host / count


def with_memory(call: Call, device: str) -> tuple[Any, float]:
    """The result of a call, and its peak memory in MB (2^20 bytes) beyond the memory in use before,
    including the result.

    On a GPU, the memory of torch's allocator; on Linux, the peak of resident memory; NaN elsewhere.
    """
    if device.startswith("cuda"):
        wait(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        result = once(call, device)[0]
        return result, (torch.cuda.max_memory_allocated(device) - before) / 2**20
    start = restarted_peak(trimmed=True)
    result, needed = call(), peak_since(start)
    return result, math.nan if needed is None else needed / 2**20


def load_average() -> float:
    """Load average of the last minute."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Context that sets the number of threads of torch and of libraries that follow it."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
