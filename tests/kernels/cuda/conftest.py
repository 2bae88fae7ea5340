import pytest

from tests.kernels.cuda.host import compiled, reader_of_machine_code, stand_in


@pytest.fixture(scope="session")
def libraries(tmp_path_factory: pytest.TempPathFactory):
    """The kernels by g++, once for all tests; by the structure that they take."""
    return compiled(tmp_path_factory.mktemp("rays"))


@pytest.fixture
def host(libraries, monkeypatch, tmp_path):
    """A stand-in for a device; its driver."""
    yield from stand_in(monkeypatch, libraries, tmp_path / "kernels")


@pytest.fixture(scope="session")
def machine_code():
    """The module of mvrecon-bench that reads machine code."""
    return reader_of_machine_code()
