"""What several test files share."""

import doctest
import inspect
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import mvrecon as mv
from mvrecon.core.parts import LISTED

ROOT = Path(__file__).parents[1]


@pytest.fixture
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture
def registries(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone after it."""
    for registry in LISTED.values():
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))


@pytest.fixture
def run_python() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs a fresh interpreter in the checkout, as a user's shell would."""

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=900,
            check=False,
        )

    return run


@pytest.fixture(scope="session")
def run_example() -> Callable[..., dict[str, Any]]:
    """Runs the example in a docstring, with `mv` and `torch` imported, and returns its names."""

    def run(documented: Any, **names: Any) -> dict[str, Any]:
        said: list[str] = []
        text, name = inspect.getdoc(documented) or "", documented.__name__
        known = {"mv": mv, "torch": torch, **names}
        test = doctest.DocTestParser().get_doctest(text, known, name, None, 0)
        doctest.DocTestRunner().run(test, out=said.append, clear_globs=False)
        if said:
            raise AssertionError("".join(said))
        assert test.examples, f"{name} has no example"
        return test.globs

    return run
