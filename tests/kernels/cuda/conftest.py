import shutil

import pytest

from mvrecon.kernels import self_test
from mvrecon.kernels.cuda.launch import kernels_of
from tests.kernels.cuda.host import compiled, stand_in


@pytest.fixture(scope="session")
def libraries(tmp_path_factory: pytest.TempPathFactory):
    """The kernels by g++, once for all tests; by the structure that they take."""
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler")
    return compiled(tmp_path_factory.mktemp("rays"))


@pytest.fixture
def host(libraries, monkeypatch, tmp_path):
    """A stand-in for a device; its driver."""
    forget()
    yield stand_in(monkeypatch, libraries, tmp_path / "kernels")
    forget()


def forget() -> None:
    kernels_of.cache_clear()
    self_test.forget()
