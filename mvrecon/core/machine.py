"""This process: device, total and free memory, rank in a run, and output of libraries."""

import ctypes
import logging
import os
import sys
import warnings
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from mvrecon.core.registry import hint

try:
    import resource
except ImportError:  # Windows has no such module
    resource = None

#: Linux (proc(5)): memory of this process; the file that resets its peak (write 5); free memory.
PROCESS_STATUS, CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")
MEMORY_INFO = Path("/proc/meminfo")


def peak() -> int | None:
    """Peak memory of this process in bytes, on Linux since the last `restarted_peak`; None on
    Windows, where Python cannot measure it.
    """
    if resource is None:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def restarted_peak(trimmed: bool = False) -> int | None:
    """Reset the peak and return the current memory in bytes, the start of `peak_since`; None except
    on Linux.

    Args:
        trimmed: first return to the system what the C library keeps of freed memory, in which a
            later call would need none.
    """
    if sys.platform != "linux":
        return None
    if trimmed and hasattr(library := ctypes.CDLL(None), "malloc_trim"):
        library.malloc_trim(0)
    try:
        CLEAR_REFS.write_text("5")
        return _sizes(PROCESS_STATUS)["VmRSS"]
    except (OSError, KeyError):
        return None


def peak_since(start: int | None) -> int | None:
    """Peak memory above `start` since then, in bytes; None if `start` is."""
    return None if start is None else max(0, _sizes(PROCESS_STATUS)["VmHWM"] - start)


def check_memory(needed: int, what: str) -> None:
    """Check that needed bytes are free; up to a gibibyte is not checked.

    Raises:
        ValueError: more bytes than available, with both in GiB.
    """
    if needed > 2**30 and (room := memory_at_hand()) is not None and needed > room:
        raise ValueError(
            f"{what} needs {needed / 2**30:,.1f} GiB of memory; {room / 2**30:,.1f} GiB are at hand"
        )


def memory_at_hand() -> int | None:
    """Free memory for this process in bytes, within its limits; None: unknown."""
    if resource is None:
        return None
    rooms = []
    if MEMORY_INFO.exists():
        sizes = _sizes(MEMORY_INFO)
        rooms.append(sizes["MemAvailable"] + sizes.get("SwapFree", 0))
    else:  # macOS does not report free memory
        rooms.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    # within the limit of the container (Linux, cgroup v2)
    most, used = (Path("/sys/fs/cgroup", name) for name in ("memory.max", "memory.current"))
    if most.exists() and used.exists() and (text := most.read_text().strip()) != "max":
        rooms.append(int(text) - int(used.read_text()))
    soft = resource.getrlimit(resource.RLIMIT_AS)[0]
    statm = Path("/proc/self/statm")
    if soft != resource.RLIM_INFINITY and statm.exists():
        rooms.append(soft - int(statm.read_text().split()[0]) * resource.getpagesize())
    return max(0, min(rooms))


def _sizes(path: Path) -> dict[str, int]:
    """Sizes in bytes by name, of a file of /proc whose lines are `name: number kB`."""
    lines = (line.split() for line in path.read_text().splitlines() if line.endswith(" kB"))
    return {name.rstrip(":"): int(number) * 1024 for name, number, _ in lines}


#: Environment variables of rank and world size, by precedence.
RANKS, WORLDS = ("RANK", "SLURM_PROCID"), ("WORLD_SIZE", "SLURM_STEP_NUM_TASKS")


def rank() -> int:
    """Rank of this process in its run; rank 0 writes the run's files."""
    return _number(RANKS, 0) if world() > 1 else 0


def world() -> int:
    """Number of processes that an external launcher has started for this run; 1 without."""
    return _number(WORLDS, 1)


def _number(names: tuple[str, ...], default: int) -> int:
    return int(next((os.environ[name] for name in names if name in os.environ), default))


#: Devices of apps, by Lightning's names.
Device: TypeAlias = Literal["auto", "cpu", "gpu", "cuda"]
ACCELERATORS = get_args(Device)


def device_of(accelerator: str) -> str:
    """Return the device of an app for Lightning's name of an accelerator.

    Raises:
        ValueError: an unknown name, or a GPU that torch does not detect.
    """
    if accelerator not in ACCELERATORS:
        raise ValueError(f"Unknown device {accelerator!r}{hint(str(accelerator), ACCELERATORS)}")
    import torch

    available = torch.cuda.is_available()
    if accelerator in ("gpu", "cuda") and not available:
        raise ValueError(f"Expected a GPU for device {accelerator!r}, but torch sees none here")
    return "cuda" if accelerator != "cpu" and available else "cpu"


def silence_libraries() -> None:
    """Suppress libraries' own lines about devices, seeds and fonts; their warnings stay.

    Call it first, as some print while being imported.
    """
    for library in ("lightning.pytorch", "lightning.fabric", "matplotlib"):
        logging.getLogger(library).setLevel(logging.WARNING)
    # Lightning's own use of torch, which users cannot change
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated")
    # steps are logged, whatever the epoch
    warnings.filterwarnings("ignore", "The number of training batches")
