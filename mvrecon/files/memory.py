"""Peak memory of this process."""

import sys

try:
    import resource
except ImportError:  # Windows has no such module
    resource = None


def peak() -> int | None:
    """The most memory that this process has had so far, in bytes; None on Windows, where Python
    cannot ask for it.
    """
    if resource is None:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
