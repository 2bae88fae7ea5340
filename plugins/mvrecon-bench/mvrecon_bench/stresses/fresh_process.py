"""Python in a fresh process, for what would end this one or needs its imports undone."""

import os
import subprocess
import sys
from pathlib import Path

import mvrecon

#: Seconds after which a process counts as hanging.
LIMIT = 100.0


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A Python of its own, with this mvrecon on its path: how it ended, and what it wrote.

    Raises:
        TimeoutExpired: it takes longer than `LIMIT`; it is ended.
    """
    checkout = str(Path(mvrecon.__file__).parents[1])
    path = os.pathsep.join([checkout, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT,
    )
