"""The error of an adapter, or of a plugin's part, whose library cannot be imported."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec


@contextmanager
def needs(package: str) -> Iterator[None]:
    """Context of an import of another library.

    Raises:
        ImportError: it is not installed, and the message says how to install it; or it does not
            import, and the message says why.
    """
    try:
        yield
    except Exception as error:
        if find_spec(package) is not None:
            raise ImportError(f"{package} is installed but does not import: {error}") from error
        raise ImportError(f"This needs {package}: pip install {package}") from error
