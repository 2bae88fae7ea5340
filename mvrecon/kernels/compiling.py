"""How functions become machine code: at the first call for a type of number, and kept on disk for
the next process.
"""

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba import njit

#: What may be reordered: sums and products, but NaN and infinity keep their meaning.
FASTMATH = {"reassoc", "contract", "nsz"}

#: The loops make no arrays, so they need not count who holds one: counting costs as much as a ray.
OPTIONS: dict[str, Any] = {"fastmath": FASTMATH, "error_model": "numpy", "_nrt": False}


def scalar(function: Callable[..., Any]) -> Any:
    """A function of scalars, compiled into whatever calls it, on the CPU and on CUDA devices."""
    dispatcher: Any = njit(forceinline=True, **OPTIONS)(function)
    # read by numba-cuda alone: it would take some flags of fast mathematics for all, reciprocals
    # for divisions too
    dispatcher.targetoptions = {"forceinline": True}
    return dispatcher


def ordered(function: Callable[..., Any]) -> Any:
    """A function of scalars whose sums and products are taken as they are written, in no other
    order.
    """
    options: dict[str, Any] = {**OPTIONS, "fastmath": FASTMATH - {"reassoc"}}
    return njit(forceinline=True, **options)(function)


def digest(folder: Path) -> str:
    """What the Python files of a folder and below hold, in short."""
    return sha256(b"".join(file.read_bytes() for file in sorted(folder.rglob("*.py")))).hexdigest()


SOURCES = digest(Path(__file__).parent)


def compiled(loop: Callable[..., Any]) -> Any:
    """The loop in machine code; threads may run it side by side."""
    options = {"nogil": True, **OPTIONS}
    try:
        dispatcher: Any = njit(cache=True, **options)(loop)
    except RuntimeError:  # numba finds no folder to write to
        return njit(**options)(loop)
    if (
        dispatcher is not loop
    ):  # numba may be told to compile nothing, as under its simulator of CUDA
        # numba's own stamp sees edits of this file only, not of the functions that the loops call
        dispatcher._cache._cache_file._source_stamp = SOURCES
    return dispatcher
