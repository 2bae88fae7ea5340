"""Footprints on CUDA devices: the kernels compiled by g++ and run in main memory, against the
reference in float64.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.kernels import self_test
from mvrecon.kernels.cuda.launch import NAMES, Variant, text_of
from mvrecon.testing.measures import inner_product_gap
from mvrecon_spect.kernels import cuda, ops, reference
from mvrecon_spect.operators import footprints
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.response import record_of, response_of
from tests.kernels.cuda.host import (
    compiled,
    layouts,
    reader_of_machine_code,
    stand_in,
)
from tests.kernels.cuda.scenes import difference
from tests.kernels.cuda.waits import Waits

F, D = torch.float32, torch.float64
BOUNDS = {F: 1e-5, D: 1e-12}
VARIANTS = {f"_{NAMES[real]}": Variant(cuda.FOOTPRINTS, real) for real in (F, D)}


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("footprints"), VARIANTS)


@pytest.fixture
def host(libraries, monkeypatch, tmp_path):
    yield from stand_in(monkeypatch, libraries, tmp_path / "kernels", VARIANTS)


def pinhole(towards, way: float, pixels, side: float, length: float, roll: float = 0.0) -> Cameras:
    """A pinhole at a distance from the origin, which it looks at, its detector rolled."""
    axis = torch.nn.functional.normalize(torch.tensor(towards, dtype=D), dim=0)
    level = torch.linalg.cross(axis, axis.roll(1) + torch.tensor([0.3, 0.2, 0.1], dtype=D))
    level, angle = level / level.norm(), math.radians(roll)
    u = math.cos(angle) * level + math.sin(angle) * torch.linalg.cross(axis, level)
    u, v = u * side / pixels, torch.linalg.cross(u, axis) * side / pixels
    source, middle = axis * way, (pixels - 1) / 2
    origin = source + axis * length - middle * (u + v)
    return Cameras(
        *(each[None] for each in (source, origin, u, v)), (pixels, pixels), extent="behind"
    )


def turned(grid: Grid) -> Grid:
    """A grid turned about an oblique axis."""
    affine = grid.affine.clone()
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.5], [-0.2, 0.5, 0]]))
    affine[:3] = turn.double() @ affine[:3]
    return Grid(grid.shape, affine)


def ring(pixels, field: float = 1.0) -> Cameras:
    return dcspect80(pixels=pixels, columns=[0, 5, 11], rows=[0, 2], field=field)


CUBE = Grid.centred(size=(9, 8, 10), spacing=10.0)
SEEING = pinhole([1, 0.2, 0.1], 150.0, 10, 60.0, 70.0)
# the second of three with all of the grid on its detector's side
THREE, AWAY = SEEING[[0, 0, 0]], torch.zeros(3, 3, dtype=D)
AWAY[1] = -2 * SEEING.source[0]
AVERTED = replace(THREE, source=THREE.source + AWAY, origin=THREE.origin + AWAY)
#: Rigs and grids, by name.
FIELDS = {
    "ring": (ring([12, 10], 1.5), Grid.centred(size=(10, 9, 8), spacing=(11.0, 8.0, 9.0))),
    "wide pixels": (ring(8, 2.0), CUBE),
    "fine pixels": (ring(64)[[0, 4]], CUBE),
    "more pixels": (ring(256)[[3]], Grid.centred(5, spacing=12.0)),
    "rolled": (pinhole([-1, 0.4, 0.3], 160.0, 16, 60.0, 70.0, roll=40.0), CUBE),
    "up to 50 degrees": (
        pinhole([1, 0.9, 0.8], 200.0, 12, 200.0, 85.0),
        Grid.centred(12, spacing=25.0),
    ),
    "anisotropic": (ring(16), Grid.centred(size=(20, 7, 4), spacing=(4.0, 10.0, 18.0))),
    "a turned grid": (ring(16), turned(CUBE)),
    "a slice": (ring([6, 9]), Grid.centred(size=(12, 1, 9), spacing=8.0)),
    # the plane of the pinhole cuts the grid, some of whose voxels are near it
    "behind": (
        pinhole([0.3, 1, 0.1], 60.0, 11, 160.0, 50.0),
        Grid.centred(size=(16, 14, 6), spacing=12.0),
    ),
    "a camera that sees nothing": (AVERTED, CUBE),
}
#: Holes and the options of a response.
HOLES = {
    "plain": (Hole(3.0), {"blur": False}),
    "blurred": (Hole([4.0, 5.0]), {"intrinsic_mm": 3.0}),
    "crystal": (
        Hole(4.0, collimator_mu=3.0, acceptance_degrees=23.0),
        {"option": {"angles": True, "crystal_mm": 8.0, "attenuation_per_mm": 0.3}},
    ),
}


def case(name: str, hole: str = "blurred", dtype: torch.dtype = D, attenuated: bool = True):
    """Two volumes, views, and what both operators share: rig, and transmission or None."""
    torch.manual_seed(1)
    (rig, grid), (opening, options) = FIELDS[name], HOLES[hole]
    given = {"option": "geometric", "hole": opening, "cameras": rig, "grid": grid}
    response = response_of(**(given | options))
    x = torch.rand(2, *grid.shape, dtype=dtype) - 0.2
    y = torch.rand(2, len(rig), *rig.shape, dtype=dtype) - 0.2
    passed = torch.rand(len(rig), *grid.shape, dtype=dtype) if attenuated else None
    return x, y, record_of(rig, grid, opening, response), passed


def expected(x: Tensor, y: Tensor, rig: Tensor, passed: Tensor | None) -> tuple[Tensor, Tensor]:
    """Views and volumes by the reference."""
    x, y = x.double(), y.double()
    views = reference.project(x, rig, y.shape[2:], passed)
    return views, ops.FOOTPRINTS.apply_transpose(y, rig, list(x.shape[1:]), passed)


def found(x: Tensor, y: Tensor, rig: Tensor, passed: Tensor | None) -> tuple[Tensor, Tensor]:
    """The same by the kernels."""
    views = cuda.project(x, rig, list(y.shape[2:]), passed)
    return views, cuda.backproject(y, rig, list(x.shape[1:]), passed)


@pytest.mark.pairwise(name=FIELDS, hole=HOLES, dtype=[F, D], attenuated=[True, False])
def test_views_and_volumes_match_the_reference(name, hole, dtype, attenuated, host):
    x, y, rig, passed = case(name, hole, dtype, attenuated)
    views, volumes = found(x, y, rig, passed)
    assert views.dtype == volumes.dtype == dtype
    for result, exact in zip((views, volumes), expected(x, y, rig, passed), strict=True):
        assert difference(result, exact) < BOUNDS[dtype]
    assert inner_product_gap(x, views, y, volumes) < BOUNDS[dtype] / 10


@pytest.mark.parametrize("name", ["ring", "wide pixels", "behind"])
def test_zero_voxels_are_skipped_and_change_nothing(name, host):
    """Empty slabs along each axis, single voxels, and a volume of zeros beside another."""
    x, y, rig, passed = case(name)
    x[:, 2:5], x[:, :, -3:], x[:, :, :, 1] = 0, 0, 0
    x[0] = 0
    x[1] *= torch.rand(x.shape[1:]) < 0.2
    views = cuda.project(x, rig, list(y.shape[2:]), passed)
    assert not views[0].any()
    assert difference(views, expected(x, y, rig, passed)[0]) < 1e-12


def test_a_voxel_or_pixel_that_is_not_finite_shows_where_its_footprint_reaches(host):
    x, y, rig, passed = case("ring")
    single, pixel = torch.zeros_like(x), torch.zeros_like(y)
    single[:, 5, 4, 3], pixel[:, 2, 6, 5] = 1, 1
    views, volumes = found(single, pixel, rig, passed)
    assert (0 < views.count_nonzero()) and (0 < volumes.count_nonzero())
    x[:, 5, 4, 3], y[:, 2, 6, 5] = math.nan, math.inf
    again = found(x, y, rig, passed)
    assert torch.equal(again[0].isnan(), views != 0)
    assert torch.equal(~again[1].isfinite(), volumes != 0)


def test_results_do_not_depend_on_how_work_is_divided(host, monkeypatch):
    """Tables of all pinholes or of one, volumes together or alone: bit for bit. Parts of the slabs
    are summed in another order.
    """
    x, y, rig, passed = case("ring", dtype=F)
    views, volumes = found(x, y, rig, passed)
    assert host.launches.count("footprint_table") == 1
    alone = found(x[1:], y[1:], rig, passed)
    assert torch.equal(views[1:], alone[0]) and torch.equal(volumes[1:], alone[1])
    with monkeypatch.context() as few:
        few.setattr(cuda, "SHARE", 1e-9)
        assert torch.equal(cuda.project(x, rig, list(y.shape[2:]), passed), views)
    assert host.launches.count("footprint_table") == 2 + len(rig)
    monkeypatch.setattr(cuda, "PARTS", 1)
    assert difference(cuda.project(x, rig, list(y.shape[2:]), passed), views) < 1e-6


def test_a_call_launches_few_kernels_without_synchronisation(host):
    x, y, rig, passed = case("ring", dtype=F)
    with Waits() as waits:
        found(x, y, rig, passed)
        views, volumes = found(x[:0], y[:0], rig, passed)
        assert views.shape == (0, *y.shape[1:]) and volumes.shape == (0, *x.shape[1:])
        views, volumes = found(x, y[:, :0], rig[:0], None)
    assert waits.names == []
    assert views.shape == y[:, :0].shape and not volumes.any()
    one = ["footprint_table", "footprint_project", "footprint_backproject"]
    assert host.launches[:3] == one


def test_arguments_lie_where_the_source_has_them(libraries):
    ours, theirs = layouts(cuda.Pinholes, libraries[cuda.Pinholes])
    assert ours == theirs


@pytest.mark.parametrize("dtype", [F, D, torch.bfloat16])
@pytest.mark.parametrize("name", ["project", "backproject"])
def test_footprints_check_themselves(name, dtype, host, monkeypatch):
    tests = footprints.self_test
    assert self_test.failure("cpu", "footprints", dtype, tests) is None
    self_test.forget()
    right = getattr(cuda, name)
    monkeypatch.setattr(cuda, name, lambda *arguments: right(*arguments) * 1.001)
    why = self_test.failure("cpu", "footprints", dtype, tests)
    assert f"{name} differs from the reference" in str(why)


@pytest.mark.parametrize("dtype", [F, D])
def test_kernels_use_only_registers(dtype):
    """No float64 in a loop over voxels or pixels, and no atomic sums."""
    machine_code = reader_of_machine_code()
    count = machine_code.count
    kernels = machine_code.compiled(text_of({"": Variant(cuda.FOOTPRINTS, dtype)}), 90)
    assert kernels.keys() == set(cuda.FOOTPRINTS.names)
    for name, kernel in kernels.items():
        assert not [i for i in kernel.instructions if "ADD" in i and "RED" in i], name
        if dtype == F:
            assert kernel.registers <= 128, (name, kernel.registers)
            assert not count(machine_code.LOCAL, kernel.instructions), name
            for loop in kernel.loops:
                assert not count(machine_code.DOUBLE + "|" + machine_code.CALL, loop), name
