"""The app `mvrecon-bench` as a user calls it."""

import csv
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import mvrecon_bench.bench


def _call(folder: Path, *options: str) -> list[dict[str, str]]:
    patch = pytest.MonkeyPatch()
    patch.setattr(
        sys, "argv", ["mvrecon-bench", f"out={folder}", *options, "hydra/job_logging=none"]
    )
    try:
        mvrecon_bench.bench.main()
    finally:
        patch.undo()
    with open(folder / "results.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="session")
def call() -> Callable[..., list[dict[str, str]]]:
    """Runs the app with `out` and further options; the rows of its results."""
    return _call
