"""Least squares by conjugate gradients: CGLS, and Tikhonov regularisation."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Literal, Unpack

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mvrecon.core.quantities import NonNegativeInt
from mvrecon.kernels.differences import gradient, gradient_adjoint
from mvrecon.methods.classical import solver
from mvrecon.methods.classical.sirt import WeightedFit
from mvrecon.methods.classical.solver import Common
from mvrecon.methods.classical.total_variation import voxel_steps
from mvrecon.operators.operator import LinearOperator

#: N x of a penalty <x, N x>, for a volume x.
Penalty = Callable[[Tensor], Tensor]


def conjugate_gradients(
    problem: solver.InverseProblem,
    tolerance: float,
    penalty: Penalty | None = None,
    weights: Float[Tensor, "#b #c m v u"] | None = None,
    pull: Float[Tensor, "b c d h w"] | None = None,
) -> Float[Tensor, "b c d h w"]:
    """Minimise |y - A x|^2_W + <x, N x> - 2 <g, x> for each sample, by conjugate gradients.

    A GPU is synchronised once an iteration only with a tolerance or a monitor; else all iterations
    run, and converged samples stay unchanged.

    Linear: a common power of two is divided out, which keeps squares within the range of float32.

    Args:
        problem: operator, views, start.
        tolerance: stop a sample when its gradient relative to |A^T W y|, and without a penalty its
            residual relative to |y|, is this small.
        penalty: N x.
        weights: W of the views; None: one.
        pull: g; None: zero.
    """
    scale = solver.power_of_two(problem.views, problem.start, pull)
    pull = None if pull is None else pull / scale
    steps = _conjugate_gradients(problem.divided(scale), tolerance, penalty, weights, pull)
    return solver.solve(problem, steps, scale)


def _conjugate_gradients(
    problem: solver.InverseProblem,
    tolerance: float,
    penalty: Penalty | None,
    weights: Float[Tensor, "#b #c m v u"] | None,
    pull: Float[Tensor, "b c d h w"] | None,
) -> Iterator[solver.Step]:
    A, views, x = problem.A, problem.views, problem.first
    asked = views.is_cpu or tolerance > 0 or problem.monitor is not None
    root = None if weights is None else weights.sqrt()

    def gradient(residual: Tensor, volume: Tensor | None) -> Tensor:
        back = A.T(residual if weights is None else weights * residual)
        back = back if pull is None else back + pull
        return back if penalty is None or volume is None else back - penalty(volume)

    r = problem.residual(problem.start)
    s = gradient(r, x)
    floor = max(tolerance, torch.finfo(views.dtype).eps)
    goal = floor * (norms(gradient(views, None)) if problem.start is not None else norms(s))
    # with a penalty a zero residual is not the minimum
    enough = floor * norms(views) if penalty is None else torch.full_like(goal, -1)
    p, size = s, norms(s)
    while True:
        # non-finite samples never end, so that the volume shows them
        active = ~((size <= goal) | (norms(r) <= enough))
        if asked and not active.any():
            return
        q = A(p)
        curvature = norms(q if root is None else root * q).square()
        if penalty is not None:
            curvature = curvature + _products(p, penalty(p))
        # <s, p> equals |s|^2 up to rounding, and makes every step a descent
        moves = active & ~(curvature <= 0)
        step = torch.where(moves, _products(s, p) / torch.where(moves, curvature, 1), 0)
        x, r = torch.addcmul(x, step, p), torch.addcmul(r, step, q, value=-1)
        yield solver.Step(x, r)
        s, last = gradient(r, x), size
        size = norms(s)
        ratio = torch.where(active, (size / torch.where(active, last, 1)).square(), 0)
        p = torch.addcmul(s, ratio, p)


def _products(one: Float[Tensor, "b c *n"], other: Float[Tensor, "b c *n"]) -> Tensor:
    return (one * other).flatten(2).sum(dim=2)[..., None, None, None]


def norms(tensor: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c 1 1 1"]:
    """The 2-norm of each sample's volume or views."""
    return torch.linalg.vector_norm(tensor.flatten(2), dim=2)[..., None, None, None]


