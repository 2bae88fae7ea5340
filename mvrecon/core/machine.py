"""This process: its device, its memory and what is free of it, its rank among the processes of a
run, and what libraries write in it.
"""

import logging
import os
import sys
import warnings
from pathlib import Path

from mvrecon.core.registry import hint

try:
    import resource
except ImportError:  # Windows has no such module
    resource = None

#: Linux (proc(5)): sizes of this process; the file that a 5 starts its highest size anew by; what
#: is free.
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
FREE = Path("/proc/meminfo")


def peak() -> int | None:
    """The most memory that this process has had so far, in bytes, on Linux since the last
    `restarted_peak`; None on Windows, where Python cannot ask for it.
    """
    if resource is None:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def restarted_peak() -> int | None:
    """The memory of this process now, in bytes, from which `peak_since` counts; None where the
    system has no such count (it is Linux's).
    """
    try:
        CLEAR.write_text("5")
        return _sizes(STATUS)["VmRSS"]
    except (OSError, KeyError):
        return None


def peak_since(start: int | None) -> int | None:
    """The most memory above `start` since then, in bytes; None if `start` is."""
    return None if start is None else max(0, _sizes(STATUS)["VmHWM"] - start)


def check_memory(needed: int, what: str) -> None:
    """Raise an error if more bytes are needed than are free; a gibibyte or less is not checked.

    Raises:
        ValueError: more bytes than are at hand, with both in GiB.
    """
    if needed > 2**30 and (room := memory_at_hand()) is not None and needed > room:
        raise ValueError(
            f"{what} needs {needed / 2**30:,.1f} GiB of memory; {room / 2**30:,.1f} GiB are at hand"
        )


def memory_at_hand() -> int | None:
    """Free memory for this process in bytes, within the limits set for it; None: not known."""
    if resource is None:
        return None
    rooms = []
    if FREE.exists():
        sizes = _sizes(FREE)
        rooms.append(sizes["MemAvailable"] + sizes.get("SwapFree", 0))
    else:  # macOS does not say what is free
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


#: Variables with the number of this process and with the number of all, by precedence.
RANKS, WORLDS = ("RANK", "SLURM_PROCID"), ("WORLD_SIZE", "SLURM_STEP_NUM_TASKS")


def rank() -> int:
    """Number of this process among those of its run; the first, 0, writes the run's files."""
    return _number(RANKS, 0) if world() > 1 else 0


def world() -> int:
    """Number of processes that a launcher outside has started for this run; 1 without a
    launcher.
    """
    return _number(WORLDS, 1)


def _number(names: tuple[str, ...], default: int) -> int:
    return int(next((os.environ[name] for name in names if name in os.environ), default))


#: Where an app can compute, by Lightning's names.
ACCELERATORS = ("auto", "cpu", "gpu", "cuda")


def device_of(accelerator: str) -> str:
    """The device that an app computes on, for Lightning's name of an accelerator.

    Raises:
        ValueError: a name that is not known, or a GPU where torch sees none.
    """
    if accelerator not in ACCELERATORS:
        raise ValueError(f"Unknown device {accelerator!r}{hint(str(accelerator), ACCELERATORS)}")
    import torch

    available = torch.cuda.is_available()
    if accelerator in ("gpu", "cuda") and not available:
        raise ValueError(f"Expected a GPU for device {accelerator!r}, but torch sees none here")
    return "cuda" if accelerator != "cpu" and available else "cpu"


def silence_libraries() -> None:
    """Leave libraries' own lines about devices, seeds and fonts out; their warnings stay.

    Some write while they are imported, so this comes before.
    """
    for library in ("lightning.pytorch", "lightning.fabric", "matplotlib"):
        logging.getLogger(library).setLevel(logging.WARNING)
    # Lightning's own use of torch, of which no user can be rid
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated")
    # what is logged are steps, of whatever epoch
    warnings.filterwarnings("ignore", "The number of training batches")
