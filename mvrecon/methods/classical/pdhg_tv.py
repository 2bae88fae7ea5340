"""Total variation by the primal-dual hybrid gradient method of Chambolle and Pock."""

from typing import NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.division import divided
from mvrecon.core.quantities import NonNegativeInt
from mvrecon.kernels.differences import Shrinkage, differences_for
from mvrecon.methods.classical.cgls import check_not_negative
from mvrecon.methods.classical.problem import (
    Common,
    Iterate,
    Monitor,
    Problem,
    Watch,
    declares,
    posed,
    without_gradient,
)
from mvrecon.methods.classical.stopping import combined
from mvrecon.methods.classical.total_variation import gradient, gradient_adjoint, voxel_steps
from mvrecon.methods.classical.weighted_fit import WeightedFit
from mvrecon.operators.operator import LinearOperator

#: The minimum is sought among values up to so many times the largest of the volume.
REACH = 2.0


class Bound(NamedTuple):
    """A linear function below the data term and the total variation, c times as large.

    Args:
        views: q, a multiplier of the residual views.
        back: A^T q.
        field: p, without unit, vectors of length 1 at most; None without total variation.
    """

    views: Float[Tensor, "b c m v u"]
    back: Float[Tensor, "b c d h w"]
    field: Float[Tensor, "3 b c d h w"] | None


class PenalisedFit(NamedTuple):
    """What is minimised, |y - A x|^2_R / (2 c) + weight sum |D x|, in the square of the unit of the
    volume.

    Args:
        fit: the data term.
        weight: of the total variation, in (unit of the volume) mm.
        steps: voxel size along (z, y, x), in mm.
        nonnegative: only volumes without negative values.
        support: 1 where voxels may be anything but zero; None: everywhere.
    """

    fit: WeightedFit
    weight: float
    steps: tuple[float, float, float]
    nonnegative: bool
    support: Float[Tensor, "d h w"] | None

    def gap(
        self,
        volume: Float[Tensor, "b c d h w"],
        residual: Float[Tensor, "b c m v u"],
        bound: Bound,
    ) -> Float[Tensor, "b c"]:
        """How far the objective is above its minimum at most, relative to the objective.

        The duality gap over volumes of values up to twice the largest one, as a sum of terms of
        which none is negative, so that rounding hides nothing (Chambolle and Pock, J. Math. Imaging
        Vis. 40, 2011, eq. 9, restricted as in their section 3.1). Zero where the objective is.

        Args:
            volume: x.
            residual: y - A x.
            bound: of the method's dual steps.
        """
        row, level = self.fit.weights.row, self.fit.level
        misfit = torch.where(row > 0, residual - bound.views / torch.where(row > 0, row, 1), 0)
        terms, slope = [_sum(row * misfit.square()) / (2 * level)], -bound.back / level
        value = _sum(row * residual.square()) / (2 * level)
        if bound.field is not None:
            change = gradient(volume, self.steps)
            size = torch.linalg.vector_norm(change, dim=0)
            value = value + self.weight * _sum(size)
            terms.append(self.weight * _sum(size - (bound.field * change).sum(dim=0)))
            slope = slope + self.weight * gradient_adjoint(bound.field, self.steps)
        if self.support is not None:
            slope = slope * self.support
        reach = REACH * volume.abs().flatten(2).amax(dim=2)[..., None, None, None]
        lowest = torch.zeros_like(reach) if self.nonnegative else -reach
        terms.append(_sum(slope * (volume - torch.where(slope > 0, lowest, reach))))
        total = torch.stack(terms).sum(dim=0)
        return divided(total, value)


def closed(gap: float) -> Monitor:
    """A monitor that ends each sample whose duality gap is at most so much of its objective.

    Args:
        gap: such as 1e-3.
    """

    def small(iterate: Iterate) -> Tensor | bool:
        return False if iterate.gap is None else (iterate.gap <= gap).all(dim=1)

    return small


