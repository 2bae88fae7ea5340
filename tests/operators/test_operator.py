"""Composed linear operators: adjoints, products, weights, stacks and subsets, compared with their
definitions.
"""

from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.grid import Box
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.sirt import sirt
from mvrecon.operators.operator import Cropped, LinearOperator, Scaled
from mvrecon.operators.selection import RaySelection, ViewSelection
from mvrecon.testing import adjoint_gap
from tests.methods.classical.methods import Matrix
from tests.operators.rigs import CONE, GRID


@pytest.fixture
def A():
    return PROJECTORS.build("drr", grid=GRID, cameras=CONE, backend="reference")


def pair(A: LinearOperator) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    shapes = A.domain_shape, A.range_shape
    x, y = (torch.rand(2, 1, *shape, dtype=torch.float64, generator=rng) for shape in shapes)
    return x, y


def assert_adjoint(A: LinearOperator) -> None:
    x, y = pair(A)
    assert A(x).any() and adjoint_gap(A, x, y) < 1e-12


def test_the_adjoint_is_an_operator_whose_adjoint_is_the_operator(A):
    x, y = pair(A)
    assert A.T.T is A
    assert (A.T.domain_shape, A.T.range_shape) == (A.range_shape, A.domain_shape)
    assert torch.equal(A.T @ y, A.adjoint(y)) and torch.equal(A @ x, A(x))


def test_a_product_is_one_operator_after_the_other(A):
    normal = A.T @ A
    x, _ = pair(A)
    assert torch.equal(normal(x), A.adjoint(A(x)))
    assert_adjoint(normal)
    with pytest.raises(ValueError, match="S's domain to be A's range"):
        A @ A


def test_weights_of_pixels_and_voxels_are_in_operator_and_adjoint(A):
    x, y = pair(A)
    pixels, voxels = torch.rand(A.range_shape).double(), torch.rand(A.domain_shape).double()
    W = Scaled(A, pixels, voxels)
    torch.testing.assert_close(W(x), pixels * A(voxels * x))
    assert_adjoint(W)
    torch.testing.assert_close((3 * A)(x), 3 * A(x))


def test_subsets_of_a_weighted_operator_match_it_at_no_extra_cost(A):
    x, y = pair(A)
    pixels = torch.rand(A.range_shape).double()
    W, mask = Scaled(A, pixels), torch.rand(A.range_shape) < 0.4
    for S in (ViewSelection(A.range_shape, [2, 0]), RaySelection(A.range_shape, mask)):
        part = W.subset(S)
        assert isinstance(part, Scaled) and type(part.A) is type(A.subset(S))
        torch.testing.assert_close(part(x), S(W(x)))
        assert_adjoint(part)
    box, support = Box((1, 0, 2), (4, 5, 6)), torch.rand(A.domain_shape) < 0.5
    crop, whole = W.cropped(box, [1, 3]), torch.zeros_like(x)
    whole[..., *box.slices] = x[..., *box.slices]
    torch.testing.assert_close(crop(x[..., *box.slices]), W(whole)[:, :, [1, 3]])
    torch.testing.assert_close(W.with_support(support)(x), W(x * support))
    assert_adjoint(crop)


def test_weights_that_depend_on_the_cameras_are_recomputed_with_their_graph(A):
    vectors = [
        vector.clone().requires_grad_() for vector in (CONE.source, CONE.origin, CONE.u, CONE.v)
    ]
    moving = replace(CONE, **dict(zip(("source", "origin", "u", "v"), vectors, strict=True)))
    B = PROJECTORS.build("drr", grid=GRID, cameras=moving, backend="reference")
    x, _ = pair(A)
    lengths = Scaled(B, lambda: moving.u.norm(dim=-1)[:, None, None])
    part, weight = lengths.subset(ViewSelection(A.range_shape, [1])), CONE.u[1].norm()
    for _ in range(2):
        (slope,) = torch.autograd.grad(part(x).sum(), vectors[2], retain_graph=True)
        assert slope[1].any() and not slope[0].any()
    torch.testing.assert_close(part(x), weight * A(x)[:, :, [1]])


def test_an_operator_without_subsets_computes_them_from_the_whole(A):
    x, _ = pair(A)
    box = Box((1, 0, 2), (4, 5, 6))
    crop, own = Cropped(A, box, [3, 1]), A.cropped(box, [3, 1])
    assert crop.grid.shape == own.grid.shape == box.shape and len(crop.cameras) == 2
    torch.testing.assert_close(crop(x[..., *box.slices]), own(x[..., *box.slices]))
    assert_adjoint(crop)


def test_the_adjoint_requires_a_pose_gradient_if_the_operator_does(A):
    moving = replace(CONE, u=CONE.u.clone().requires_grad_())
    B = PROJECTORS.build("drr", grid=GRID, cameras=moving, backend="reference")
    assert B.T.pose_gradient and not A.T.pose_gradient


def test_iterative_methods_support_any_operator():
    rng = torch.Generator().manual_seed(0)
    A = Matrix(torch.rand(60, 8, dtype=torch.float64, generator=rng), (2, 2, 2), (3, 4, 5))
    x, _ = pair(A)
    torch.testing.assert_close(sirt(A, A(x), 3000, momentum=True), x, atol=1e-3, rtol=0)
    torch.testing.assert_close(mlem(A, A(x), 3000), x, atol=1e-2, rtol=0)
    assert torch.allclose(mlem(A, A(x), 200, subsets=3), x, atol=5e-2)
