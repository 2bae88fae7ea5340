"""Total variation by FISTA: SIRT's steps with momentum, each followed by the proximal map."""

from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.cgls import check_not_negative
from mvrecon.methods.classical.iterative import descend
from mvrecon.methods.classical.problem import Common, declares, posed, without_gradient
from mvrecon.methods.classical.total_variation import (
    Shrinkage,
    dual_rate,
    total_variation,
    tv_proximal,
    voxel_steps,
)
from mvrecon.methods.classical.weighted_fit import WeightedFit
from mvrecon.operators.operator import LinearOperator, Scaled


@torch.no_grad()
def power_norm(
    A: LinearOperator, iterations: int = 20, dtype: torch.dtype = torch.float32
) -> float:
    """The operator's norm |A|, its greatest singular value, in the unit of A (mm), by the power
    method.

    From below: the value rises with the iterations. For an operator without negative entries, such
    as a projector, 20 give three digits and more.

    Args:
        A: the operator.
        iterations: products with A^T A.
        dtype: of the computation.
    """
    random = torch.Generator().manual_seed(0)
    x = torch.rand(1, 1, *A.domain_shape, generator=random, dtype=dtype).to(A.device)
    size = torch.zeros((), dtype=dtype)
    for _ in range(iterations):
        x = A.T(A(x / x.norm().clamp_min(torch.finfo(dtype).tiny)))
        size = x.norm()
    return size.sqrt().item()


#: Column sums below this share of their mean count as this share, so that few voxels at the rim of
#: the field of view do not slow down the proximal map of all.
FLOOR = 0.5


@declares(iterates=True)
@without_gradient
def fista_tv(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 100,
    weight: float = 1e-5,
    inner: int = 20,
    preconditioned: bool = True,
    nonnegative: bool = True,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Total variation regularisation, min |y - A x|^2_R / (2 c) + weight sum |D x|, in the unit of
    the volume, by FISTA.

    The data term is that of `WeightedFit`, and D is the gradient per mm. So a weight does not
    depend on the number of views, pixels or voxels; a multiple of the views with the same multiple
    of the weight gives that multiple of the volume. The proximal map starts where the last one
    ended, and the momentum is restarted where a step turns back (Beck and Teboulle, SIAM J. Imaging
    Sci. 2, 2009, and IEEE Trans. Image Process. 18, 2009).

    No gradient: views that require one are refused.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: how many.
        weight: of the total variation, in (unit of the volume) mm; the default is for attenuation
            in 1/mm, densities of about one want 1e-4 to 1e-2.
        inner: gradient steps of each proximal map; with few, such as 5, the objective stays about
            1 % above the minimum, however many iterations there are.
        preconditioned: steps of SIRT's lengths, the inverse column sums; else one length for all
            voxels, the inverse of the squared norm by the power method. The minimum is the same.
        nonnegative: only volumes without negative values.
        common: start, support, monitor: see `Common`.

    Raises:
        ValueError: as `posed`; a weight that is negative, less than one inner step.
    """
    check_not_negative(weight=weight)
    if inner < 1:
        raise ValueError(f"Expected at least one inner step, got {inner}")
    steps, support = voxel_steps(A), common.get("support")
    problem = posed(fista_tv, A, views, common)
    fit = WeightedFit.of(problem.A, problem.views.dtype)
    metric = _metric(problem.A, fit, preconditioned)
    if support is not None:
        metric = metric * support.to(metric.device)
    shrinkage = Shrinkage(weight * metric, steps, nonnegative)
    dual = problem.start.new_zeros(3, *problem.start.shape)
    lengths, rate = metric / fit.level, dual_rate(shrinkage)

    def step(residual: Tensor) -> Tensor:
        return problem.A.T(fit.weights.row * residual).mul(lengths)

    def proximal(volume: Tensor) -> Tensor:
        nonlocal dual
        volume, dual = tv_proximal(volume, shrinkage, dual, inner, rate)
        return volume

    return descend(problem, step, proximal, iterations, "restarted")


@torch.no_grad()
def tv_objective(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    volume: Float[Tensor, "b c d h w"],
    weight: float,
) -> Float[Tensor, "b c"]:
    """What `fista_tv` and `pdhg_tv` minimise, |y - A x|^2_R / (2 c) + weight sum |D x|, in the
    square of the unit of the volume.

    Args:
        A: the operator.
        views: measured integrals.
        volume: x.
        weight: of the total variation, in (unit of the volume) mm.
    """
    fit = WeightedFit.of(A, volume.dtype)
    return fit(views - A(volume)) + weight * total_variation(volume, voxel_steps(A))


def _metric(
    A: LinearOperator, fit: WeightedFit, preconditioned: bool
) -> Float[Tensor, "1 1 #d #h #w"]:
    """Step lengths in units of 1 / c."""
    if preconditioned:
        return 1 / (fit.columns / fit.level).clamp_min(FLOOR)
    rows = fit.weights.row
    norm = power_norm(Scaled(A, pixels=rows[0, 0].sqrt()), dtype=rows.dtype)
    # the power method comes from below: 2 % for what it misses
    return rows.new_full((1, 1, 1, 1, 1), fit.level / (1.02 * norm**2))
