"""Isotropic total variation, its proximal map, and least squares with it as the penalty: by FISTA,
and by the primal-dual hybrid gradient method.

Convention: forward differences, zero behind the last voxel of an axis; an axis of one voxel has
none, so that a volume of one slice has the total variation of an image.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from typing import NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import divided
from mvrecon.core.quantities import NonNegativeInt
from mvrecon.kernels import differences
from mvrecon.methods.classical import solver
from mvrecon.methods.classical.sirt import WeightedFit, proximal_gradient
from mvrecon.methods.classical.stopping import combined
from mvrecon.operators.operator import LinearOperator, Scaled


def voxel_steps(A: LinearOperator) -> tuple[float, float, float]:
    """Voxel size of an operator's grid along (z, y, x), in mm; 1 mm for an operator without a
    grid.
    """
    grid = getattr(A, "grid", None)
    if grid is None:
        return 1.0, 1.0, 1.0
    x, y, z = grid.spacing
    return z, y, x


def total_variation(
    volume: Float[Tensor, "b c d h w"], steps: Sequence[float]
) -> Float[Tensor, "b c"]:
    """The total variation of a volume, sum |D x| over its voxels, in its unit per mm.

    Rudin, Osher and Fatemi, Physica D 60, 1992.

    Args:
        volume: x.
        steps: voxel size along (z, y, x), in mm.
    """
    return (
        torch.linalg.vector_norm(differences.gradient(volume, steps), dim=0).flatten(2).sum(dim=2)
    )


def tv_proximal(
    volume: Float[Tensor, "b c d h w"],
    shrinkage: differences.Shrinkage,
    dual: Float[Tensor, "3 b c d h w"],
    iterations: int,
    rate: float | None = None,
) -> tuple[Float[Tensor, "b c d h w"], Float[Tensor, "3 b c d h w"]]:
    """The proximal map of the total variation, argmin |x - z|^2 / (2 strength) + |D x|, in the unit
    of the volume, and the dual field that it ends with.

    Fast gradient projection on the dual, which may start where the last call ended (Beck and
    Teboulle, IEEE Trans. Image Process. 18, 2009, algorithm 5.1, here in a diagonal metric).

    Args:
        volume: z.
        shrinkage: strength, voxel size and sign.
        dual: the field to begin with, vectors of length 1 at most; it is written over.
        iterations: gradient steps on the dual.
        rate: of `dual_rate`, where it is known already.
    """
    rate = dual_rate(shrinkage) if rate is None else rate
    if rate == 0:
        return (volume.clamp_min(0) if shrinkage.nonnegative else volume), dual
    kernels, last, t, momentum = (
        differences.differences_for(volume),
        torch.zeros_like(dual),
        1.0,
        0.0,
    )
    for _ in range(iterations):
        stride = differences.Stride(rate, momentum)
        dual, last = kernels.proximal_step(volume, dual, last, stride, shrinkage), dual
        t, before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        momentum = (before - 1) / t
    return kernels.primal(volume, dual, shrinkage), dual


def dual_rate(shrinkage: differences.Shrinkage) -> float:
    """The longest stable step on the dual field, in mm by the unit of the volume; 0 where nothing
    is shrunk. A GPU is waited for once.
    """
    strongest = shrinkage.strength.max().item()
    steepest = strongest * sum(4 / step**2 for step in shrinkage.steps)
    return 1 / steepest if steepest else 0.0


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


@solver.declares(iterates=True, differentiable=False)
def fista_tv(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 100,
    weight: float = 1e-5,
    inner: int = 20,
    preconditioned: bool = True,
    nonnegative: bool = True,
    **common: Unpack[solver.Common],
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
        ValueError: as `InverseProblem`; a weight that is negative, less than one inner step.
    """
    solver.check_not_negative(weight=weight)
    if inner < 1:
        raise ValueError(f"Expected at least one inner step, got {inner}")
    steps, problem = voxel_steps(A), solver.InverseProblem.of(A, views, iterations, common)
    fit = WeightedFit.of(problem.A, problem.views.dtype)
    rows = fit.weights.row
    if preconditioned:  # lengths in units of 1 / c
        metric = 1 / (fit.columns / fit.level).clamp_min(FLOOR)
    else:
        norm = power_norm(Scaled(problem.A, pixels=rows[0, 0].sqrt()), dtype=rows.dtype)
        # the power method comes from below: 2 % for what it misses
        metric = rows.new_full((1, 1, 1, 1, 1), fit.level / (1.02 * norm**2))
    if problem.support is not None:
        metric = metric * problem.support
    shrinkage = differences.Shrinkage(weight * metric, steps, nonnegative)
    dual = problem.first.new_zeros(3, *problem.first.shape)
    lengths, rate = metric / fit.level, dual_rate(shrinkage)

    def gradient_step(residual: Tensor) -> Tensor:
        return problem.A.T(rows * residual).mul(lengths)

    def proximal(volume: Tensor) -> Tensor:
        nonlocal dual
        volume, dual = tv_proximal(volume, shrinkage, dual, inner, rate)
        return volume

    return solver.solve(problem, proximal_gradient(problem, gradient_step, proximal, "restarted"))


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
            change = differences.gradient(volume, self.steps)
            size = torch.linalg.vector_norm(change, dim=0)
            value = value + self.weight * _sum(size)
            terms.append(self.weight * _sum(size - (bound.field * change).sum(dim=0)))
            slope = slope + self.weight * differences.gradient_adjoint(bound.field, self.steps)
        if self.support is not None:
            slope = slope * self.support
        reach = REACH * volume.abs().flatten(2).amax(dim=2)[..., None, None, None]
        lowest = torch.zeros_like(reach) if self.nonnegative else -reach
        terms.append(_sum(slope * (volume - torch.where(slope > 0, lowest, reach))))
        total = torch.stack(terms).sum(dim=0)
        return divided(total, value)


