"""A thread pool of torch's size for loops that hold no lock of the interpreter.

numba's own `parallel=True` aborts under concurrent calls, and its OpenMP layer does not survive a fork.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch

#: Steps along rays that are worth a thread of their own.
LEAST = 2**18


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix=f"mvrecon-{process}")


def share(work: Callable[[int, int], None], count: int, samples: int, per_thread: int = 1) -> None:
    """Do work(first, last) for ranges that cover `count` items, on the threads that torch has and `samples` deserve."""
    if not count:
        return
    threads = torch.get_num_threads()
    parts = min(count, threads * per_thread, 1 + samples // LEAST) if threads > 1 else 1
    if parts <= 1:
        work(0, count)
        return
    ranges = [(count * i // parts, count * (i + 1) // parts) for i in range(parts)]
    for done in [_pool(threads, os.getpid()).submit(work, *each) for each in ranges]:
        done.result()
