"""Digits, threads, and what torch thinks of the operators."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mvrecon.cameras.rigs import circular, dome
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.lines import lines_of
from mvrecon.parts import PROJECTORS

DETECTOR = {"pixels": [14, 15], "pixel_mm": 2.1}
GRID = Grid.centred((18, 20, 22), (1.0, 1.1, 0.9))


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("sid", [60.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_far_sources_and_far_worlds_lose_no_digits(offset, sid, backend):
    torch.manual_seed(0)
    shift = torch.full((3,), offset, dtype=torch.float64)
    affine = GRID.affine.clone()
    affine[:3, 3] += shift
    rig = circular(6, sid, sid + 30, DETECTOR, start_degrees=7.0).moved(torch.eye(3), shift)
    x = torch.rand(1, 1, *GRID.shape, dtype=torch.float64)
    A = PROJECTORS.build("drr", grid=Grid(GRID.shape, affine), cameras=rig, backend=backend)
    exact = PROJECTORS.build("drr", grid=GRID, cameras=rig.moved(torch.eye(3), -shift), backend="reference")(x)
    assert (A(x) - exact).norm() < 1e-9 * exact.norm()
    assert (A(x.float()) - exact).norm() < 2e-6 * exact.norm()


def test_scale_changes_nothing_but_the_unit():
    x = torch.rand(1, 1, *GRID.shape, dtype=torch.float64)
    rig = circular(3, 60.0, 90.0, DETECTOR, start_degrees=7.0)
    y = PROJECTORS.build("drr", grid=GRID, cameras=rig)(x)
    for factor in (1e-6, 1e6):
        scaled = replace(rig, **{each: factor * getattr(rig, each) for each in ("source", "origin", "u", "v")})
        affine = torch.diag(torch.tensor([factor] * 3 + [1.0], dtype=torch.float64)) @ GRID.affine
        views = PROJECTORS.build("drr", grid=Grid(GRID.shape, affine), cameras=scaled)(x)
        assert torch.allclose(views / factor, y, rtol=1e-9, atol=1e-9)


@pytest.fixture
def restore_threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_threads_change_no_bit(method, restore_threads, monkeypatch):
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    rig = dome(5, 60.0, 20.0, 120.0, {"pixels": [14, 15], "pixel_mm": 0.8})
    A = PROJECTORS.build("drr", grid=GRID, cameras=rig, method=method, backend="cpu")
    x, y = torch.randn(2, 1, *GRID.shape), torch.randn(2, 1, 5, 14, 15)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append((A(x), A.T(y)))
    assert results[0][1].abs().max() > 1
    for views, volume in results[1:]:
        assert torch.equal(views, results[0][0]) and torch.equal(volume, results[0][1])


@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_torch_accepts_the_operators(method):
    from mvrecon.kernels import ops

    rig = circular(2, 60.0, 90.0, {"pixels": [3, 4], "pixel_mm": 4.0}, start_degrees=7.0)
    grid = Grid.centred((4, 5, 6), 2.0)
    lines = lines_of(rig, grid).requires_grad_()
    x = torch.rand(2, 4, 5, 6, dtype=torch.float64, requires_grad=True)
    y = torch.rand(2, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(ops.project, (x, lines, [0.0, 1.0], [3, 4], method), test_utils=checks)
    torch.library.opcheck(ops.backproject, (y, lines, [0.0, 1.0], [4, 5, 6], method), test_utils=checks)
    torch.library.opcheck(
        ops.lines_vjp, (x.detach(), y.detach(), lines.detach(), [0.0, 1.0], method), test_utils=checks
    )


def test_only_what_is_asked_for_is_differentiated(monkeypatch):
    from mvrecon.kernels import cpu

    monkeypatch.setattr(cpu, "lines_vjp", lambda *_: pytest.fail("no gradient in the pose was asked for"))
    A = PROJECTORS.build("drr", grid=GRID, cameras=circular(2, 60.0, 90.0, DETECTOR), backend="cpu")
    x = torch.rand(1, 1, *GRID.shape, requires_grad=True)
    A.T(A(x)).sum().backward()
    assert x.grad is not None


def test_the_disk_cache_knows_every_source_file():
    """An edit of the ray arithmetic must not leave old machine code in use; numba alone looks at the loops' file."""
    from mvrecon.kernels import compiling, loops

    for loop in (loops.project_rows, loops.backproject_slabs, loops.vary_rows):
        assert loop._cache._cache_file._source_stamp == compiling.SOURCES
    folder = Path(compiling.__file__).parent
    assert compiling.digest(folder) == compiling.SOURCES != compiling.digest(folder.parent)
