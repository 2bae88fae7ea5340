"""How functions become machine code: at the first call for a type of number, and kept on disk for
the next process.
"""

import logging
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache

logger = logging.getLogger(__name__)

#: What may be reordered: sums and products, but NaN and infinity keep their meaning.
FASTMATH = {"reassoc", "contract", "nsz"}

#: The loops make no arrays, so they need not count who holds one: counting costs as much as a ray.
OPTIONS: dict[str, Any] = {"fastmath": FASTMATH, "error_model": "numpy", "_nrt": False}


def scalar(function: Callable[..., Any]) -> Any:
    """A function of scalars, compiled into whatever calls it."""
    return njit(forceinline=True, **OPTIONS)(function)


def ordered(function: Callable[..., Any]) -> Any:
    """A function of scalars whose sums and products are taken as they are written, in no other
    order.
    """
    options: dict[str, Any] = {**OPTIONS, "fastmath": FASTMATH - {"reassoc"}}
    return njit(forceinline=True, **options)(function)


@cache
def digest(folder: Path) -> str:
    """What the Python files of a folder and below hold, in short."""
    return sha256(b"".join(file.read_bytes() for file in sorted(folder.rglob("*.py")))).hexdigest()


SOURCES = digest(Path(__file__).parent)


class Kept(FunctionCache):
    """numba's files of machine code, whose failures cost time alone: what cannot be read or written
    is compiled.
    """

    warned = False
    announced = False

    def __init__(self, loop: Callable[..., Any]):
        super().__init__(loop)
        # numba's own stamp sees edits of the loop's file only, not of the functions that the loops
        # call, which are here, or beside it in a plugin
        self._cache_file._source_stamp = SOURCES + digest(Path(loop.__code__.co_filename).parent)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The machine code on disk; None where it must be compiled, which is said once."""
        code = self._tried(super().load_overload, sig, target_context)
        if code is None and not Kept.announced:
            Kept.announced = True
            sys.stderr.write("mvrecon: compiling kernels, once, about 30 s (mvrecon-warmup)\n")
        return code

    def save_overload(self, sig: Any, data: Any) -> None:
        """Machine code to disk, where there is room."""
        self._tried(super().save_overload, sig, data)

    def _tried(self, act: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return act(*arguments)
        except Exception as problem:  # damaged pickles raise anything
            index = Path(self._cache_file._index_path)
            if not Kept.warned:
                Kept.warned = True
                why = f"{type(problem).__name__}: {problem}"
                logger.warning(
                    "Compiled kernels in %s cannot be used or kept, so they are made anew: %s",
                    index,
                    why,
                )
            # it may be damaged, or name a file of older machine code that could not be overwritten
            with suppress(OSError):
                index.unlink(missing_ok=True)
            return None


def compiled(loop: Callable[..., Any]) -> Any:
    """The loop in machine code; threads may run it side by side."""
    dispatcher: Any = njit(nogil=True, **OPTIONS)(loop)
    if dispatcher is loop:  # numba may be told to compile nothing, as under its simulator of CUDA
        return loop
    with suppress(RuntimeError):  # numba finds no folder to write to
        dispatcher._cache = Kept(loop)
    return dispatcher


def kept_in() -> Path:
    """The folder where numba keeps machine code: that of the environment variable NUMBA_CACHE_DIR,
    else beside the code.
    """
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent)
