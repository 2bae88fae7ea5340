"""The skipping mode is chosen by counting voxels, and reported."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvrecon.geometry.cameras.rigs import dome
from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.cpu import plan, skip_policy
from mvrecon.kernels.rays.cpu.skip_policy import bricks_of, readable
from mvrecon.kernels.rays.occupancy import EDGE
from tests.operators.cases import Case
from tests.operators.sparse import CASES, volumes

pytestmark = pytest.mark.usefixtures("nothing_is_too_little")


def test_bricks_contain_nonzero_voxels_and_their_successors():
    x = volumes("corners").flatten(0, 1)
    box = Box.around(x[0] != 0)
    found = bricks_of(x.numpy(), box)
    for k, j, i in torch.cartesian_prod(*[torch.arange(n) for n in found.shape]).tolist():
        part = x[
            0,
            k * EDGE : k * EDGE + EDGE + 1,
            j * EDGE : j * EDGE + EDGE + 1,
            i * EDGE : i * EDGE + EDGE + 1,
        ]
        assert bool(found[k, j, i]) == bool(part.any())


def test_the_skipping_mode_is_reported_and_follows_the_scene():
    """A full volume: nothing to skip. A small object: its box. Two small ones in far corners:
    bricks.
    """
    grid = Grid.centred((64, 64, 64), 1.0)
    A = Case(grid, dome(4, 120.0, 60.0, 120.0, {"pixels": [96, 96], "pixel_mm": 0.45})).build()
    x = torch.rand(1, 1, 64, 64, 64) + 0.1
    A(x)
    assert (A.skipped.mode, A.skipped.box) == (
        "off",
        Box.whole((64, 64, 64)),
    ) and "full" in A.skipped.why
    A(torch.nn.functional.pad(x[..., 20:40, 20:40, 20:40], (20, 24) * 3))
    assert (A.skipped.mode, A.skipped.box) == ("box", Box((20,) * 3, (40,) * 3))
    far = torch.zeros_like(x)
    far[..., :6, :6, :6] = far[..., -6:, -6:, -6:] = 1
    A(far)
    assert (
        A.skipped.mode == "brick"
        and A.skipped.fractions["brick"] < 0.5 * A.skipped.fractions["box"]
    )
    assert "bricks" in A.skipped.why


def test_bricks_are_not_used_if_the_box_leaves_little_work(monkeypatch):
    """The overhead of a call would hide the savings."""
    grid = Grid.centred((64, 64, 64), 1.0)
    A = Case(grid, dome(4, 120.0, 60.0, 120.0, {"pixels": [96, 96], "pixel_mm": 0.45})).build()
    x = torch.zeros(1, 1, 64, 64, 64)
    x[..., 8:12, 8:12, 8:12] = x[..., 36:40, 36:40, 36:40] = 1
    views = A(x)
    assert A.skipped.mode == "brick"
    scene = plan.Scene(A.lines, A.ray_extent, A.detector, A.kernel)
    monkeypatch.setattr(skip_policy, "MUCH", scene.slabs(grid.shape))
    assert torch.equal(A(x), views)
    assert A.skipped.mode == "box" and "too little to gain" in A.skipped.why


def test_small_volumes_are_not_inspected(monkeypatch):
    monkeypatch.undo()
    A = CASES["cone"].build()
    A(volumes("blob"))
    assert A.skipped.mode == "off" and "small work" in A.skipped.why


class Counted(np.ndarray):
    """Voxels that count how often one is read."""

    reads = 0

    def __getitem__(self, place):
        Counted.reads += 1
        return super().__getitem__(place)


def test_few_voxels_of_a_full_volume_are_inspected(monkeypatch):
    """A row of each face of its box, and one voxel of each of a few hundred bricks."""
    for name in ("inward", "sample_bricks", "_face_holds", "_brick_holds", "_stride"):
        monkeypatch.setattr(skip_policy, name, getattr(skip_policy, name).py_func)
    monkeypatch.setattr(
        skip_policy, "bricks_of", lambda *_: pytest.fail("all voxels are looked at")
    )
    Counted.reads = 0
    monkeypatch.setattr(skip_policy, "readable", lambda volumes: readable(volumes).view(Counted))
    case = CASES["cone"]
    A = replace(case, grid=Grid.centred((64, 64, 64), 1.0)).build(skip="auto")
    full = torch.rand(1, 64, 64, 64) + 0.1
    held = skip_policy.occupancy_of(
        full, plan.Scene(A.lines, A.ray_extent, A.detector, A.kernel), "auto"
    )
    assert held.box == Box.whole((64, 64, 64)) and held.bricks is None
    assert 0 < Counted.reads < full.numel() / 200


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"skip": "boxes"}, "Unknown skip 'boxes'. Known: auto, off, box, brick, verify"),
        (
            {"support": torch.ones(3, 3, 3, dtype=torch.bool)},
            r"shape \(19, 26, 33\), got bool of \(3, 3, 3\)",
        ),
        ({"support": torch.ones(19, 26, 33)}, r"mask of bool .* got float32 of \(19, 26, 33\)"),
    ],
)
def test_invalid_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        CASES["cone"].build(**options)


def test_the_reference_needs_no_skipping():
    A = CASES["cone"].build(backend="reference", skip="brick")
    x = volumes("blob", torch.float64)
    expected = reference.project(x[0], A.lines, A.ray_extent, A.detector, A.kernel)
    assert torch.equal(A(x)[0], expected) and A.skipped.mode == "off"
    assert replace(A.skipped, why="") == replace(A.with_support(None).skipped, why="")
