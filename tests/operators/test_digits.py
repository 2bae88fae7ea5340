"""Digits: far sources, far worlds, tiny and huge voxels, single precision, and halves in
storage.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.testing import gap
from tests.operators.cases import CASES, METHODS, OPTIONS, Case, noise

SHAPE, SPACING = (18, 20, 22), (1.0, 1.1, 0.9)
#: Off the centre: a ray along a face is given to one side or the other by its last digit.
DETECTOR = {"pixels": [14, 15], "pixel_mm": 2.1, "offset_mm": [0.31, -0.23]}
TURNED = torch.tensor([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]], dtype=torch.float64)
RIGS = {
    "circular": circular(4, 60.0, 90.0, DETECTOR, start_degrees=7.0),
    "far": circular(4, 1e6, 1e6 + 30, DETECTOR, start_degrees=7.0),
    "dome": dome(4, 60.0, 30.0, 150.0, DETECTOR),
    "far dome": dome(4, 1e6, 1e6 + 30, 150.0, DETECTOR, extent="ahead"),
    "parallel": parallel(4, DETECTOR, 2e6, start_degrees=7.0),
    "tilted": parallel(4, DETECTOR, 90.0, start_degrees=7.0).moved(TURNED, torch.zeros(3)),
}


def elsewhere(rig, offset: float, voxel: float) -> Case:
    """The same picture in other units and at another place."""
    shift = torch.full((3,), offset, dtype=torch.float64)
    scaled = replace(
        rig, **{name: voxel * getattr(rig, name) for name in ("source", "origin", "u", "v")}
    )
    grid = Grid.centred(
        size=SHAPE[::-1], spacing=[voxel * mm for mm in SPACING], centre=shift.tolist()
    )
    return Case(grid, scaled.moved(torch.eye(3), shift))


@pytest.mark.pairwise(kind=RIGS, method=METHODS)
def test_position_and_scale_cost_no_precision(kind, method):
    near = None
    # where a ray passes from cell to cell under a small slope is known to few digits
    exact, single = (1e-9, 5e-6) if method == "siddon" else (1e-11, 2e-6)
    for offset, voxel in ((0.0, 1.0), (1e5, 1.0), (0.0, 1e-6), (0.0, 1e6)):
        case, place = elsewhere(RIGS[kind], offset, voxel), (offset, voxel)
        x, y = (each.abs() for each in noise(case))
        oracle, A = (case.build(method=method, backend=backend) for backend in ("reference", "cpu"))
        views, volume = oracle(x), oracle.T(y)
        assert (views > 5 * voxel).any() and views.isfinite().all(), place
        assert gap(A(x), views) < exact and gap(A.T(y), volume) < exact, place
        assert gap(A(x.float()), views) < 2e-6 and gap(A.T(y.float()), volume) < single, place
        near = views if near is None else near
        assert gap(views / voxel, near) < 1e-7, place


@pytest.mark.pairwise(
    kind=["cone", "stack", "dome", "explicit"],
    option=OPTIONS,
    dtype=[torch.float16, torch.bfloat16],
)
def test_half_precision_is_summed_in_float32(kind, option, dtype, monkeypatch):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    x = noise(case, dtype, channels=2)[0].requires_grad_()
    single = x.detach().float().requires_grad_()
    views, expected = A(x), A(single)
    assert views.dtype == torch.float32 and torch.equal(views, expected)
    one, two = (
        torch.autograd.grad(y.square().sum(), v)[0] for y, v in ((views, x), (expected, single))
    )
    assert one.dtype == dtype and torch.equal(one, two.to(dtype))
    back = A.T(views.detach().to(dtype))
    assert back.dtype == torch.float32 and torch.equal(back, A.T(views.detach().to(dtype).float()))
    monkeypatch.setattr("mvrecon.kernels.rays.cpu.plan.BUDGET", 1)
    assert gap(A(x), expected) < (1e-5 if option == "siddon" else 1e-6)


def test_detectors_much_taller_than_the_volume_lose_no_precision():
    """Its first rows lie many volumes away from the rays that count."""
    n = 32
    rig = circular(3, 100.0, 160.0, {"pixels": [16 * n, 6], "pixel_mm": 1.6}, start_degrees=3.0)
    case = Case(Grid.centred((n, n, n), 1.0), rig)
    x, y = (each.abs() for each in noise(case))
    for method in ("joseph", "siddon"):
        A = case.build(method=method)
        assert gap(A(x.float()), A(x)) < 2e-6 and gap(A.T(y.float()), A.T(y)) < 5e-6
