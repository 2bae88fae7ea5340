"""The compiled loops against the oracle, and one way through them against the other."""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.cpu import columns, plan
from mvrecon.kernels.rays.cpu.trace import rig_of
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.testing import adjoint_gap, gap
from tests.operators.cases import CASES, OPTIONS, UPRIGHT, Case, noise

#: Relative errors in float32. Siddon: where a ray passes from cell to cell under a small slope is
#: known to few digits.
SINGLE = {option: 5e-6 if option == "siddon" else 2e-6 for option in OPTIONS}


@pytest.fixture
def oblique(monkeypatch):
    """Sends every view through the loops for any ray."""

    def send() -> None:
        monkeypatch.setattr(plan, "kept_plan", plan.plan_by_content)
        monkeypatch.setattr(plan, "columnar", lambda rig: columns.columnar(rig) & False)

    return send


def test_the_upright_cases_are_upright():
    for kind, case in CASES.items():
        A = case.build()
        rig = rig_of(A.lines, A.ray_extent, Occupancy.whole(case.grid.shape), A.detector, "joseph")
        assert columns.columnar(rig).tolist() == [case.upright] * len(A.lines), kind


@pytest.mark.pairwise(kind=CASES, option=OPTIONS)
def test_the_loops_match_the_reference(kind, option):
    case: Case = CASES[kind]
    x, y = noise(case)
    oracle, compiled = (
        case.build(backend=backend, **OPTIONS[option]) for backend in ("reference", "cpu")
    )
    views, volume = oracle(x), oracle.T(y)
    assert compiled.last_backend is None and views.abs().max() > 1 and volume.abs().max() > 1
    assert gap(compiled(x), views) < 1e-12 and gap(compiled.T(y), volume) < 1e-12
    x, y = x.abs(), y.abs()
    views, volume = oracle(x), oracle.T(y)
    assert gap(compiled(x.float()), views) < SINGLE[option]
    assert gap(compiled.T(y.float()), volume) < SINGLE[option]
    assert compiled.last_backend == "cpu"


@pytest.mark.pairwise(1, kind=CASES, option=OPTIONS)
def test_the_adjoint_is_the_transpose(kind, option):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        x, y = noise(case, dtype, channels=2)
        assert A(x).dtype == A.T(y).dtype == dtype
        assert adjoint_gap(A, x, y) < tolerance


@pytest.mark.pairwise(2, kind=UPRIGHT, method=["joseph", "siddon"])
def test_upright_columns_equal_individual_rays(kind, method, oblique):
    A = UPRIGHT[kind].build(method=method)
    x, y = noise(UPRIGHT[kind], channels=2)
    single = x.abs().float(), y.abs().float()
    results = []
    for _ in range(2):
        results.append((A(x), A.T(y), A(single[0]), A.T(single[1])))
        oblique()
    gaps = [gap(one, other) for one, other in zip(*results, strict=True)]
    assert max(gaps[:2]) < 1e-13 and max(gaps[2:]) < SINGLE[method]


@pytest.mark.pairwise(3, kind=CASES, option=OPTIONS)
def test_pieces_of_the_volume_add_up(kind, option, monkeypatch):
    """A volume read in pieces of eight rows, the fewest, and in pieces of half its rows or so."""
    grid = CASES[kind].grid
    d, h, w = grid.shape
    case = replace(CASES[kind], grid=Grid((d, 3 * h + 8, w), grid.affine))
    x, y = noise(case, channels=2)
    A = case.build(**OPTIONS[option])
    whole = A(x), A.T(y)
    for budget in (1, 4 * 8 * (whole[1][:1, :1].numel() + 300) // 2):
        monkeypatch.setattr(plan, "BUDGET", budget)
        held = Occupancy.whole(case.grid.shape)
        rig = rig_of(A.lines, A.ray_extent, held, A.detector, A.kernel)
        parts = plan.parts_of(A.kernel, held.shape, 4 * 8)
        assert len(list(plan.pieces(rig, held, parts))) > 1 or "trilinear" in A.kernel
        assert gap(A(x), whole[0]) < 1e-12 and gap(A.T(y), whole[1]) < 1e-12


@pytest.mark.pairwise(4, kind=["cone", "stack", "dome", "explicit"], option=OPTIONS)
def test_threads_change_no_bit(kind, option, monkeypatch, threads):
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    case, results = CASES[kind], []
    x, y = noise(case, torch.float32)
    for count in (1, 2, 3):
        threads(count)
        moving = case.moved(*[vector.clone().requires_grad_() for vector in case.vectors.values()])
        A = moving.build(**OPTIONS[option])
        views = A(x)
        change = torch.autograd.grad((views * y).sum(), list(moving.vectors.values()))
        results.append((views, A.T(y), *change))
    assert all(result.abs().max() > 0 for result in results[0])
    for others in results[1:]:
        assert all(torch.equal(one, other) for one, other in zip(results[0], others, strict=True))


@pytest.mark.pairwise(
    shape=[(1, 1, 1), (1, 5, 6), (9, 1, 6), (9, 5, 1), (1, 1, 6), (1, 5, 1), (9, 1, 1)],
    kind=["cone", "stack", "dome"],
    option=OPTIONS,
)
def test_axes_of_one_voxel(shape, kind, option):
    case = CASES[kind]
    grid = type(case.grid).centred(
        size=shape[::-1], spacing=case.grid.spacing, centre=case.grid.centre.tolist()
    )
    case = Case(grid, case.rays)
    x, y = noise(case)
    oracle, compiled = (
        case.build(backend=backend, **OPTIONS[option]) for backend in ("reference", "cpu")
    )
    # so few samples may all miss a single voxel
    if option != "samples":
        assert oracle(x).abs().max() > 0.1
    assert (compiled(x) - oracle(x)).norm() < 1e-12 * (1 + oracle(x).norm())
    assert (compiled.T(y) - oracle.T(y)).norm() < 1e-12 * (1 + oracle.T(y).norm())
