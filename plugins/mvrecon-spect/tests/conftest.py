"""Fixtures of the plugin's tests."""

import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from mvrecon.core import registry


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The parts that the plugin's package declares, installed."""
    declared = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    points = declared["project"]["entry-points"][registry.GROUP]
    found = tuple(EntryPoint(name, value, registry.GROUP) for name, value in points.items())
    monkeypatch.setattr(registry, "installed", lambda: found)
