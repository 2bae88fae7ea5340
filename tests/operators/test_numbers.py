"""Digits, and machine code that is never older than its source."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid

DETECTOR = {"pixels": [14, 15], "pixel_mm": 2.1}
GRID = Grid.centred(size=(22, 20, 18), spacing=(1.0, 1.1, 0.9))


@pytest.mark.pairwise(offset=[0.0, 1e5], sid=[60.0, 1e6], backend=["reference", "cpu"])
def test_distant_sources_and_origins_lose_no_precision(offset, sid, backend):
    torch.manual_seed(0)
    shift = torch.full((3,), offset, dtype=torch.float64)
    affine = GRID.affine.clone()
    affine[:3, 3] += shift
    rig = circular(6, sid, sid + 30, DETECTOR, start_degrees=7.0).moved(torch.eye(3), shift)
    x = torch.rand(1, 1, *GRID.shape, dtype=torch.float64)
    A = PROJECTORS.build("drr", grid=Grid(GRID.shape, affine), cameras=rig, backend=backend)
    exact = PROJECTORS.build(
        "drr", grid=GRID, cameras=rig.moved(torch.eye(3), -shift), backend="reference"
    )(x)
    assert (A(x) - exact).norm() < 1e-9 * exact.norm()
    assert (A(x.float()) - exact).norm() < 2e-6 * exact.norm()


def test_scale_changes_nothing_but_the_unit():
    x = torch.rand(1, 1, *GRID.shape, dtype=torch.float64)
    rig = circular(3, 60.0, 90.0, DETECTOR, start_degrees=7.0)
    y = PROJECTORS.build("drr", grid=GRID, cameras=rig)(x)
    for factor in (1e-6, 1e6):
        scaled = replace(
            rig, **{each: factor * getattr(rig, each) for each in ("source", "origin", "u", "v")}
        )
        affine = torch.diag(torch.tensor([factor] * 3 + [1.0], dtype=torch.float64)) @ GRID.affine
        views = PROJECTORS.build("drr", grid=Grid(GRID.shape, affine), cameras=scaled)(x)
        assert torch.allclose(views / factor, y, rtol=1e-9, atol=1e-9)


def test_the_disk_cache_knows_every_source_file():
    """A change of the ray arithmetic must invalidate old machine code; numba itself checks only the
    file of the loops.
    """
    from mvrecon.kernels import compiling
    from mvrecon.kernels.rays.cpu import loops

    for loop in (loops.project_rows, loops.backproject_slabs, loops.vary_rows):
        beside = compiling.digest(Path(loops.__file__).parent)
        assert loop._cache._cache_file._source_stamp == compiling.SOURCES + beside
    folder = Path(compiling.__file__).parent
    assert compiling.digest(folder) == compiling.SOURCES != compiling.digest(folder.parent)
