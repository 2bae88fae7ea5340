"""The fast tier, `bash scripts/test.sh -m fast`: the mathematics of every room.

It is every test of the folders and files of FAST, less those of APART and those marked as slow.
"""

import gc
import os
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

# the many processes that tests start read each other's bytecode; some containers forbid to keep it
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

TESTS = Path(__file__).parent / "tests"
FAST = [
    TESTS / place
    for place in (
        "core",
        "geometry",
        "kernels",
        "operators",
        "methods",
        "data/scenes",
        "data/acquisition",
        "data/projections",
        "report",
        "training/test_losses.py",
    )
]
#: Of these, what takes a compiler or torch's transforms, hulls, networks, calibration and pictures.
APART = [
    TESTS / place
    for place in (
        "kernels/cuda",
        "kernels/test_torch.py",
        "kernels/test_func.py",
        "operators/visual_hull",
        "methods/learned",
        "methods/calibration",
        "report/viz",
    )
]


@cache  # of a file's many tests
def is_fast(file: Path) -> bool:
    return any(map(file.is_relative_to, FAST)) and not any(map(file.is_relative_to, APART))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m fast`, no other file is imported: that alone takes as long as the tests."""
    if config.option.markexpr != "fast" or collection_path.is_dir():
        return None
    return None if is_fast(collection_path) else True


@pytest.fixture(autouse=True, scope="session")
def float32_convolutions() -> Iterator[None]:
    """Tests hold on every processor: also where "auto" convolutions are in bfloat16."""
    from mvrecon.methods.learned import unet

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unet, "has_bfloat16", lambda: False)
        yield


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """`mvrecon-reconstruct` draws neither rig nor planes: that takes longer than small volumes."""
    blank = np.zeros((2, 2, 3), np.uint8)
    monkeypatch.setattr("mvrecon.report.viz.rig.picture", lambda *_: blank)
    monkeypatch.setattr("mvrecon.report.viz.review.scan", lambda *_: blank)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tests of the fast tier."""
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}
        if is_fast(item.path) and not marks & {"slow", "long"}:
            item.add_marker("fast")


def pytest_collection_finish() -> None:
    """Excludes imported objects from garbage collection, for speed."""
    gc.collect()
    gc.freeze()
