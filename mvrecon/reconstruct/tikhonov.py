"""Tikhonov regularisation: least squares with a quadratic penalty."""

from typing import Literal, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.projectors.operator import LinearOperator
from mvrecon.reconstruct.cgls import check_not_negative, conjugate_gradients
from mvrecon.reconstruct.problem import Common, posed
from mvrecon.reconstruct.total_variation import gradient, gradient_adjoint, voxel_steps
from mvrecon.reconstruct.weighted_fit import WeightedFit


@torch.no_grad()
def tikhonov(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: int = 50,
    weight: float = 1.0,
    penalty: Literal["gradient", "identity"] = "gradient",
    tolerance: float = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Tikhonov regularisation, min |y - A x|^2_R / c + weight^2 |D x|^2, in the unit of the volume,
    by conjugate gradients.

    The data term is twice that of `WeightedFit`. Linear in the views, if it starts at zero and
    tolerance is 0 (Tikhonov, Soviet Math. Dokl. 4, 1963).

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
        ValueError: as `posed`; an unknown penalty, a weight or tolerance that is negative.
    """
    check_not_negative(weight=weight, tolerance=tolerance)
    if penalty not in ("gradient", "identity"):
        raise ValueError(f"Expected the penalty 'gradient' or 'identity', got {penalty!r}")
    steps, support = voxel_steps(A), common.get("support")
    problem = posed(tikhonov, A, views, common)
    fit = WeightedFit.of(problem.A, problem.views.dtype)

    def normal(volume: Tensor) -> Tensor:
        if penalty == "identity":
            return weight**2 * volume
        back = weight**2 * gradient_adjoint(gradient(volume, steps), steps)
        return back if support is None else back * support.to(back.device)

    weights = fit.weights.row / fit.level
    return conjugate_gradients(problem, iterations, tolerance, normal, weights)
