"""Compilation of CUDA C++ by torch's NVRTC through ctypes, with an on-disk cache of
machine code.
"""

import ctypes
import logging
import os
import stat
import sys
from collections.abc import Callable
from ctypes import byref, c_char_p, c_int, c_size_t, c_void_p
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

from mvrecon.core.files.atomic import written_whole

logger = logging.getLogger(__name__)

#: Bytes of the digest before machine code on disk.
HEAD = 32
OPTIONS = ("--std=c++17",)


class CompileError(RuntimeError):
    """The source does not compile."""


@cache
def library() -> Any:
    """Load NVRTC: torch's own wheel's, else the system's.

    Raises:
        OSError: it is missing.
    """
    paths = [path for root in roots() for path in root.rglob("libnvrtc.so.*")]
    wanted = (torch.version.cuda or "").partition(".")[0]
    # of several installed ones, that for which torch was built
    paths.sort(key=lambda path: (path.suffix[1:] == wanted, path.suffix), reverse=True)
    problem: OSError | None = None
    for path in [*paths, Path(f"libnvrtc.so.{wanted}" if wanted else "libnvrtc.so")]:
        try:
            # of a wheel, whose folder NVRTC does not search for its own headers
            for headers in path.parent.glob("libnvrtc-builtins.so.*") if path in paths else ():
                ctypes.CDLL(str(headers))
            return ctypes.CDLL(str(path))
        except OSError as error:
            problem = problem or error
    raise OSError(f"NVRTC, CUDA's compiler, cannot be loaded: {problem}")


def roots() -> list[Path]:
    """Folders of NVIDIA's wheels."""
    return [folder for path in sys.path if (folder := Path(path) / "nvidia").is_dir()]


def version() -> str:
    """NVRTC's version."""
    major, minor = c_int(), c_int()
    library().nvrtcVersion(byref(major), byref(minor))
    return f"{major.value}.{minor.value}"


def capabilities() -> list[int]:
    """The compute capabilities that NVRTC supports, as 90 for 9.0."""
    count = c_int()
    library().nvrtcGetNumSupportedArchs(byref(count))
    values = (c_int * count.value)()
    library().nvrtcGetSupportedArchs(values)
    return sorted(values)


def target(capability: int, known: list[int]) -> str:
    """Return the architecture to compile for: the device's, or for a device newer than NVRTC the
    newest PTX, which its driver translates.

    Raises:
        RuntimeError: the device is older than any that NVRTC supports.
    """
    if capability in known:
        return f"sm_{capability}"
    older = [one for one in known if one < capability]
    if not older:
        raise RuntimeError(
            f"NVRTC {version()} compiles for compute capability {known[0] / 10} and newer, got "
            f"{capability / 10}"
        )
    return f"compute_{older[-1]}"


def build(text: str, architecture: str) -> bytes:
    """Compile a text to machine code for "sm_90" and the like, or PTX for "compute_90".

    Raises:
        CompileError: it does not compile; with the compiler's message.
    """
    nvrtc, program = library(), c_void_p()
    options = [f"--gpu-architecture={architecture}".encode(), *(o.encode() for o in OPTIONS)]
    _check(nvrtc.nvrtcCreateProgram(byref(program), text.encode(), b"rays.cu", 0, None, None))
    try:
        code = nvrtc.nvrtcCompileProgram(program, len(options), (c_char_p * len(options))(*options))
        if code:
            log = _text(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
            raise CompileError(f"NVRTC error {code}: {log.decode(errors='replace')[:2000]}")
        what = "CUBIN" if architecture.startswith("sm_") else "PTX"
        size, into = getattr(nvrtc, f"nvrtcGet{what}Size"), getattr(nvrtc, f"nvrtcGet{what}")
        return _text(size, into, program)
    finally:
        nvrtc.nvrtcDestroyProgram(byref(program))


def _text(size_of: Any, write: Any, program: c_void_p) -> bytes:
    size = c_size_t()
    _check(size_of(program, byref(size)))
    into = ctypes.create_string_buffer(size.value)
    _check(write(program, into))
    return into.raw


def _check(code: int) -> None:
    if code:
        raise CompileError(f"NVRTC error {code}")


def folder() -> Path:
    """The cache folder of machine code: `mvrecon/kernels` in the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mvrecon" / "kernels"


def built(text: str, architecture: str, *made_of: str) -> bytes:
    """Return the result of `build` from the cache; `made_of` is part of its key."""
    key = (text, architecture, *OPTIONS, version(), *made_of)
    name = sha256("\n".join(key).encode()).hexdigest()
    return cached(name, lambda: build(text, architecture))


def cached(name: str, build: Callable[[], bytes]) -> bytes:
    """Return machine code by name from disk, or build and store it; invalid files are rebuilt. Only
    the user may have write access.
    """
    path = folder() / f"{name}.bin"
    try:
        if (code := _read(path)) is not None:
            return code
    except OSError as problem:
        logger.warning("Compiled kernels cannot be read, so they are made anew: %s", problem)
        return build()
    code = build()
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with written_whole(path) as part:
            part.write_bytes(sha256(code).digest() + code)
    except OSError as problem:
        logger.warning("Compiled kernels cannot be kept: %s", problem)
    return code


def _read(path: Path) -> bytes | None:
    """Read machine code from disk; None if missing or damaged.

    Raises:
        PermissionError: other users have write access.
    """
    if not path.exists():
        return None
    for place in (path.parent, path):
        described = place.stat()
        others = described.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if os.name == "posix" and (described.st_uid != os.getuid() or others):
            raise PermissionError(f"{place} belongs to another user, or others may write it")
    content = path.read_bytes()
    code = content[HEAD:]
    return code if sha256(code).digest() == content[:HEAD] else None
