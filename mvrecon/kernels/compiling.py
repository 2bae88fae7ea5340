"""Compilation of functions at the first call for a type of number, cached on disk."""

import logging
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

from numba import config, extending, njit
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.codegen import get_host_cpu_features

#: numba's decorator of functions that generate LLVM's code; typed so that their callers may leave
#: out the context, which numba passes.
intrinsic: Any = extending.intrinsic

logger = logging.getLogger(__name__)

#: Reordering of sums and products is allowed; NaN and infinity keep their meaning.
FASTMATH = {"reassoc", "contract", "nsz"}

#: The loops allocate no arrays, so reference counting, as expensive as a ray, is off.
OPTIONS: dict[str, Any] = {"fastmath": FASTMATH, "error_model": "numpy", "_nrt": False}


def widen() -> None:
    """Let numba use vectors of 512 bits where a processor has them, unless its variables choose the
    processor's features.

    LLVM prefers 256 bits on most such processors. The features are part of the key of numba's
    cache.
    """
    settings: Any = config
    features = get_host_cpu_features()
    chosen = settings.CPU_NAME is not None or settings.CPU_FEATURES is not None
    if not chosen and "+avx512f" in features.split(","):
        settings.CPU_FEATURES = f"{features},-prefer-256-bit"


widen()


def scalar(function: Callable[..., Any]) -> Any:
    """A scalar function, inlined into its callers."""
    return njit(forceinline=True, **OPTIONS)(function)


def ordered(function: Callable[..., Any]) -> Any:
    """A scalar function whose sums and products keep their written order."""
    options: dict[str, Any] = {**OPTIONS, "fastmath": FASTMATH - {"reassoc"}}
    return njit(forceinline=True, **options)(function)


@cache
def digest(folder: Path) -> str:
    """A short digest of the Python files in a folder and below."""
    return sha256(b"".join(file.read_bytes() for file in sorted(folder.rglob("*.py")))).hexdigest()


SOURCES = digest(Path(__file__).parent)


class CodeFiles(IndexDataCacheFile):
    """Files of a loop's machine code, named by all that determines it.

    The index of numba's own files names a file before it is written, and two processes may give one
    name to two types of number: after a kill, or a race, a type would get the code of another.
    """

    def __init__(self, folder: str, loop: str, sources: str):
        super().__init__(folder, loop, sources)
        self._all, self._stem = f"{loop}.*", f"{loop}.{sha256(sources.encode()).hexdigest()[:16]}"

    def load(self, key: Any) -> Any:
        """The machine code of a key; None if there is none."""
        with suppress(FileNotFoundError):
            return self._load_data(self._name(key))
        return None

    def save(self, key: Any, data: Any) -> None:
        """Write the machine code of a key, and delete that of other sources."""
        self._save_data(self._name(key), data)
        for file in Path(self._cache_path).glob(self._all):
            if not file.name.startswith(self._stem):
                file.unlink(missing_ok=True)

    def _name(self, key: Any) -> str:
        return f"{self._stem}.{sha256(repr((self._version, key)).encode()).hexdigest()[:16]}.nbc"


class Kept(FunctionCache):
    """numba's cache of machine code, whose failures cost only time: unreadable code is
    recompiled.
    """

    warned = False
    announced = False
    #: The folders of all loops' machine code, which numba chooses.
    folders: ClassVar[set[str]] = set()

    def __init__(self, loop: Callable[..., Any]):
        super().__init__(loop)
        Kept.folders.add(self.cache_path)
        # numba's own stamp covers the loop's file, but not functions that it calls, here or in a
        # plugin
        sources = SOURCES + digest(Path(loop.__code__.co_filename).parent)
        self._cache_file = CodeFiles(self.cache_path, self._impl.filename_base, sources)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The machine code on disk; None to compile, which is reported once."""
        code = self._tried(super().load_overload, sig, target_context)
        if code is None and not Kept.announced:
            Kept.announced = True
            sys.stderr.write(
                "mvrecon: compiling kernels, about a minute, and keeping them "
                "(mvrecon-warmup compiles all)\n"
            )
        return code

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write machine code to disk, if possible."""
        self._tried(super().save_overload, sig, data)

    def _tried(self, act: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return act(*arguments)
        except Exception as problem:  # damaged pickles raise anything
            if not Kept.warned:
                Kept.warned = True
                logger.warning(
                    "Compiled kernels in %s cannot be used or kept, so they are made anew: %s: %s; "
                    "NUMBA_CACHE_DIR=<folder> keeps them elsewhere",
                    self.cache_path,
                    type(problem).__name__,
                    problem,
                )
            return None


class Unkept(NullCache):
    """No cache, as no folder can be written, which is reported once, when a kernel is compiled."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Report that this command compiles, and every later one."""
        if not Kept.announced:
            Kept.announced = True
            sys.stderr.write(
                "mvrecon: compiling kernels, about a minute at every command, as no folder for "
                "them can be written; NUMBA_CACHE_DIR=<folder> keeps them\n"
            )


def compiled(loop: Callable[..., Any]) -> Any:
    """Compile a loop, which releases the interpreter's lock."""
    dispatcher: Any = njit(nogil=True, **OPTIONS)(loop)
    if dispatcher is loop:  # numba may be configured not to compile, as by its CUDA simulator
        return loop
    try:
        dispatcher._cache = Kept(loop)
    except RuntimeError:  # numba finds no writable folder
        dispatcher._cache = Unkept()
    return dispatcher


def kept_in() -> str | None:
    """The folder that contains all machine code; None if none can be written."""
    return os.path.commonpath(Kept.folders) if Kept.folders else None
