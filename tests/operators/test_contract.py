"""Every registered projector, in every back end, over rigs of every kind."""

from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.testing import check_projector
from tests.operators.rigs import GRID, RIGS

METHODS = ("joseph", "siddon")
BACKENDS = ("reference", "cpu")


@pytest.mark.pairwise(kind=RIGS, method=METHODS, backend=BACKENDS)
def test_a_projector_keeps_the_contract(kind, method, backend):
    name, rig = RIGS[kind]
    # derivatives along an axis-aligned view stand on the kinks between voxels, where differences
    # mean nothing
    check_projector(name, GRID, rig, gradients=False, method=method, backend=backend)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["cone", "parallel"])
def test_gradients_equal_finite_differences(kind, method):
    """Those of the compiled back end; the reference's are the same, as is shown below. For pinholes
    and sources in the volume test_gradients.py takes differences.
    """
    name, rig = RIGS[kind]
    grid = replace(GRID, shape=(3, 4, 3))
    check_projector(name, grid, replace(rig[:2], shape=(3, 3)), method=method, backend="cpu")


@pytest.mark.pairwise(kind=RIGS, method=METHODS, dtype=[torch.float32, torch.float64])
def test_both_back_ends_agree(kind, method, dtype):
    name, rig = RIGS[kind]
    oracle, compiled = (
        PROJECTORS.build(name, grid=GRID, cameras=rig, method=method, backend=b) for b in BACKENDS
    )
    x = torch.rand(2, 2, *GRID.shape, dtype=dtype)
    y = oracle(x)
    # in float32 a crossing under a small slope is known to fewer digits than the slope
    tolerance = 1e-13 if dtype == torch.float64 else 5e-6
    assert y.abs().max() > 1
    assert (compiled(x) - y).norm() < tolerance * y.norm()
    assert (compiled.T(y) - oracle.T(y)).norm() < tolerance * oracle.T(y).norm()


@pytest.mark.pairwise(kind=["cone", "pinholes", "inside", "parallel"], method=METHODS)
def test_gradients_of_both_back_ends_agree(kind, method):
    """In the values and in the pose, at a size that differences could not afford, also through the
    adjoint.
    """
    name, rig = RIGS[kind]
    x, y = (
        torch.rand(1, 2, *shape, dtype=torch.float64, requires_grad=True)
        for shape in (GRID.shape, (len(rig), *rig.shape))
    )
    found = []
    for backend in BACKENDS:
        vectors = [
            getattr(rig, each).clone().requires_grad_() for each in ("source", "origin", "u", "v")
        ]
        moving = replace(rig, **dict(zip(("source", "origin", "u", "v"), vectors, strict=True)))
        A = PROJECTORS.build(name, grid=GRID, cameras=moving, method=method, backend=backend)
        found.append(torch.autograd.grad((A(x) * y).sum(), [*vectors, x, y]))
        found.append(torch.autograd.grad((A.T(y) * x).sum(), [*vectors, x, y]))
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert (a - b).norm() < 1e-11 * a.norm()
