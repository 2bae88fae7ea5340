"""What the loops cost: which of them walk, memory, and volumes of more than 2^31 voxels."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays import ops, reference
from mvrecon.kernels.rays.cpu import columns, operators as cpu, packed_volume, plan
from mvrecon.kernels.rays.cpu.loops import backproject_slabs, project_rows, scratch_of
from mvrecon.kernels.rays.cpu.trace import Reads, Slabs, Units, rig_of
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon_bench.measure import threads, with_memory
from tests.operators.cases import CASES, OPTIONS, Case, noise

PIXELS = {"pixels": [48, 48], "pixel_mm": 1.5}
ROUND = Case(Grid.centred((48, 48, 48), 1.0), circular(8, 100.0, 150.0, PIXELS, start_degrees=3.0))


@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_rays_are_traversed_only_by_machine_code(method, monkeypatch):
    for name in ("project", "backproject"):
        monkeypatch.setattr(reference, name, lambda *_: pytest.fail("the oracle computes"))
    x, y = noise(ROUND, torch.float32)
    A = ROUND.build(method=method, backend="auto")
    assert A(x).any() and A.T(y).any() and A.last_backend == "cpu"
    loops = columns.project_columns, columns.backproject_columns
    assert all(loop.nopython_signatures for loop in loops)


def test_upright_columns_are_traversed_once_for_all_of_their_rays(monkeypatch):
    """What a ray costs in each slab, its place and its cells' shares, a column of rays costs
    once.
    """
    walked: dict[str, int] = {}

    def counted(name: str, loop):
        def run(store, rig, scratch, reads, views, *part):
            first, last = part[0][-2:] if len(part) == 1 else part  # units, slabs; columns
            walked[name] = walked.get(name, 0) + last - first
            return loop(store, rig, scratch, reads, views, *part)

        return run

    for name in ("project_rows", "project_columns", "backproject_slabs", "backproject_columns"):
        monkeypatch.setattr(cpu, name, counted(name, getattr(cpu, name)))
    x, y = noise(ROUND)
    A, slabs = ROUND.build(), 48
    with threads(1):
        results = A(x), A.T(y)
        # of 8 views, 48 columns of rays each; back, 48 slabs for each of the two main axes of a
        # circle
        assert walked == {"project_columns": 8 * 48, "backproject_columns": 2 * slabs}
        walked.clear()
        monkeypatch.setattr(plan, "kept_plan", plan.plan_by_content)
        monkeypatch.setattr(plan, "columnar", lambda rig: columns.columnar(rig) & False)
        for one, other in zip((A(x), A.T(y)), results, strict=True):
            assert (one - other).norm() < 1e-12 * other.norm()
        assert walked.keys() == {"project_rows", "backproject_slabs"}


#: MiB of a volume of 192^3 in float32.
COPY = 27
MEMORY = {
    "circular": circular(
        3, 400.0, 600.0, {"pixels": [100, 40], "pixel_mm": 3.0}, start_degrees=3.0
    ),
    "dome": dome(3, 400.0, 600.0, 150.0, {"pixels": [40, 40], "pixel_mm": 6.0}, extent="ahead"),
    "parallel": parallel(3, {"pixels": [100, 40], "pixel_mm": 3.0}, 600.0, start_degrees=3.0),
}


def checked(call, limit):
    """What a call returns, if one of up to three needs less MB than `limit` says of the result:
    what else the process does only adds.
    """
    for _ in range(3):
        result, needed = with_memory(call, "cpu")
        if needed < limit(result):
            return result
    pytest.fail(f"expected less than {limit(result):.1f} MB, got {needed:.1f} MB")


def with_copy(result):
    """MB of a result, and of a copy of the volume."""
    return result.nbytes / 2**20 + COPY


@pytest.mark.slow  # all together
@pytest.mark.skipif(sys.platform != "linux", reason="the high-water mark cannot be reset")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
@pytest.mark.parametrize("kind", MEMORY)
def test_little_memory_is_used_beyond_input_and_output(kind, dtype):
    """Less than a copy of the volume in float32, which is 27 MiB."""
    n = 192
    case, small = (Case(Grid.centred((size, size, size), 1.0), MEMORY[kind]) for size in (n, 16))
    for method in ("joseph", "siddon"):
        A, warm = case.build(method=method), small.build(method=method)
        little = torch.rand(1, 16, 16, 16).to(dtype)
        ops.lines_vjp(
            little, warm(little[None])[0], warm.lines, warm.ray_extent, warm.kernel
        )  # compiles
        x = torch.rand(1, 1, n, n, n).to(dtype)
        views = checked(lambda A=A, x=x: A(x), with_copy)
        checked(lambda A=A, views=views: A.T(views), with_copy)
        arguments = (x[:, 0], views[:, 0], A.lines, A.ray_extent, A.kernel)
        checked(lambda arguments=arguments: ops.lines_vjp(*arguments), lambda _: COPY)


#: Loops for these indices are compiled by no warm-up: half a minute of a processor for each.
WIDE = [("cone", "joseph"), ("dome", "siddon"), ("explicit", "trilinear"), ("cone", "samples")]


@pytest.mark.parametrize(
    ("kind", "option", "derivative"),
    [
        ("dome", "joseph", False),
        *(pytest.param(*case, True, marks=pytest.mark.long) for case in WIDE),
    ],
)
def test_wide_indices_change_no_bit(kind, option, derivative, monkeypatch):
    case = CASES[kind]
    x, y = (each[:, 0] for each in noise(case, torch.float32))
    A = case.build(**OPTIONS[option])
    y = y.reshape(2, len(A.lines), *A.detector)

    def results() -> list[torch.Tensor]:
        found = [
            ops.project(x, A.lines, A.ray_extent, A.detector, A.kernel),
            ops.backproject(y, A.lines, A.ray_extent, list(case.grid.shape), A.kernel),
        ]
        if derivative:
            found.append(ops.lines_vjp(x, y, A.lines, A.ray_extent, A.kernel))
        return found

    narrow = results()

    def wide(volumes, near):
        narrow = packed_volume.store_of(volumes, near)
        assert narrow.strides.dtype == np.int32
        return narrow._replace(strides=narrow.strides.astype(np.int64))

    monkeypatch.setattr(cpu, "store_of", wide)
    assert all(torch.equal(one, other) for one, other in zip(results(), narrow, strict=True))


@pytest.mark.skipif(sys.platform != "linux", reason="needs files with holes")
@pytest.mark.parametrize(
    "method",
    [
        "joseph",
        *(pytest.param(name, marks=pytest.mark.long) for name in ("siddon", "trilinear:82")),
    ],
)
def test_more_than_2_to_the_31_voxels(method, tmp_path):
    """One ray along the last row of an 8 GB volume in a sparse file."""
    grid = Grid.centred(size=(40, 7200, 7000), spacing=1.0)
    rig = parallel(1, {"pixels": [1, 1], "pixel_mm": 1.0}, 60.0).moved(
        torch.eye(3), torch.tensor([0, 3599.5, 3499.5])
    )
    A = Case(grid, rig).build()
    rays = rig_of(A.lines, A.ray_extent, Occupancy.whole(grid.shape), [1, 1], method)
    file = np.memmap(tmp_path / "holes", np.float32, "w+", shape=(1, 7204, 44, 7004, 1))
    padded = file.view(np.ndarray)
    volume = packed_volume.store_of(padded, near=2)
    assert volume.size > 2**31 and volume.strides.dtype == np.int64
    reads = Reads(np.arange(1), np.zeros(1, bool), np.array([[[0, 1]]], np.int32))
    units, slabs = Units((True, False, False), 0, 1), Slabs(0, (True, False, False), 0, 40)
    last = slice(0, 40), slice(7199, 7200), slice(6999, 7000)
    row = packed_volume.part_of(padded, 2, last)[0, 0, :, 0, 0]
    row[:] = np.arange(40)
    views = np.zeros((1, 1, 1, 1), np.float32)
    project_rows(volume, rays, scratch_of(rays, volume), reads, views, units)
    assert views.item() == pytest.approx(row.sum(), rel=1e-5)
    row[:] = 0
    twos = np.full_like(views, 2)
    backproject_slabs(volume, rays, scratch_of(rays, volume), reads, twos, slabs)
    assert np.allclose(row, 2, rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_gradients_are_computed_across_threads(dtype, monkeypatch):
    """Grad mode is per thread: tensors of pool threads must not require a graph."""
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    with threads(3):
        rig = circular(3, 40.0, 70.0, {"pixels": [9, 10], "pixel_mm": 2.0}, start_degrees=13)
        source = rig.source.clone().requires_grad_()
        A = PROJECTORS.build(
            "drr",
            grid=Grid.centred(size=(11, 10, 9), spacing=1.0),
            cameras=replace(rig, source=source),
        )
        x = torch.rand(1, 1, 9, 10, 11).to(dtype).requires_grad_()
        views = A(x)
        by_x, by_source = torch.autograd.grad(views.sum(), (x, source))
        assert (
            torch.equal(by_x, A.T(torch.ones_like(views)).detach().to(dtype))
            and by_source.abs().max() > 0
        )
