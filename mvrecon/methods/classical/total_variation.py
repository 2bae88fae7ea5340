"""Isotropic total variation, its proximal map, and TV-regularised least squares by FISTA and by the
primal-dual hybrid gradient method.

Convention: forward differences, zero at the last voxel of an axis and along an axis of one voxel,
so that one slice has the total variation of an image.
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
from mvrecon.methods.classical.solver import Common
from mvrecon.methods.classical.stopping import combined
from mvrecon.operators.operator import LinearOperator, Scaled


def voxel_steps(A: LinearOperator) -> tuple[float, float, float]:
    """Voxel size of an operator's grid along (z, y, x), in mm; 1 mm without a grid."""
    grid = getattr(A, "grid", None)
    if grid is None:
        return 1.0, 1.0, 1.0
    x, y, z = grid.spacing
    return z, y, x


def total_variation(
    volume: Float[Tensor, "b c d h w"], steps: Sequence[float]
) -> Float[Tensor, "b c"]:
    """Return the total variation of a volume, sum |D x| over its voxels, in its unit per mm.

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
    of the volume, and the final dual field.

    Fast gradient projection on the dual, which may be warm-started (Beck and Teboulle, IEEE Trans.
    Image Process. 18, 2009, algorithm 5.1, here in a diagonal metric).

    Args:
        volume: z.
        shrinkage: strength, voxel size and sign.
        dual: the initial field, vectors of length at most 1; overwritten.
        iterations: gradient steps on the dual.
        rate: step length on the dual, `dual_rate`, if already computed.
    """
    rate = dual_rate(shrinkage) if rate is None else rate
    if rate == 0:
        return (volume.clamp_min(0) if shrinkage.nonnegative else volume), dual
    kernels, last = differences.differences_for(volume), torch.zeros_like(dual)
    t, momentum = 1.0, 0.0
    for _ in range(iterations):
        stride = differences.Stride(rate, momentum)
        dual, last = kernels.proximal_step(volume, dual, last, stride, shrinkage), dual
        t, before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        momentum = (before - 1) / t
    return kernels.primal(volume, dual, shrinkage), dual


def dual_rate(shrinkage: differences.Shrinkage) -> float:
    """The longest stable step on the dual field, in mm by the unit of the volume; 0 for zero
    strength. Synchronises with a GPU once.
    """
    strongest = shrinkage.strength.max().item()
    steepest = strongest * sum(4 / step**2 for step in shrinkage.steps)
    return 1 / steepest if steepest else 0.0


@torch.no_grad()
def power_norm(
    A: LinearOperator, iterations: int = 20, dtype: torch.dtype = torch.float32
) -> float:
    """Estimate the operator's norm |A|, its greatest singular value, in the unit of A (mm), by the
    power method.

    The estimate increases with the iterations towards the norm. For an operator without negative
    entries, such as a projector, 20 iterations give at least three digits.

    Args:
        A: the operator.
        iterations: products with A^T A.
        dtype: type of the computation.
    """
    random = torch.Generator().manual_seed(0)
    x = torch.rand(1, 1, *A.domain_shape, generator=random, dtype=dtype).to(A.device)
    size = torch.zeros((), dtype=dtype)
    for _ in range(iterations):
        x = A.T(A(x / x.norm().clamp_min(torch.finfo(dtype).tiny)))
        size = x.norm()
    return size.sqrt().item()


#: Column sums are clamped to at least this share of their mean, so that few voxels at the rim of
#: the field of view do not slow down the proximal map.
MIN_COLUMN_SHARE = 0.5


