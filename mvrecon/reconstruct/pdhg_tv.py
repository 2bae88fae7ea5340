"""Total variation by the primal-dual hybrid gradient method of Chambolle and Pock."""

from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.differences.choice import differences_for
from mvrecon.kernels.differences.shrinkage import Shrinkage
from mvrecon.projectors.operator import LinearOperator
from mvrecon.reconstruct.cgls import check_not_negative
from mvrecon.reconstruct.problem import Common, Watch, posed
from mvrecon.reconstruct.total_variation import voxel_steps
from mvrecon.reconstruct.weighted_fit import WeightedFit


@torch.no_grad()
def pdhg_tv(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: int = 200,
    weight: float = 1e-5,
    balance: float = 0.1,
    nonnegative: bool = True,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Total variation regularisation, min |y - A x|^2_R / (2 c) + weight sum |D x|, in the unit of
    the volume, by the primal-dual method of Chambolle and Pock.

    The minimum is that of `fista_tv`, where weight and units are explained; there is no inner
    loop. Steps are preconditioned by the sums of the rows and columns of A and D (Pock and
    Chambolle, Int. Conf. Computer Vision, 2011, alpha = 1).

    Args:
        A: the operator.
        views: measured integrals.
        iterations: how many.
        weight: of the total variation, in (unit of the volume) mm; the default is for attenuation
            in 1/mm, densities of about one want 1e-4 to 1e-2.
        balance: of the dual steps to the primal ones; it changes the speed alone.
        nonnegative: only volumes without negative values.
        common: start, support, monitor: see `Common`.

    Raises:
        ValueError: as `posed`; a weight that is negative, a balance that is not positive.
    """
    check_not_negative(weight=weight)
    if not balance > 0:
        raise ValueError(f"Expected a positive balance, got {balance}")
    steps, support = voxel_steps(A), common.get("support")
    A, views, x, monitor = posed(pdhg_tv, A, views, common)
    fit = WeightedFit.of(A, views.dtype)
    # D is scaled so that its column sums are c, as those of A are in the mean
    primal = 1 / (balance * (fit.columns + fit.level))
    if support is not None:
        primal = primal * support.to(primal.device)
    spread = 4 * weight * sum(1 / step for step in steps)
    rate = balance * min(steps) / spread if weight else 0.0
    shrinkage = Shrinkage(weight * fit.level * primal, steps, nonnegative)
    kernels, dual_views, dual = differences_for(x), None, x.new_zeros(3, *x.shape)
    ahead, watch = x, Watch(monitor)
    for number in range(iterations):
        residual = views - A(ahead)
        if watch.ends(number, x, lambda: residual, beta=min(number, 1)):  # noqa: B023
            return watch.result(x)
        pull = fit.weights.row * residual
        dual_views = pull if dual_views is None else dual_views.lerp_(pull, balance / (1 + balance))
        last, x = x, torch.addcmul(x, primal, A.T(dual_views))
        if weight:
            x = kernels.primal(x, kernels.dual_step(ahead, dual, rate, steps), shrinkage)
        elif nonnegative:
            x = x.clamp_min_(0)
        ahead = torch.lerp(last, x, 2)
    watch.ends(iterations, x, lambda: views - A(x))
    return watch.result(x)
