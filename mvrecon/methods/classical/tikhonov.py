"""Tikhonov regularisation: least squares with a quadratic penalty."""

from collections.abc import Callable
from typing import Any, Literal, Unpack

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.cgls import check_not_negative, conjugate_gradients
from mvrecon.methods.classical.problem import Common, Problem, declares, posed
from mvrecon.methods.classical.total_variation import gradient, gradient_adjoint, voxel_steps
from mvrecon.methods.classical.weighted_fit import WeightedFit
from mvrecon.operators.operator import LinearOperator


@declares(iterates=True)
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

    The data term is twice that of `WeightedFit`. Linear in the views, if it starts at zero and
    tolerance is 0 (Tikhonov, Soviet Math. Dokl. 4, 1963).

    Differentiable in the views, by implicit differentiation: the gradient is that of the minimum,
    at the price of one more reconstruction; as exact as both have converged.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: at most.
        weight: of the gradient, in mm: about the length over which noise is smoothed. Of the
            identity: without unit, and large volumes are damped.
        penalty: D, the "gradient" or the "identity".
        tolerance: a sample is done when the gradient of what is minimised is at most so much of
            what it is at x = 0.
        common: start, support, monitor: see `Common`.

    Raises:
        ValueError: as `posed`; an unknown penalty, a weight or tolerance that is negative; a weight
            of 0 or a start that requires a gradient, where views require one.
    """
    check_not_negative(weight=weight, tolerance=tolerance)
    if penalty not in ("gradient", "identity"):
        raise ValueError(f"Expected the penalty 'gradient' or 'identity', got {penalty!r}")
    steps, support = voxel_steps(A), common.get("support")
    problem = posed(tikhonov, A, views, common)
    fit = WeightedFit.of(problem.A, problem.views.dtype)
    inside = None if support is None else support.to(problem.start)

    def normal(volume: Tensor) -> Tensor:
        if penalty == "identity":
            return weight**2 * volume
        back = weight**2 * gradient_adjoint(gradient(volume, steps), steps)
        return back if inside is None else back * inside

    weights = fit.weights.row / fit.level

    def solve(problem: Problem, pull: Tensor | None = None) -> Tensor:
        if pull is not None and inside is not None:
            pull = pull * inside
        return conjugate_gradients(problem, iterations, tolerance, normal, weights, pull)

    if not (torch.is_grad_enabled() and problem.views.requires_grad):
        with torch.no_grad():
            return solve(problem)
    _check_differentiable(weight, problem.start)
    return _Minimum.apply(problem.views, problem, weights, solve)


def _check_differentiable(weight: float, start: Tensor) -> None:
    if weight == 0 or start.requires_grad:
        raise ValueError(
            "Expected a weight above 0 and a start without gradient where the views require a "
            f"gradient, got a weight of {weight:g}"
        )


class _Minimum(torch.autograd.Function):
    """x = H^-1 A^T W y with H = A^T W A + N, whose derivative is that matrix."""

    @staticmethod
    def forward(
        ctx: Any, views: Tensor, problem: Problem, weights: Tensor, solve: Callable[..., Tensor]
    ) -> Tensor:
        ctx.settings = problem, weights, solve
        return solve(problem._replace(views=views))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        (A, views, start, *_), weights, solve = ctx.settings
        zero = Problem(A, torch.zeros_like(views), torch.zeros_like(start))
        return weights * A(solve(zero, pull)), None, None, None