@solver.declares(iterates=True, differentiable=False)
def fista_tv(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 100,
    weight: float = 1e-5,
    inner: int = 10,
    preconditioned: bool = True,
    nonnegative: bool = True,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Total variation regularisation, min |y - A x|^2_R / (2 c) + weight sum |D x|, in the unit of
    the volume, by FISTA.

    The data term is that of `WeightedFit`, and D is the gradient per mm, so a weight does not
    depend on the number of views, pixels or voxels; scaling views and weight scales the volume. The
    proximal map is warm-started, and the momentum is restarted when a step turns back (Beck and
    Teboulle, SIAM J. Imaging Sci. 2, 2009, and IEEE Trans. Image Process. 18, 2009).

    Not differentiable: raises if views require a gradient.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: number of iterations.
        weight: weight of the total variation, in (unit of the volume) mm; the default is for
            attenuation in 1/mm, densities of about one need 1e-4 to 1e-2.
        inner: gradient steps of each proximal map, which begin at its last dual field. With 5 the
            objective stays up to 0.5 % above the minimum, with 10 within 0.1 %.
        preconditioned: use SIRT's step lengths, the inverse column sums; else one length for all
            voxels, the inverse squared norm by the power method. The minimum is the same.
        nonnegative: constrain the volume to non-negative values.
        common: start, support, monitor: see `Common`.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `InverseProblem`; a negative weight, or less than one inner step.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> volume = mv.fista_tv(A, A(x), iterations=20, weight=1e-3)
        >>> bool((volume - x).norm() < 0.05 * x.norm())
        True
    """
    solver.check_not_negative(weight=weight)
    if inner < 1:
        raise ValueError(f"Expected at least one inner step, got {inner}")
    steps, problem = voxel_steps(A), solver.InverseProblem.of(A, views, iterations, common)
    fit = WeightedFit.of(problem.A, problem.views.dtype)
    rows = fit.weights.row
    if preconditioned:  # lengths in units of 1 / c
        metric = 1 / (fit.columns / fit.level).clamp_min(MIN_COLUMN_SHARE)
    else:
        norm = power_norm(Scaled(problem.A, pixels=rows[0, 0].sqrt()), dtype=rows.dtype)
        # the power method underestimates: 2 % margin
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


#: The minimum is sought among values up to so many times the volume's largest.
SEARCH_FACTOR = 2.0


class PenalisedFit(NamedTuple):
    """The objective |y - A x|^2_R / (2 c) + weight sum |D x|, in the square of the unit of the
    volume.

    Args:
        fit: the data term.
        weight: weight of the total variation, in (unit of the volume) mm.
        steps: voxel size along (z, y, x), in mm.
        nonnegative: constrain the volume to non-negative values.
        support: 1 for voxels that may differ from zero; None: everywhere.
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
        multiplier: Float[Tensor, "b c m v u"],
        back: Float[Tensor, "b c d h w"],
        field: Float[Tensor, "3 b c d h w"] | None,
    ) -> Float[Tensor, "b c"]:
        """Return an upper bound of the objective's excess over its minimum, relative to the
        objective.

        The duality gap over volumes of values up to twice the largest one, as a sum of non-negative
        terms, which avoids cancellation (Chambolle and Pock, J. Math. Imaging Vis. 40, 2011, eq. 9,
        restricted as in their section 3.1). Zero where the objective is.

        Args:
            volume: x.
            residual: y - A x.
            multiplier: q, of the residual views; scaled by c, as the two that follow.
            back: A^T q.
            field: p, without unit, vectors of length at most 1; None without total variation.
        """
        row, level = self.fit.weights.row, self.fit.level
        misfit = torch.where(row > 0, residual - multiplier / torch.where(row > 0, row, 1), 0)
        terms, slope = [_sum(row * misfit.square()) / (2 * level)], -back / level
        value = _sum(row * residual.square()) / (2 * level)
        if field is not None:
            change = differences.gradient(volume, self.steps)
            size = torch.linalg.vector_norm(change, dim=0)
            value = value + self.weight * _sum(size)
            terms.append(self.weight * _sum(size - (field * change).sum(dim=0)))
            slope = slope + self.weight * differences.gradient_adjoint(field, self.steps)
        if self.support is not None:
            slope = slope * self.support
        reach = SEARCH_FACTOR * volume.abs().flatten(2).amax(dim=2)[..., None, None, None]
        lowest = torch.zeros_like(reach) if self.nonnegative else -reach
        terms.append(_sum(slope * (volume - torch.where(slope > 0, lowest, reach))))
        total = torch.stack(terms).sum(dim=0)
        return divided(total, value)


def closed(gap: float) -> solver.Monitor:
    """A monitor that stops each sample at a relative duality gap.

    Args:
        gap: the threshold, such as 1e-3.
    """

    def small(iterate: solver.Iterate) -> Tensor | bool:
        return False if iterate.gap is None else (iterate.gap <= gap).all(dim=1)

    return small


def _sum(values: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c"]:
    return values.flatten(2).sum(dim=2, dtype=torch.float64)


#: Over-relaxation of the steps; 1: none, from 2 on convergence is not guaranteed.
RELAXATION = 1.8
#: The gap is computed at every so many iterates, and at the last.
GAP_INTERVAL = 10


@solver.declares(iterates=True, differentiable=False)
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

    Converges to the minimum of `fista_tv`, which explains weight and units, without an inner loop.
    Steps are preconditioned by the row and column sums of A and D (Pock and Chambolle, Int. Conf.
    Computer Vision, 2011, alpha = 1) and over-relaxed by `RELAXATION` (Condat, J. Optim. Theory
    Appl. 158, 2013, algorithm 3.1).

    Not differentiable: raises if views require a gradient.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: maximum number of iterations.
        weight: weight of the total variation, in (unit of the volume) mm; the default is for
            attenuation in 1/mm, densities of about one need 1e-4 to 1e-2.
        balance: ratio of dual to primal steps; affects the speed only.
        nonnegative: constrain the volume to non-negative values.
        gap: stop a sample at this duality gap relative to the objective, computed every 10
            iterations; 0: never.
        common: start, support, monitor: see `Common`. A monitor also gets the gap.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `InverseProblem`; a negative weight or gap, or a balance that is not
            positive.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> volume = mv.pdhg_tv(A, A(x), iterations=20, weight=1e-3)
        >>> bool((volume - x).norm() < 0.05 * x.norm())
        True
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
    # scales D to column sums of c, the mean of those of A
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
            if number % GAP_INTERVAL == 0 or number == problem.iterations:
                gap = objective.gap(volume, of_volume, multiplier, back, fresh)
            yield solver.Step(volume, of_volume, gap)
        target = (multiplier + balance * fit.weights.row * beyond) / (1 + balance)
        multiplier = multiplier.lerp(target, RELAXATION)
        x, residual = x.lerp(volume, RELAXATION), residual.lerp(of_volume, RELAXATION)
        if field is not None:
            fresh = kernels.dual_step(ahead, field.clone(), rate, steps)
            field = field.lerp_(fresh, RELAXATION)
