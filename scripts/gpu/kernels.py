"""The prototype's kernels (`joseph.cu`), compiled for this machine's GPU or, to check them, for its
CPU.
"""

import ctypes
import glob
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

SOURCE = Path(__file__).parent / "joseph.cu"
BLOCK = 128
POINTERS = (
    "lines",
    "tall",
    "flat",
    "views",
    "rays",
    "ends",
    "values",
    "frames",
    "flags",
    "volume",
)
NAMES = ("project", "record", "gather", "store")


class Scene(ctypes.Structure):
    """All that a kernel is given; as in the source."""

    _fields_ = [
        *((name, ctypes.c_uint64) for name in POINTERS),
        ("sizes", ctypes.c_int * 3),
        *((name, ctypes.c_int) for name in ("views_", "rows", "columns", "count")),
        ("window", ctypes.c_double * 2),
    ]


class Host:
    """The kernels in main memory, by g++."""

    device = "cpu"

    def __init__(self, nv: int):
        self.nv, self.folder = nv, tempfile.TemporaryDirectory()
        library = str(Path(self.folder.name) / "joseph.so")
        flags = ["-O2", "-std=c++17", "-shared", "-fPIC", "-x", "c++", f"-DNV={nv}"]
        subprocess.run(["g++", *flags, str(SOURCE), "-o", library], check=True)
        self.library = ctypes.CDLL(library)

    def run(self, name: str, scene: Scene, blocks: int, groups: int) -> None:
        """Run a kernel on `blocks` x `groups` blocks."""
        self.library.host_run(NAMES.index(name), ctypes.byref(scene), blocks, groups)

    def store(self, x: torch.Tensor, store: torch.Tensor, tall: bool, blocks: int) -> None:
        """Copy volumes [n d h w] into a store with its border."""
        numbers = *x.shape[:0:-1], len(x), int(tall), blocks, len(store)
        pointers = (ctypes.c_void_p(t.data_ptr()) for t in (x, store))
        self.library.host_store(*pointers, *numbers)


class Gpu:
    """The kernels on a GPU: a launch packs one structure, and takes some microseconds."""

    device = "cuda"

    def __init__(self, nv: int):
        self.nv = nv
        arch = "sm_" + "".join(map(str, torch.cuda.get_device_capability()))
        cubin = nvrtc(
            SOURCE.read_text(), [f"--gpu-architecture={arch}", f"-DNV={nv}", "--std=c++17"]
        )
        self.driver = ctypes.CDLL("libcuda.so.1")
        module = ctypes.c_void_p()
        _check(self.driver.cuModuleLoadData(ctypes.byref(module), cubin))
        self.functions = {name: ctypes.c_void_p() for name in NAMES}
        for name, function in self.functions.items():
            _check(self.driver.cuModuleGetFunction(ctypes.byref(function), module, name.encode()))

    def _launch(self, name: str, blocks: int, groups: int, arguments: Sequence) -> None:
        packed = (ctypes.c_void_p * len(arguments))(*map(ctypes.addressof, arguments))
        stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
        shape = blocks, groups, 1, BLOCK, 1, 1, 0
        _check(self.driver.cuLaunchKernel(self.functions[name], *shape, stream, packed, None))

    def run(self, name: str, scene: Scene, blocks: int, groups: int) -> None:
        """Run a kernel on `blocks` x `groups` blocks."""
        self._launch(name, blocks, groups, [scene])

    def store(self, x: torch.Tensor, store: torch.Tensor, tall: bool, blocks: int) -> None:
        """Copy volumes [n d h w] into a store with its border."""
        pointers = [ctypes.c_uint64(t.data_ptr()) for t in (x, store)]
        numbers = map(ctypes.c_int, (*x.shape[:0:-1], len(x), int(tall)))
        self._launch("store", blocks, len(store), [*pointers, *numbers])


def nvrtc(source: str, flags: Sequence[str]) -> bytes:
    """A cubin, by the NVRTC that torch brings.

    Raises:
        RuntimeError: it does not compile.
    """
    import nvidia  # torch's own wheels

    paths = [
        path
        for root in nvidia.__path__
        for path in glob.glob(f"{root}/**/libnvrtc.so.*", recursive=True)
        if "alt" not in path and "builtins" not in path
    ]
    library = ctypes.CDLL(sorted(paths)[-1] if paths else "libnvrtc.so")
    program, size = ctypes.c_void_p(), ctypes.c_size_t()
    library.nvrtcCreateProgram(
        ctypes.byref(program), source.encode(), SOURCE.name.encode(), 0, None, None
    )
    options = (ctypes.c_char_p * len(flags))(*[flag.encode() for flag in flags])
    if code := library.nvrtcCompileProgram(program, len(flags), options):
        library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
        log = ctypes.create_string_buffer(size.value)
        library.nvrtcGetProgramLog(program, log)
        raise RuntimeError(f"NVRTC {code}: {log.value.decode()[:2000]}")
    library.nvrtcGetCUBINSize(program, ctypes.byref(size))
    cubin = ctypes.create_string_buffer(size.value)
    library.nvrtcGetCUBIN(program, cubin)
    return cubin.raw


def _check(code: int) -> None:
    if code:
        raise RuntimeError(f"CUDA driver error {code}")
