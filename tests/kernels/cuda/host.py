"""CUDA without a GPU: the kernels compiled by g++, and a driver that runs them on tensors in main
memory and counts what is launched.
"""

import ctypes
import subprocess
from ctypes import c_char_p, c_int, c_void_p
from pathlib import Path

import torch

from mvrecon.kernels.rays.cuda.scene import Scene
from mvrecon.kernels.rays.cuda.sources import BLOCK, NAMES, Variant, text_of

F, D, H, B = torch.float32, torch.float64, torch.float16, torch.bfloat16
#: Types of arithmetic and of storage, and how many volumes share a ray.
TYPES = [(F, F, 1), (F, F, 4), (D, D, 1), (D, D, 4), (F, H, 1), (F, B, 4)]
VARIANTS = {
    f"_{NAMES[stored]}_{together}_{method}": Variant(real, stored, together, method)
    for real, stored, together in TYPES
    for method in range(3)
}
#: Runs a kernel, thread by thread, and says where the fields of a scene lie.
RUN = (
    """
extern "C" void run(void (*kernel)(const Scene), const Scene* s, int across, int down) {
  for (blockIdx.y = 0; blockIdx.y < down; blockIdx.y++)
    for (blockIdx.x = 0; blockIdx.x < across; blockIdx.x++)
      for (threadIdx.x = 0; threadIdx.x < BLOCK; threadIdx.x++) kernel(*s);
}
#define AT(name) (int)offsetof(Scene, name),
extern "C" const int layout[] = {
"""
    + "".join(f"AT({name[0]})\n" for name in Scene._fields_)
    + "(int)sizeof(Scene)};\n"
)


def compiled(folder: Path) -> ctypes.CDLL:
    """The kernels of all variants, by g++."""
    source, library = folder / "rays.cpp", folder / "rays.so"
    source.write_text(text_of(VARIANTS) + RUN)
    options = ["-O1", "-std=c++17", "-shared", "-fPIC"]
    subprocess.run(["g++", *options, str(source), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))


class Driver:
    """What stands in for libcuda: the same functions, on the CPU."""

    def __init__(self, library: ctypes.CDLL):
        self.library, self.launches, self.modules = library, [], 0
        self.failure = {}  # error codes by function
        self.names: dict[int, str] = {}
        self.streams: list[int] = []

    def __getattr__(self, name):
        if not name.startswith("cu"):
            raise AttributeError(name)
        return lambda *_: self.failure.get(name, 0)

    def cuModuleLoadData(self, module, code: c_char_p) -> int:
        lines = [variant.line("") for variant in VARIANTS.values()]
        module._obj.value = 1 + lines.index(code.value.decode())
        self.modules += 1
        return self.failure.get("cuModuleLoadData", 0)

    def cuModuleGetFunction(self, function, module, name: bytes) -> int:
        symbol = name.decode() + list(VARIANTS)[module.value - 1]
        function._obj.value = ctypes.cast(getattr(self.library, symbol), c_void_p).value
        self.names[function._obj.value] = name.decode()
        return 0

    def cuLaunchKernel(self, function, *numbers) -> int:
        *grid, stream, arguments, extra = numbers
        across, down = grid[:2]
        assert grid[2:] == [1, BLOCK, 1, 1, 0] and extra is None
        if self.failure:
            return self.failure.get("cuLaunchKernel", 0)
        self.launches.append(self.names[function.value])
        self.streams.append(stream.value or 0)
        self.library.run(function, c_void_p(arguments[0]), c_int(across), c_int(down))
        return 0

    def cuGetErrorString(self, code, text) -> int:
        text._obj.value = b"a reason"
        return 0


def stand_in(monkeypatch, library: ctypes.CDLL, cache: Path) -> Driver:
    """Put the CPU in the place of a device, its driver and its compiler."""
    from mvrecon.kernels.rays.cuda import driver, kept, nvrtc

    stub = Driver(library)
    last = lambda text, architecture: text.splitlines(keepends=True)[-1].encode()  # noqa: E731
    for module, name, value in (
        (driver, "library", lambda: stub),
        (driver, "stream_of", lambda device: 7),
        (driver, "capability_of", lambda device: 90),
        (driver, "memory_of", lambda device: 2**30),
        (nvrtc, "build", last),
        (nvrtc, "capabilities", lambda: [80, 90]),
        (nvrtc, "version", lambda: "0.0"),
        (kept, "folder", lambda: cache),
    ):
        monkeypatch.setattr(module, name, value)
    return stub
