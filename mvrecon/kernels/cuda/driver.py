"""Loading and launching kernels by CUDA's driver through ctypes: a launch takes microseconds, as it
packs one structure.
"""

import ctypes
from collections.abc import Sequence
from ctypes import byref, c_char_p, c_int, c_void_p
from functools import cache
from typing import Any, Self

import torch
from torch import Tensor

from mvrecon.kernels.cuda import nvrtc

#: Threads of a block and of a warp, as in `rays/cuda/source/1_scene.cu`.
BLOCK, WARP = 128, 32
#: The driver's codes for a calling thread without context, or with another device's.
NO_CONTEXT = (201, 400)
OUT_OF_MEMORY = 2
#: A kernel's arguments: the address of its structure.
Arguments = c_void_p * 1


class Packed(ctypes.Structure):
    """Addresses and numbers of one call of a kernel; its source documents each."""

    def put(self, **values: Any) -> Self:
        """Write some fields: tensors as their addresses, sequences as arrays."""
        for name, value in values.items():
            if isinstance(value, Tensor):
                setattr(self, name, value.data_ptr())
            elif isinstance(value, tuple):
                getattr(self, name)[:] = value
            else:
                setattr(self, name, value)
        return self


@cache
def library() -> Any:
    """Load CUDA's driver.

    Raises:
        OSError: it is missing, or finds no device.
    """
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError as problem:
        raise OSError(f"CUDA's driver cannot be loaded: {problem}") from problem
    if code := driver.cuInit(0):
        raise OSError(f"CUDA's driver cannot be used: {_name(driver, code)}")
    return driver


def version() -> int:
    """The driver's version, as 13000 for 13.0."""
    number = c_int()
    _check(library().cuDriverGetVersion(byref(number)))
    return number.value


def capability_of(device: torch.device) -> int:
    """The compute capability of a device, as 90 for 9.0."""
    major, minor = torch.cuda.get_device_capability(device)
    return 10 * major + minor


def memory_of(device: torch.device) -> int:
    """Total memory of a device in bytes: reading free memory would synchronise."""
    return torch.cuda.get_device_properties(device).total_memory


def stream_of(device: torch.device) -> int:
    """torch's current stream on a device."""
    return torch.cuda.current_stream(device).cuda_stream


def load(machine_code: bytes, names: Sequence[str], device: torch.device) -> dict[str, c_void_p]:
    """The kernels of machine code or PTX by their names, on a device.

    Raises:
        RuntimeError: the driver rejects it, for example as older than the compiler.
    """
    driver, module = library(), c_void_p()
    before = _enter(device)
    code = driver.cuModuleLoadData(byref(module), c_char_p(machine_code))
    if code and code != OUT_OF_MEMORY:
        number = version()
        raise RuntimeError(
            f"CUDA's driver, of CUDA {number // 1000}.{number % 1000 // 10}, does not take kernels "
            f"by NVRTC {nvrtc.version()}: {_name(driver, code)}"
        )
    _check(code)
    functions = {name: c_void_p() for name in names}
    for name, function in functions.items():
        _check(driver.cuModuleGetFunction(byref(function), module, name.encode()))
    _leave(before)
    return functions


def launch(
    function: c_void_p,
    scene: Packed,
    across: int,
    down: int,
    device: torch.device,
    stream: int | None = None,
) -> None:
    """Start a kernel on `across` x `down` blocks, on a stream of the device: by default torch's
    current one.

    Raises:
        RuntimeError: the driver rejects it.
        torch.OutOfMemoryError: insufficient memory.
    """
    if not across or not down:
        return
    driver, arguments = library(), Arguments(ctypes.addressof(scene))
    grid = across, down, 1, BLOCK, 1, 1, 0
    queue = c_void_p(stream_of(device) if stream is None else stream)
    code = driver.cuLaunchKernel(function, *grid, queue, arguments, None)
    if code in NO_CONTEXT:
        before = _enter(device)
        code = driver.cuLaunchKernel(function, *grid, queue, arguments, None)
        _leave(before)
    _check(code)


def _enter(device: torch.device) -> c_void_p:
    """Make torch's context of the device current in the calling thread; returns the
    previous one.
    """
    driver, handle, context, before = library(), c_int(), c_void_p(), c_void_p()
    _check(driver.cuCtxGetCurrent(byref(before)))
    _check(driver.cuDeviceGet(byref(handle), device.index or 0))
    _check(driver.cuDevicePrimaryCtxRetain(byref(context), handle))
    _check(driver.cuCtxSetCurrent(context))
    return before


def _leave(before: c_void_p) -> None:
    """Restore a context, as torch would otherwise take the other device for its current one; a
    thread that had none keeps it.
    """
    if before.value:
        _check(library().cuCtxSetCurrent(before))


def _check(code: int) -> None:
    if code == OUT_OF_MEMORY:
        raise torch.OutOfMemoryError("CUDA's driver: out of memory")
    if code:
        raise RuntimeError(f"CUDA's driver: {_name(library(), code)}")


def _name(driver: Any, code: int) -> str:
    text = c_char_p()
    driver.cuGetErrorString(code, byref(text))
    return f"{(text.value or b'unknown error').decode()} (error {code})"
