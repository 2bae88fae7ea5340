"""Skipping zeros changes no bit of views and gradients."""

import pytest
import torch

from mvrecon.geometry.grid import Box
from mvrecon.geometry.rigid import random_rotation
from mvrecon.kernels.rays.cpu import plan
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators import ray_transform as integrals
from mvrecon.testing import skip_gap
from tests.operators.cases import Case
from tests.operators.sparse import CASES, GRID, KINDS, METHODS, volumes

pytestmark = pytest.mark.usefixtures("nothing_is_too_little")


@pytest.mark.pairwise(kind=CASES, method=METHODS)
def test_skipping_zeros_changes_no_bit(kind, method):
    case = CASES[kind]
    A = case.build(method=method, skip="off")
    for shape in KINDS:
        for dtype, count in ((torch.float32, 1), (torch.float64, 1), (torch.float32, 5)):
            x = volumes(shape, dtype, count)
            dense = A(x)
            assert A.skipped.mode == "off" and skip_gap(A, x) == 0, (shape, dtype, count)
            assert (
                bool(dense.any())
                or shape not in ("blob", "checkerboard", "full")
                or method == "trilinear:7"
            )


@pytest.mark.parametrize("kind", ["cone", "dome"])
def test_random_rays_agree_to_the_last_bit(kind):
    """Ten thousand and more rays in random poses of the grid."""
    rng = torch.Generator().manual_seed(11)
    for _ in range(6):
        rig = CASES[kind].rays.moved(
            random_rotation(rng) if kind == "dome" else torch.eye(3), torch.rand(3) - 0.5
        )
        case = Case(GRID, rig.refined(2))
        for shape in ("blob", "checkerboard"):
            x = volumes(shape)
            for method in ("joseph", "siddon"):
                assert skip_gap(case.build(method=method), x) == 0


@pytest.mark.parametrize("budget", [1, 4 * 8 * 3000])
@pytest.mark.parametrize("kind", ["cone", "dome"])
def test_pieces_and_threads_change_no_bit_either(kind, budget, monkeypatch):
    monkeypatch.setattr(plan, "BUDGET", budget)
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    case, before = CASES[kind], torch.get_num_threads()
    try:
        for shape in ("blob", "checkerboard"):
            x, found = volumes(shape), []
            for threads in (1, 3):
                torch.set_num_threads(threads)
                found += [case.build(skip=skip)(x) for skip in ("off", "box", "brick")]
            assert all(torch.equal(found[0], other) for other in found[1:])
    finally:
        torch.set_num_threads(before)


@pytest.mark.pairwise(
    kind=["cone", "dome"],
    method=["joseph", "siddon", "trilinear"],
    bad=[torch.nan, torch.inf, -torch.inf, 1e-42, -0.0],
)
def test_nan_is_not_skipped(kind, method, bad):
    for place in ((8, 8, 8), (7, 16, 23), (18, 25, 32)):
        x = volumes("blob")
        x[0, 0][place] = bad
        assert skip_gap(CASES[kind].build(method=method), x) == 0


def test_half_precision_is_inspected_without_conversion():
    for dtype in (torch.float16, torch.bfloat16):
        x = volumes("blob", dtype)
        dense = CASES["cone"].build(skip="off")(x)
        for skip in ("box", "brick", "verify"):
            A = CASES["cone"].build(skip=skip)
            assert torch.equal(A(x), dense) and A.skipped.fractions["voxels"] < 0.1


def test_stale_results_are_never_used():
    """The volume is inspected in every call, so any modification is detected."""
    A, dense = (CASES["cone"].build(skip=skip) for skip in ("brick", "off"))
    x = volumes("blob")
    A(x)
    x[0, 0, 2, 3, 4] = 7  # in place
    assert torch.equal(A(x), dense(x))
    x.data[0, 0, 17, 20, 30] = 5  # past torch's count of versions
    assert torch.equal(A(x), dense(x))
    x.numpy()[0, 0, 1, 24, 2] = 3  # by another library
    assert torch.equal(A(x), dense(x))
    x.zero_()
    x[0, 0, 18, 0, 0] = 1  # another volume at the same address
    assert torch.equal(A(x), dense(x))


def test_verify_finds_a_kernel_that_skips_too_much(monkeypatch):
    A = CASES["cone"].build(skip="verify")
    x = volumes("blob")
    A(x)
    wrong = Occupancy(Box.whole(GRID.shape).high, Box((6, 12, 9), (7, 14, 12))).encoded()
    monkeypatch.setattr(integrals.ops, "occupied", lambda *arguments: wrong)
    with pytest.raises(RuntimeError, match="skip='verify': [0-9]+ of 1190 pixels differ"):
        A(x)


@pytest.mark.parametrize("method", ["joseph", "siddon", "trilinear"])
def test_the_volume_gradient_equals_the_dense_one(method):
    y = None
    found = []
    for skip in ("off", "box", "brick"):
        A = CASES["dome"].build(method=method, skip=skip)
        x = volumes("blob").requires_grad_()
        views = A(x)
        y = torch.randn(views.shape, generator=torch.Generator().manual_seed(1)) if y is None else y
        found.append(torch.autograd.grad(views, x, y)[0])
    assert found[0][0, 0, 0, 0].abs().sum() > 0, "it is not zero where the volume is"
    assert all(torch.equal(found[0], other) for other in found[1:])


@pytest.mark.pairwise(
    1, kind=["cone", "dome", "explicit"], method=["joseph", "siddon", "trilinear"]
)
def test_the_geometry_gradient_equals_the_dense_one(kind, method):
    case, found = CASES[kind], []
    for skip in ("off", "box", "brick"):
        leaves = [vector.clone().requires_grad_() for vector in case.vectors.values()]
        views = case.moved(*leaves).build(method=method, skip=skip)(volumes("blob", torch.float64))
        found.append(torch.autograd.grad(views.square().sum(), leaves))
    for other in found[1:]:
        for one, two in zip(found[0], other, strict=True):
            assert torch.allclose(one, two, rtol=0, atol=1e-12 * one.abs().max().item())


def test_zero_views_are_not_back_projected():
    """Zeros add nothing to the adjoint, so leaving their rays out changes no bit of it."""
    for kind in ("cone", "dome"):
        A = CASES[kind].build()
        y = torch.rand(1, 1, 5, 17, 14)
        y[0, 0, :, 5:, :9] = 0
        y[0, 0, 2] = 0
        whole = sum(A.T(torch.where(torch.arange(5)[:, None, None] == m, y, 0)) for m in range(5))
        assert torch.allclose(A.T(y), whole, rtol=1e-5, atol=1e-5)
        oracle = CASES[kind].build(backend="reference")
        assert torch.allclose(A.T(y.double()), oracle.T(y.double()), atol=1e-11)


def test_compiled_and_mapped_calls_skip_too():
    A = CASES["cone"].build(skip="box")
    x = volumes("blob")
    compiled = torch.compile(A, backend="eager", fullgraph=True)
    assert torch.equal(compiled(x), A(x))
