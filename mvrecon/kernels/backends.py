"""Which back end serves a tensor."""

from importlib.util import find_spec
from types import ModuleType

import torch
from torch import Tensor

from mvrecon.kernels import ops, reference

BACKENDS = ("auto", "cpu", "cuda", "reference")
COMPILED = find_spec("numba") is not None


def wide(tensor: Tensor) -> Tensor:
    """The tensor in the precision of arithmetic: float64 as such, all else as float32."""
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()


def kernels_for(device: torch.device, backend: str) -> tuple[str, ModuleType]:
    """The back end's name and its functions, for tensors on a device.

    Raises:
        ValueError: an unknown back end, or a compiled one for a tensor elsewhere.
    """
    if backend not in BACKENDS:
        raise ValueError(f"Unknown backend {backend!r}. Known: {', '.join(BACKENDS)}")
    if backend in ("cpu", "cuda") and device.type != backend:
        memory = "main memory" if backend == "cpu" else "a GPU's memory"
        raise ValueError(f"backend {backend!r} needs tensors in {memory}, got {device}; use 'auto' or 'reference'")
    if backend == "reference" or device.type != "cpu" or not COMPILED:
        return "reference", reference
    return device.type, ops
