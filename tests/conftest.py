"""What several test files share."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

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
