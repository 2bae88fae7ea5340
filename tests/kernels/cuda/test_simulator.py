"""The kernels of the CUDA back end in numba's simulator, where there is no device.

The simulator must be chosen before numba is imported, so the tests of this folder run again in a
process of their own.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.kernels.cuda.scenes import SIMULATED


@pytest.mark.skipif(SIMULATED, reason="is the simulator")
def test_in_the_simulator():
    pytest.importorskip("numba")
    # numba cannot compile the arrays of its simulator: everything runs as Python
    environment = os.environ | {
        "NUMBA_ENABLE_CUDASIM": "1",
        "NUMBA_DISABLE_JIT": "1",
        "PYTHONPATH": os.getcwd(),
    }
    environment.pop("PYTEST_XDIST_WORKER", None)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        str(Path(__file__).parent),
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0 and "passed" in done.stdout, (
        done.stdout[-4000:] + done.stderr[-2000:]
    )
