"""A stand-in for a GPU under a whole script (`--device dry`): each of its lines runs, in main
memory, and its numbers mean nothing.

A script that ends well here loses no time on a device to a slip of the pen. What kernels do is
tested elsewhere (tests/kernels/cuda).
"""

import time
import warnings
from contextlib import nullcontext
from functools import cache
from types import SimpleNamespace
from typing import Any

import torch

from mvrecon_bench.gpu.as_gpu import AsGpu, in_memory

PROPERTIES = SimpleNamespace(
    name="stand-in", major=9, minor=0, multi_processor_count=1, total_memory=2**20
)


class Moment:
    """`torch.cuda.Event`, by the host's clock."""

    def __init__(self, **_: Any):
        self.time = 0.0

    def record(self, *_: Any) -> None:
        """Remember the time."""
        self.time = time.perf_counter()

    def synchronize(self) -> None:
        """Nothing is under way."""

    def elapsed_time(self, end: "Moment") -> float:
        """Milliseconds until another one."""
        return 1e3 * (end.time - self.time)


class Line:
    """`torch.cuda.Stream` and `torch.cuda.CUDAGraph`: what is asked for has been done already."""

    cuda_stream = 0

    def synchronize(self) -> None:
        """Nothing is under way."""

    def replay(self) -> None:
        """A graph of the stand-in holds nothing."""


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


@cache  # a stand-in within a stand-in would be as right, and slower each time
def stand_in() -> None:
    """Let torch take main memory for a GPU, until the process ends."""
    warnings.filterwarnings("ignore", "User provided device_type of 'cuda'")
    AsGpu().__enter__()
    for name, value in STANDING_IN.items():
        setattr(torch.cuda, name, value)
    # a build of torch with CUDA names an accelerator even without a driver
    torch.accelerator.current_accelerator = lambda *_, **__: None
    allclose = torch.allclose  # C++ would compare tensors without numbers
    torch._C._InferenceMode = lambda mode: torch.no_grad()  # it takes no tensors of the stand-in
    torch.allclose = lambda a, b, **k: allclose(in_memory(a), in_memory(b), **k)
