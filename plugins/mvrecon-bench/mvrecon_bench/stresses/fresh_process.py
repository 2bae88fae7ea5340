"""Run Python in a fresh process, for tests that may crash or that require a clean import state."""

import os
import subprocess
import sys
from pathlib import Path

import mvrecon

#: Timeout of a process in seconds.
LIMIT = 100.0


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with this mvrecon on its path; return exit status and output.

    Raises:
        TimeoutExpired: the process exceeded `LIMIT` and was terminated.
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
