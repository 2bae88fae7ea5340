"""Dry run of a GPU script (`--device dry`): every line is executed in main memory; the numbers are
meaningless.

A dry run finds programming errors without using device time. Kernels are tested in
tests/kernels/cuda.
"""

import time
import warnings
from contextlib import nullcontext
from functools import cache
from types import SimpleNamespace
from typing import Any

import torch

from mvrecon_bench import measure
from mvrecon_bench.gpu.as_gpu import AsGpu, in_memory

PROPERTIES = SimpleNamespace(
    name="stand-in", major=9, minor=0, multi_processor_count=1, total_memory=2**20
)


class Moment:
    """`torch.cuda.Event` with the host's clock."""

    def __init__(self, **_: Any):
        self.time = 0.0

    def record(self, *_: Any) -> None:
        """Record the time."""
        self.time = time.perf_counter()

    def synchronize(self) -> None:
        """Do nothing: all work is complete."""

    def elapsed_time(self, end: "Moment") -> float:
        """Milliseconds until another event."""
        return 1e3 * (end.time - self.time)


class Line:
    """`torch.cuda.Stream` and `torch.cuda.CUDAGraph`: all work is already complete."""

    cuda_stream = 0

    def synchronize(self) -> None:
        """Do nothing: all work is complete."""

    def replay(self) -> None:
        """Do nothing: an emulated graph is empty."""


STANDING_IN = {
    "is_available": lambda: True,
    "is_bf16_supported": lambda *_, **__: True,
    "current_device": lambda: 0,
    "amp_definitely_not_available": lambda: False,
    "synchronize": lambda *_: None,
    "empty_cache": lambda: None,
    "get_device_properties": lambda *_: PROPERTIES,
    "get_device_capability": lambda *_: (9, 0),
    "memory_allocated": lambda *_: 0,
    "max_memory_allocated": lambda *_: 0,
    "reset_peak_memory_stats": lambda *_: None,
    "set_sync_debug_mode": lambda *_: None,
    "Event": Moment,
    "Stream": Line,
    "CUDAGraph": Line,
    "stream": lambda *_: nullcontext(),
    "graph": lambda *_, **__: nullcontext(),
}


@cache  # nested emulation would give the same results, but slower
def stand_in() -> None:
    """Make torch treat main memory as a GPU until the process ends."""
    warnings.filterwarnings("ignore", "User provided device_type of 'cuda'")
    AsGpu().__enter__()
    measure.WORTH_S = measure.QUEUED_S = 0.0  # no call is repeated for a better median
    for name, value in STANDING_IN.items():
        setattr(torch.cuda, name, value)
    # a build of torch with CUDA names an accelerator even without a driver
    torch.accelerator.current_accelerator = lambda *_, **__: None
    allclose = torch.allclose  # C++ would compare tensors without values
    # inference mode does not support emulated tensors
    torch._C._InferenceMode = lambda mode: torch.no_grad()  # pyrefly: ignore[bad-assignment]
    torch.allclose = lambda a, b, **k: allclose(in_memory(a), in_memory(b), **k)  # pyrefly: ignore[bad-assignment]
