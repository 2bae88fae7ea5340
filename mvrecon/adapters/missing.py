"""The error of an adapter whose library is not installed."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs(package: str) -> Iterator[None]:
    """Context of an import of another library.

    Raises:
        ImportError: it is not installed; the message says how to install it.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(f"This adapter needs {package}: pip install {package}") from error