def _sum(values: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c"]:
    return values.flatten(2).sum(dim=2, dtype=torch.float64)


#: How far a step is carried on; 1: not at all, from 2 on it need not converge.
RELAXATION = 1.8
#: The gap is computed for every so many iterates, and the last.
EVERY = 10


@declares(iterates=True)
@without_gradient
def pdhg_tv(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 200,
    weight: float = 1e-5,
    balance: float = 0.2,
    nonnegative: bool = True,
    gap: float = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Total variation regularisation, min |y - A x|^2_R / (2 c) + weight sum |D x|, in the unit of
    the volume, by the primal-dual method of Chambolle and Pock.

    The minimum is that of `fista_tv`, where weight and units are explained; there is no inner
    loop. Steps are preconditioned by the sums of the rows and columns of A and D (Pock and
    Chambolle, Int. Conf. Computer Vision, 2011, alpha = 1) and carried on by `RELAXATION` (Condat,
    J. Optim. Theory Appl. 158, 2013, algorithm 3.1).

    No gradient: views that require one are refused.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: at most.
        weight: of the total variation, in (unit of the volume) mm; the default is for attenuation
            in 1/mm, densities of about one want 1e-4 to 1e-2.
        balance: of the dual steps to the primal ones; it changes the speed alone.
        nonnegative: only volumes without negative values.
        gap: a sample is done when its objective is at most so much above the minimum, relative to
            the objective, as the duality gap tells every 10 iterations; 0: never.
        common: start, support, monitor: see `Common`. A monitor sees the gap, too.

    Raises:
        ValueError: as `posed`; a weight or a gap that is negative, a balance that is not positive.
    """
    check_not_negative(weight=weight, gap=gap)
    if not balance > 0:
        raise ValueError(f"Expected a positive balance, got {balance}")
    steps, support = voxel_steps(A), common.get("support")
    problem = posed(pdhg_tv, A, views, common)
    inside = None if support is None else support.to(problem.start)
    fit = WeightedFit.of(problem.A, problem.views.dtype)
    objective = PenalisedFit(fit, weight, steps, nonnegative, inside)
    if gap:
        ends = closed(gap)
        monitor = combined(problem.monitor, ends) if problem.monitor else ends
        problem = problem._replace(monitor=monitor)
    return _descend(problem, objective, balance, iterations)


def _descend(
    problem: Problem, objective: PenalisedFit, balance: float, iterations: int
) -> Float[Tensor, "b c d h w"]:
    A, views, x, monitor, _ = problem
    fit, weight, steps, nonnegative, support = objective
    # D is scaled so that its column sums are c, as those of A are in the mean
    primal = 1 / (balance * (fit.columns + fit.level))
    if support is not None:
        primal = primal * support
    rate = balance * min(steps) / (4 * weight * sum(1 / step for step in steps)) if weight else 0.0
    shrinkage = Shrinkage(weight * fit.level * primal, steps, nonnegative)
    kernels, watch, volume = differences_for(x), Watch(monitor), x
    field = kernels.dual_step(x, x.new_zeros(3, *x.shape), rate, steps) if weight else None
    fresh, residual = field, problem.unexplained()
    multiplier = fit.weights.row * residual * (balance / (1 + balance))
    for number in range(1, iterations + 1):
        back = A.T(multiplier)
        volume = torch.addcmul(x, primal, back)
        if field is not None:
            volume = kernels.primal(volume, field, shrinkage)
        elif nonnegative:
            volume = volume.clamp_min_(0)
        if number == iterations and monitor is None:
            break
        ahead = torch.lerp(x, volume, 2)
        beyond = views - A(ahead)
        rest = (beyond + residual) / 2  # of the volume, by linearity
        gap = None
        if monitor is not None and (number % EVERY == 0 or number == iterations):
            gap = objective.gap(volume, rest, Bound(multiplier, back, fresh))
        if watch.ends(number, volume, lambda: rest, gap=gap):  # noqa: B023
            break
        target = (multiplier + balance * fit.weights.row * beyond) / (1 + balance)
        multiplier = multiplier.lerp(target, RELAXATION)
        x, residual = x.lerp(volume, RELAXATION), residual.lerp(rest, RELAXATION)
        if field is not None:
            fresh = kernels.dual_step(ahead, field.clone(), rate, steps)
            field = field.lerp_(fresh, RELAXATION)
    return watch.result(volume)
