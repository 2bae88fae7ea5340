import shutil

import pytest

from mvrecon.kernels.rays.cuda import selfcheck
from mvrecon.kernels.rays.cuda.kernels import kernels_of
from tests.kernels.cuda.host import compiled, stand_in


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory):
    """The kernels by g++, once for all tests."""
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler")
    return compiled(tmp_path_factory.mktemp("rays"))


@pytest.fixture
def host(library, monkeypatch, tmp_path):
    """A stand-in for a device; its driver."""
    kernels_of.cache_clear()
    selfcheck.forget()
    yield stand_in(monkeypatch, library, tmp_path / "kernels")
    kernels_of.cache_clear()
    selfcheck.forget()
