"""The fast tier, `bash scripts/test.sh -m fast`: the mathematics of every room.

It is every test of the folders and files of FAST, less those of APART and those marked as slow.
"""

import gc
import itertools
import os
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.covering import covering_array, takes_long

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
        "kernels/rays/test_torch.py",
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


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """`@pytest.mark.pairwise(shift, kind=KINDS, option=OPTIONS)` runs a test on a covering array of
    options; the rest of their product is behind `-m long`, and is not collected without it.
    """
    for mark in metafunc.definition.iter_markers("pairwise"):
        values = [list(each) for each in mark.kwargs.values()]
        few = set(covering_array(map(len, values), *mark.args))
        rows = itertools.product(*(range(len(each)) for each in values))
        long = takes_long(metafunc.config)
        metafunc.parametrize(
            list(mark.kwargs),
            [
                pytest.param(
                    *(each[i] for each, i in zip(values, row, strict=True)),
                    marks=() if row in few else pytest.mark.long,
                    id="-".join(map(_label, mark.kwargs, values, row)),
                )
                for row in rows
                if row in few or long
            ],
        )


def _label(name: str, values: list[Any], i: int) -> str:
    """Of a value: itself, its first part, or its place in the list."""
    value = values[i][0] if isinstance(values[i], tuple) and values[i] else values[i]
    numbers = isinstance(values[i], tuple) and not isinstance(value, str)
    if numbers or not isinstance(value, str | int | float | torch.dtype):
        return f"{name}{i}"
    return str(value)


@pytest.fixture(autouse=True, scope="session")
def float32_convolutions() -> Iterator[None]:
    """Tests hold on every processor: also where "auto" convolutions are in bfloat16."""
    from mvrecon.methods.learned import unet

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unet, "has_bfloat16", lambda: False)
        yield


@pytest.fixture(autouse=True, scope="session")
def nothing_waits_for_the_disk() -> Iterator[None]:
    """No test cuts the power: a killed process loses nothing that it has written."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
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


def pytest_collection() -> None:
    """Imports make hardly any garbage: to look for it among them takes a tenth of the time."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Excludes imported objects from garbage collection, for speed."""
    gc.collect()
    gc.freeze()
    gc.enable()
