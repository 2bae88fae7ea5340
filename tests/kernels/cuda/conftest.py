import pytest

from tests.kernels.cuda.scenes import SIMULATED


@pytest.fixture(autouse=True)
def few_threads(monkeypatch):
    """A thread of the simulator is one of the interpreter, so idle ones cost as much as busy
    ones.
    """
    if SIMULATED:
        monkeypatch.setattr("mvrecon.kernels.rays.cuda.operators.BLOCK", 32)
        monkeypatch.setattr("mvrecon.kernels.rays.cuda.loops.BLOCK", 32)
