"""Fixtures of the plugin's tests."""

import tomllib
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from mvrecon.apps.config import compose
from mvrecon.core import registry
from mvrecon.geometry.cameras import files
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The parts that the plugin's package declares, installed."""
    declared = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    points = declared["project"]["entry-points"][registry.GROUP]
    found = tuple(EntryPoint(name, value, registry.GROUP) for name, value in points.items())
    monkeypatch.setattr(registry, "installed", lambda: found)


@pytest.fixture
def scan_of(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """The settings of a scan whose counts [1 1 m v u] and rig are written to files."""

    def written(counts: Tensor, rig: Cameras, grid: Grid, *options: str) -> dict[str, Any]:
        np.save(tmp_path / "counts.npy", counts[0, 0].numpy())
        files.save(rig, tmp_path / "rig.json")
        of_grid = "size", "spacing", "centre"
        values = list(grid.size), list(grid.spacing), grid.centre.tolist()
        return compose(
            f"views.path={tmp_path}/counts.npy",
            "camera=from_file",
            f"camera.path={tmp_path}/rig.json",
            *(f"grid.{name}={value}" for name, value in zip(of_grid, values, strict=True)),
            *options,
            config_name="reconstruct",
        )

    return written
