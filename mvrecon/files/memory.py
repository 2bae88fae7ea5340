"""Peak memory of this process."""

import sys
from pathlib import Path

try:
    import resource
except ImportError:  # Windows has no such module
    resource = None

#: Linux: sizes of this process; and the file that a 5 starts its highest size anew by (proc(5)).
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


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
        return _size("VmRSS")
    except (OSError, KeyError):
        return None


def peak_since(start: int | None) -> int | None:
    """The most memory above `start` since then, in bytes; None if `start` is."""
    return None if start is None else max(0, _size("VmHWM") - start)


def _size(name: str) -> int:
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines() if ":" in line)
    return int(lines[name].split()[0]) * 1024