def closed(gap: float) -> solver.Monitor:
    """A monitor that ends each sample whose duality gap is at most so much of its objective.

    Args:
        gap: such as 1e-3.
    """

    def small(iterate: solver.Iterate) -> Tensor | bool:
        return False if iterate.gap is None else (iterate.gap <= gap).all(dim=1)

    return small


def _sum(values: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c"]:
    return values.flatten(2).sum(dim=2, dtype=torch.float64)


#: How far a step is carried on; 1: not at all, from 2 on it need not converge.
RELAXATION = 1.8
#: The gap is computed for every so many iterates, and the last.
EVERY = 10


@solver.declares(iterates=True, differentiable=False)
def pdhg_tv(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 200,
    weight: float = 1e-5,
    balance: float = 0.2,
    nonnegative: bool = True,
    gap: float = 0.0,
    **common: Unpack[solver.Common],
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
        ValueError: as `InverseProblem`; a weight or a gap that is negative, a balance that is not
            positive.
    """
    solver.check_not_negative(weight=weight, gap=gap)
    if not balance > 0:
        raise ValueError(f"Expected a positive balance, got {balance}")
    steps, problem = voxel_steps(A), solver.InverseProblem.of(A, views, iterations, common)
    inside = None if problem.support is None else problem.support.to(problem.views)
    fit = WeightedFit.of(problem.A, problem.views.dtype)
    objective = PenalisedFit(fit, weight, steps, nonnegative, inside)
    if gap:
        ends = closed(gap)
        monitor = combined(problem.monitor, ends) if problem.monitor else ends
        problem = replace(problem, monitor=monitor)
    return solver.solve(problem, _primal_dual(problem, objective, balance))


def _primal_dual(
    problem: solver.InverseProblem, objective: PenalisedFit, balance: float
) -> Iterator[solver.Step]:
    A, views, x = problem.A, problem.views, problem.first
    fit, weight, steps, nonnegative, support = objective
    # D is scaled so that its column sums are c, as those of A are in the mean
    primal = 1 / (balance * (fit.columns + fit.level))
    if support is not None:
        primal = primal * support
    rate = balance * min(steps) / (4 * weight * sum(1 / step for step in steps)) if weight else 0.0
    shrinkage = differences.Shrinkage(weight * fit.level * primal, steps, nonnegative)
    kernels = differences.differences_for(x)
    field = kernels.dual_step(x, x.new_zeros(3, *x.shape), rate, steps) if weight else None
    fresh, residual = field, problem.residual(problem.start)
    multiplier = fit.weights.row * residual * (balance / (1 + balance))
    for number in count(1):
        back = A.T(multiplier)
        volume = torch.addcmul(x, primal, back)
        if field is not None:
            volume = kernels.primal(volume, field, shrinkage)
        elif nonnegative:
            volume = volume.clamp_min_(0)
        if problem.monitor is None:  # the last iterate needs no projection
            yield solver.Step(volume)
        ahead = torch.lerp(x, volume, 2)
        beyond = views - A(ahead)
        of_volume = (beyond + residual) / 2  # by linearity
        if problem.monitor is not None:
            gap = None
            if number % EVERY == 0 or number == problem.iterations:
                gap = objective.gap(volume, of_volume, Bound(multiplier, back, fresh))
            yield solver.Step(volume, of_volume, gap)
        target = (multiplier + balance * fit.weights.row * beyond) / (1 + balance)
        multiplier = multiplier.lerp(target, RELAXATION)
        x, residual = x.lerp(volume, RELAXATION), residual.lerp(of_volume, RELAXATION)
        if field is not None:
            fresh = kernels.dual_step(ahead, field.clone(), rate, steps)
            field = field.lerp_(fresh, RELAXATION)
