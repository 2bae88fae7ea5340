"""A support is part of the operator and of its adjoint."""

import pytest
import torch

from mvrecon.geometry.cameras.rigs import dome
from mvrecon.geometry.grid import Grid
from mvrecon.testing import gradient_gap, inner_product_gap
from tests.operators.cases import Case
from tests.operators.sparse import CASES, GRID, METHODS, volumes


def support() -> torch.Tensor:
    """A ball, off the centre, that leaves bricks of its box empty."""
    places = torch.meshgrid(
        *[torch.arange(n, dtype=torch.float64) for n in GRID.shape], indexing="ij"
    )
    return sum((p - c).square() for p, c in zip(places, (9, 14, 18), strict=True)) < 8.4**2


@pytest.mark.pairwise(kind=CASES, method=METHODS)
def test_a_support_is_part_of_operator_and_adjoint(kind, method):
    """A_M = A diag(M), A_M^T = diag(M) A^T, exactly adjoint, and the same to the last bit as the
    dense operator's, however what is empty is skipped.
    """
    M, case = support(), CASES[kind]
    dense = case.build(method=method, skip="off")
    skips = ("off", "auto", "box", "brick")
    for dtype, close, some in ((torch.float32, 1e-5, skips), (torch.float64, 1e-12, skips[:2])):
        rng = torch.Generator().manual_seed(2)
        x = torch.randn(1, 2, *GRID.shape, generator=rng, dtype=dtype)
        y = torch.randn(1, 2, len(case.rays), *case.rays.shape, generator=rng, dtype=dtype)
        expected, back = dense(torch.where(M, x, 0)), torch.where(M, dense.T(y), 0)
        for skip in some:
            A = case.build(method=method, skip=skip, support=M)
            views, volume = A(x), A.T(y)
            assert torch.equal(views, expected), skip
            assert torch.equal(volume, back) and volume.abs().max() > 0, skip
            assert inner_product_gap(x, views, y, volume) < close, skip


@pytest.mark.parametrize("method", ["joseph", "siddon", "trilinear:9"])
def test_the_reference_handles_supports(method):
    A, oracle = (
        CASES["dome"].build(method=method, backend=b, support=support())
        for b in ("cpu", "reference")
    )
    x = torch.randn(1, 1, *GRID.shape, dtype=torch.float64)
    y = torch.randn(1, 1, 5, 17, 14, dtype=torch.float64)
    assert torch.allclose(A(x), oracle(x), atol=1e-11) and torch.allclose(
        A.T(y), oracle.T(y), atol=1e-11
    )
    assert oracle.skipped.mode == "off" and A.skipped.mode in ("box", "brick")


def test_values_outside_a_support_have_no_effect():
    x = torch.full((1, 1, *GRID.shape), torch.nan)
    x[0, 0][support()] = 1
    A = CASES["cone"].build(support=support())
    assert A(x).isfinite().all()
    x = torch.rand(1, 1, *GRID.shape, requires_grad=True)
    A(x).sum().backward()
    assert (x.grad != 0).logical_and(~support()).sum() == 0 and x.grad.abs().sum() > 0


def test_gradients_with_a_support_are_exact():
    grid = Grid.centred(size=(11, 10, 9), spacing=3.0)
    mask = torch.zeros(grid.shape, dtype=torch.bool)
    mask[4:6, 3:5, 8] = mask[5, 7, 1] = True
    A = Case(grid, dome(2, 45.0, 30.0, 120.0, {"pixels": [3, 2], "pixel_mm": 20.0})).build(
        support=mask
    )
    x, y = (
        torch.randn(1, 1, *grid.shape, dtype=torch.float64),
        torch.randn(1, 1, 2, 3, 2, dtype=torch.float64),
    )
    places = mask.nonzero().T

    def forward(values):
        return A(x.index_put((torch.tensor([0]), torch.tensor([0]), *places), values))

    others = torch.randn(int((~mask).sum()), dtype=torch.float64)

    def adjoint(values):
        volume = A.T(values)[0, 0]
        return torch.cat([volume[mask], (volume[~mask] @ others)[None]])

    assert gradient_gap(forward, x[0, 0][mask].requires_grad_()) < 1e-6
    assert gradient_gap(adjoint, y.requires_grad_()) < 1e-6
    assert torch.autograd.gradgradcheck(adjoint, y, atol=1e-8)


def test_an_empty_support_gives_zero():
    A = CASES["cone"].build(support=torch.zeros(GRID.shape, dtype=torch.bool))
    y = torch.ones(1, 1, 5, 17, 14)
    assert (
        not A(torch.rand(1, 1, *GRID.shape)).any()
        and not A.T(y).any()
        and A.T(y).shape[2:] == GRID.shape
    )


def test_a_support_can_be_changed_and_follows_the_module():
    A = CASES["cone"].build()
    x = torch.rand(1, 1, *GRID.shape)
    inside = A.with_support(support())
    assert A.support is None and torch.equal(inside(x), A(torch.where(support(), x, 0)))
    assert torch.equal(inside.with_support(None)(x), A(x))
    assert inside.double().support.dtype == torch.bool


def test_compiled_calls_have_supports_too():
    x, inside = volumes("blob"), CASES["cone"].build(support=support())
    assert torch.equal(torch.compile(inside, backend="eager", fullgraph=True)(x), inside(x))
