"""CUDA without a GPU: the kernels compiled by g++, and a driver that runs them on tensors in main
memory and counts what is launched; and their machine code. Plugins test their kernels by the same.
"""

import ctypes
import shutil
import subprocess
from collections.abc import Iterator
from ctypes import c_char_p, c_int, c_void_p
from pathlib import Path
from types import ModuleType

import pytest
import torch

from mvrecon.kernels import self_test
from mvrecon.kernels.cuda import driver, nvrtc
from mvrecon.kernels.cuda.driver import BLOCK, Packed
from mvrecon.kernels.cuda.launch import HULL, NAMES, RAYS, VOXELS, WARPS, Variant, kernels_of
from mvrecon.kernels.operator import accumulation_dtype

F, D, H, B = torch.float32, torch.float64, torch.float16, torch.bfloat16
#: Types of arithmetic and of storage, and how many volumes share a ray.
TYPES = [(F, F, 1), (F, F, 4), (D, D, 1), (D, D, 4), (F, H, 1), (F, B, 4)]
VARIANTS = {
    f"_{NAMES[stored]}_{together}_{method}": Variant(RAYS, real, stored, together, method)
    for real, stored, together in TYPES
    for method in ("joseph", "siddon", "trilinear")
}
VARIANTS |= {
    f"_{NAMES[stored]}_{source.macro}": Variant(source, accumulation_dtype(stored), stored)
    for source, types in ((WARPS, (F, D, H, B)), (VOXELS, (F, D)), (HULL, (D,)))
    for stored in types
}


def running(packed: type[Packed]) -> str:
    """What runs a kernel, thread by thread, and says where the fields of its structure lie."""
    name = packed.__name__
    fields = "".join(f"(int)offsetof({name}, {field[0]}),\n" for field in packed._fields_)
    return f"""
extern "C" void run_{name}(void (*kernel)(const {name}), const {name}* s, int across, int down) {{
  for (blockIdx.y = 0; blockIdx.y < down; blockIdx.y++)
    for (blockIdx.x = 0; blockIdx.x < across; blockIdx.x++)
      for (threadIdx.x = 0; threadIdx.x < BLOCK; threadIdx.x++) kernel(*s);
}}
extern "C" const int layout_{name}[] = {{
{fields}(int)sizeof({name})}};
"""


def compiled(
    folder: Path, variants: dict[str, Variant] = VARIANTS
) -> dict[type[Packed], ctypes.CDLL]:
    """The kernels of variants, by g++, one library for each structure; skips tests without g++."""
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler")
    texts = {variant.source.packed: variant.source.text for variant in variants.values()}
    for suffix, variant in variants.items():
        texts[variant.source.packed] += variant.line(suffix)
    compilers, libraries = [], {}
    for packed, text in texts.items():
        code, library = folder / f"{packed.__name__}.cpp", folder / f"{packed.__name__}.so"
        code.write_text(text + running(packed))
        options = ["-O1", "-std=c++17", "-shared", "-fPIC"]
        compilers.append(subprocess.Popen(["g++", *options, str(code), "-o", str(library)]))
        libraries[packed] = library
    assert not any(compiler.wait() for compiler in compilers)
    return {packed: ctypes.CDLL(str(library)) for packed, library in libraries.items()}


def layouts(packed: type[Packed], library: ctypes.CDLL) -> tuple[list[int], list[int]]:
    """Where the fields of a structure lie, and its size: in Python and in C++."""
    fields = [getattr(packed, name[0]).offset for name in packed._fields_]
    kind = c_int * (1 + len(fields))
    return [*fields, ctypes.sizeof(packed)], list(kind.in_dll(library, f"layout_{packed.__name__}"))


class Driver:
    """What stands in for libcuda: the same functions, on the CPU."""

    def __init__(self, libraries: dict[type[Packed], ctypes.CDLL], variants: dict[str, Variant]):
        self.libraries, self.launches, self.modules, self.variants = libraries, [], 0, variants
        self.failure = {}  # error codes by function
        self.names: dict[int, tuple[str, type[Packed]]] = {}
        self.streams: list[int] = []

    def __getattr__(self, name):
        if not name.startswith("cu"):
            raise AttributeError(name)
        return lambda *_: self.failure.get(name, 0)

    def cuModuleLoadData(self, module, code: c_char_p) -> int:
        lines = [variant.line("") for variant in self.variants.values()]
        module._obj.value = 1 + lines.index(code.value.decode())
        self.modules += 1
        return self.failure.get("cuModuleLoadData", 0)

    def cuModuleGetFunction(self, function, module, name: bytes) -> int:
        suffix = list(self.variants)[module.value - 1]
        packed = self.variants[suffix].source.packed
        code = getattr(self.libraries[packed], name.decode() + suffix)
        function._obj.value = ctypes.cast(code, c_void_p).value
        self.names[function._obj.value] = name.decode(), packed
        return 0

    def cuLaunchKernel(self, function, *numbers) -> int:
        *grid, stream, arguments, extra = numbers
        across, down = grid[:2]
        assert grid[2:] == [1, BLOCK, 1, 1, 0] and extra is None
        if self.failure:
            return self.failure.get("cuLaunchKernel", 0)
        name, packed = self.names[function.value]
        self.launches.append(name)
        self.streams.append(stream.value or 0)
        run = getattr(self.libraries[packed], f"run_{packed.__name__}")
        run(function, c_void_p(arguments[0]), c_int(across), c_int(down))
        return 0

    def cuDriverGetVersion(self, number) -> int:
        number._obj.value = 12020
        return 0

    def cuGetErrorString(self, code, text) -> int:
        text._obj.value = b"a reason"
        return 0


def stand_in(
    monkeypatch,
    libraries: dict[type[Packed], ctypes.CDLL],
    cache: Path,
    variants: dict[str, Variant] = VARIANTS,
) -> Iterator[Driver]:
    """Put the CPU in the place of a device, its driver and its compiler, for one test."""
    forget()
    stub = Driver(libraries, variants)
    last = lambda text, architecture: text.splitlines(keepends=True)[-1].encode()  # noqa: E731
    for module, name, value in (
        (driver, "library", lambda: stub),
        (driver, "stream_of", lambda device: 7),
        (driver, "capability_of", lambda device: 90),
        (driver, "memory_of", lambda device: 2**30),
        (nvrtc, "build", last),
        (nvrtc, "capabilities", lambda: [80, 90]),
        (nvrtc, "version", lambda: "0.0"),
        (nvrtc, "folder", lambda: cache),
    ):
        monkeypatch.setattr(module, name, value)
    yield stub
    forget()


def forget() -> None:
    kernels_of.cache_clear()
    self_test.forget()


def reader_of_machine_code() -> ModuleType:
    """The module of mvrecon-bench that reads machine code; skips tests where it cannot."""
    module = pytest.importorskip("mvrecon_bench.gpu.machine_code")
    try:
        nvrtc.library(), module.disassembler()
    except OSError as problem:
        pytest.skip(str(problem))
    return module
