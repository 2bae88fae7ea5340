"""Each measured law is zero where it holds, and names the size of a violation where it does not."""

import math

import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.drr import Drr
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.selection import ViewSelection
from mvrecon.testing import (
    adjoint_gap,
    batch_gap,
    bits,
    derivative_gap,
    gap,
    gradient_gap,
    homogeneity_gap,
    inner_product_gap,
    linearity_gap,
    motion_gap,
    skip_gap,
    subset_gap,
    support_gap,
)
from mvrecon.testing.measures import noise
from tests.operators.cases import DIFFERENTIABLE
from tests.operators.rigs import CONE, GRID


class Dense(LinearOperator):
    """A matrix, with a transpose of its own."""

    def __init__(self, matrix: torch.Tensor, transpose: torch.Tensor):
        self.matrix, self.transpose = matrix, transpose
        self.range_shape, self.domain_shape = (len(matrix),), (matrix.shape[1],)

    def forward(self, x):
        return x @ self.matrix.mT

    def adjoint(self, y):
        return y @ self.transpose.mT


MATRIX = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
MATCHED = Dense(MATRIX, MATRIX.mT)


def test_a_gap_is_relative_and_infinite_for_nan():
    one = torch.ones(1, 2, 2)
    assert gap(1.5 * one, one) == 0.5 and gap(one, 0 * one) == 2.0
    assert gap(one * math.nan, one) == gap(one, one * math.nan) == math.inf
    with pytest.raises(AssertionError, match=r"expected the shape \(1, 2, 2\), got \(2, 2\)"):
        gap(one[0], one)


def test_bits_counts_differing_values():
    one = torch.tensor([0.0, math.nan, 1.0, 2.0])
    assert bits(one, one.clone()) == 0
    assert bits(one, torch.tensor([-0.0, math.nan, math.nan, 2.5])) == 2


def test_the_adjoint_gap_is_the_error_of_a_wrong_transpose():
    assert adjoint_gap(MATCHED) < 1e-15
    x, y = noise(MATCHED)
    Ax, ATy = MATCHED(x), MATCHED.T(y)
    wrong = Dense(MATRIX, 1.01 * MATRIX.mT)
    expected = 0.01 * (x * ATy).sum().abs() / (Ax.norm() * y.norm())
    assert adjoint_gap(wrong) == pytest.approx(float(expected), rel=1e-9)
    assert inner_product_gap(x, Ax, y, 1.01 * ATy, torch.tensor(2.0)) == pytest.approx(
        float(0.01 * (x * ATy).sum().abs() / 2), rel=1e-9
    )
    assert inner_product_gap(x, Ax, y, ATy * math.nan) == math.inf
    entry = MATRIX.clone()
    entry[2, 1] += 1e-6
    assert adjoint_gap(Dense(MATRIX, entry.mT)) > 1e-8, "one wrong entry"


def test_linearity_and_homogeneity_tell_a_quadratic_and_an_offset():
    x, y = noise(MATCHED)[0], noise(MATCHED, seed=1)[0]
    assert linearity_gap(MATCHED, x, y) < 1e-15 and homogeneity_gap(MATCHED, x) == 0
    assert linearity_gap(lambda x: MATCHED(x) ** 2, x, y) > 0.1
    assert homogeneity_gap(lambda x: x**2, x, factors=(3.0,)) == pytest.approx(2.0)
    offset = homogeneity_gap(lambda x: x + 1, torch.ones(1, 4), factors=(0.5,))
    assert offset == pytest.approx(0.5), "1.5 / 0.5 instead of 2"
    assert homogeneity_gap(lambda a, b: a + b, x, y) < 1e-15
    assert homogeneity_gap(lambda a: a + y, x) > 0.1


def test_a_batch_gap_tells_samples_that_depend_on_each_other():
    x = noise(MATCHED, batch=3)[0]
    assert batch_gap(MATCHED, x) < 1e-15
    assert batch_gap(lambda x: x + x.mean(dim=0), x) > 0.1


class Functions(LinearOperator):
    """Functions as an operator."""

    def __init__(self, A, forward, adjoint):
        self.domain_shape, self.range_shape = A.domain_shape, A.range_shape
        self.forward, self.adjoint = forward, adjoint


class Leaky(Drr):
    """A thousandth of its views are seen past its support."""

    def with_support(self, support):
        inner = super().with_support(support)
        return Functions(inner, lambda x: inner(x) + 1e-3 * self(x), inner.T)


def test_supports_subsets_skipping_and_motions_hold_for_a_projector():
    A = Drr(GRID, CONE)
    x, y = noise(A)
    M = torch.rand(GRID.shape, generator=torch.Generator().manual_seed(0)) < 0.3
    assert support_gap(A, M, x, y) < 1e-14
    assert 1e-4 < support_gap(Leaky(GRID, CONE), M, x, y) < 1e-1
    S, other = (ViewSelection(A.range_shape, views) for views in ([2, 0], [0, 2]))
    assert subset_gap(A, S, x, y) < 1e-14
    swapped = Functions(A, A, A.T)
    swapped.subset = lambda S: other @ A
    assert subset_gap(swapped, S, x, y) > 0.1
    assert skip_gap(A, x) == 0 and A.skip == "auto"
    R, t = random_rotation(torch.Generator().manual_seed(0)), torch.tensor([3.0, -2.0, 1.0])
    assert motion_gap(Drr, GRID, CONE, x, R, t) < 1e-9

    def still(grid: Grid, cameras):
        return Drr(GRID, cameras)

    assert motion_gap(still, GRID, CONE, x, R, t) > 0.1, "a projector that ignores the grid's pose"


def test_a_gradient_gap_finds_one_wrong_entry_of_one_input():
    class Scaled(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, gradient):
            wrong = gradient.clone()
            wrong[..., 0] *= 1 + 1e-4
            return wrong

    x, y = (torch.linspace(a, 2, 7, dtype=torch.float64).requires_grad_() for a in (1.0, 1.5))
    assert gradient_gap(lambda x, y: (x * y).sin(), x, y) < 1e-9
    assert gradient_gap(lambda x, y: Scaled.apply(x) * y, x, y) > 1e-6
    assert gradient_gap(lambda x, y: x * Scaled.apply(y), x, y) > 1e-6


def test_derivatives_of_first_and_second_order_are_operator_and_adjoint():
    A = DIFFERENTIABLE["cone"].build()
    assert derivative_gap(A, *noise(A)) < 1e-12
    wrong = Functions(A, A, lambda y: 1.001 * A.T(y))
    assert derivative_gap(wrong, *noise(A)) == pytest.approx(1e-3, rel=1e-2)