@solver.declares(iterates=True, differentiable=False)
def cgls(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 20,
    damping: float = 0.0,
    tolerance: float = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Conjugate gradients for least squares, min |y - A x|^2 + damping^2 |x|^2, in the unit of the
    volume.

    Each iterate has the least residual of all methods with as many products with A and A^T
    (Hestenes and Stiefel, 1952; CGLS as in Bjorck, Numerical Methods for Least Squares Problems,
    1996, 7.4). The iterates equal those of LSQR. With noise, stopping early regularises. Linear in
    the views for start zero and tolerance 0.

    Not differentiable: raises if views require a gradient.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: maximum number of iterations.
        damping: weight of |x|, in the unit of A, mm; 0: none.
        tolerance: stop a sample at |A^T r| <= tolerance |A^T y| or, without damping, |r| <=
            tolerance |y|; at least the rounding error.
        common: start, support, monitor: see `Common`.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `InverseProblem`; a negative damping or tolerance.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> volume = mv.cgls(A, A(x), iterations=20)
        >>> bool((A(volume) - A(x)).norm() < 0.01 * A(x).norm())
        True
    """
    solver.check_not_negative(damping=damping, tolerance=tolerance)
    problem = solver.InverseProblem.of(A, views, iterations, common)
    penalty = (lambda x: damping**2 * x) if damping else None
    return conjugate_gradients(problem, tolerance, penalty)


@solver.declares(iterates=True)
def tikhonov(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 50,
    weight: float = 1.0,
    penalty: Literal["gradient", "identity"] = "gradient",
    tolerance: float = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Tikhonov regularisation, min |y - A x|^2_R / c + weight^2 |D x|^2, in the unit of the volume,
    by conjugate gradients.

    The data term is twice that of `WeightedFit`. Linear in the views for start zero and tolerance 0
    (Tikhonov, Soviet Math. Dokl. 4, 1963).

    Differentiable in the views by implicit differentiation, which takes one more reconstruction;
    the gradient is that of the minimum, as exact as both have converged.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: maximum number of iterations.
        weight: weight of the gradient, in mm: about the length over which noise is smoothed. That
            of the identity has no unit.
        penalty: D, the "gradient" or the "identity".
        tolerance: stop a sample when the objective's gradient relative to that at x = 0 is this
            small.
        common: start, support, monitor: see `Common`.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `InverseProblem`; an unknown penalty, a negative weight or tolerance; a
            weight of 0 or a start that requires a gradient, if views require one.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> sharp, smooth = (mv.tikhonov(A, A(x), 20, weight=mm) for mm in (0.1, 10.0))
        >>> bool(smooth.diff().norm() < sharp.diff().norm())
        True
    """
    solver.check_not_negative(weight=weight, tolerance=tolerance)
    if penalty not in ("gradient", "identity"):
        raise ValueError(f"Expected the penalty 'gradient' or 'identity', got {penalty!r}")
    steps, problem = voxel_steps(A), solver.InverseProblem.of(A, views, iterations, common)
    fit = WeightedFit.of(problem.A, problem.views.dtype)
    inside = None if problem.support is None else problem.support.to(problem.views)

    def normal(volume: Tensor) -> Tensor:
        if penalty == "identity":
            return weight**2 * volume
        back = weight**2 * gradient_adjoint(gradient(volume, steps), steps)
        return back if inside is None else back * inside

    weights = fit.weights.row / fit.level

    def minimum(problem: solver.InverseProblem, pull: Tensor | None = None) -> Tensor:
        if pull is not None and inside is not None:
            pull = pull * inside
        return conjugate_gradients(problem, tolerance, normal, weights, pull)

    if not (torch.is_grad_enabled() and problem.views.requires_grad):
        with torch.no_grad():
            return minimum(problem)
    if weight == 0 or (problem.start is not None and problem.start.requires_grad):
        raise ValueError(
            "Expected a weight above 0 and a start without gradient where the views require a "
            f"gradient, got a weight of {weight:g}"
        )
    return _Minimum.apply(problem.views, problem, weights, minimum)


class _Minimum(torch.autograd.Function):
    """x = H^-1 A^T W y with H = A^T W A + N, with its derivative by the same matrix."""

    @staticmethod
    def forward(
        ctx: Any,
        views: Tensor,
        problem: solver.InverseProblem,
        weights: Tensor,
        minimum: Callable[..., Tensor],
    ) -> Tensor:
        ctx.settings = problem, weights, minimum
        return minimum(replace(problem, views=views))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        problem, weights, minimum = ctx.settings
        zero = torch.zeros_like(problem.views)
        change = minimum(replace(problem, views=zero, start=None, monitor=None), pull)
        return weights * problem.A(change), None, None, None
