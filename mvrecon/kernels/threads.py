"""A thread pool of torch's size for loops that release the interpreter's lock.

numba's own `parallel=True` aborts under concurrent calls, and its OpenMP layer breaks in forked
processes.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache

import torch

#: Steps along rays that make a thread worthwhile.
LEAST = 2**18

_threads: int | None = None  # of the compiled loops, if torch has another number


@contextmanager
def in_one_order(wanted: bool = True) -> Iterator[None]:
    """Context that limits torch to one thread, but not these loops, which makes results bitwise
    independent of the number of threads.

    The compiled loops add up in a fixed order. torch does not: gradients of convolutions, 1x1x1
    convolutions, matrix products, group norms, sums and even SiLU round differently on another
    number of threads (up to 1e-5 of the maximum). Whole training steps must be inside, including
    backward passes. Costs the speed-up of torch's threads.
    """
    global _threads
    threads, before = torch.get_num_threads(), _threads
    if not wanted:
        yield
        return
    _threads = before or threads
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _threads = before


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix=f"mvrecon-{process}")


def parallel_for(
    work: Callable[[int, int], None], count: int, samples: int, per_thread: int = 1
) -> None:
    """Call work(first, last) on ranges that cover `count` items, on up to torch's number of
    threads, as far as `samples` make these worthwhile.
    """
    if not count:
        return
    threads = _threads or torch.get_num_threads()
    parts = min(count, threads * per_thread, 1 + samples // LEAST) if threads > 1 else 1
    if parts <= 1:
        work(0, count)
        return
    ranges = [(count * i // parts, count * (i + 1) // parts) for i in range(parts)]
    for done in [_pool(threads, os.getpid()).submit(work, *ends) for ends in ranges]:
        done.result()
