"""TV-regularised Poisson likelihood of counts by the method of Chambolle and Pock."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import divided, positive_mean
from mvrecon.core.quantities import NonNegativeInt
from mvrecon.kernels.differences import Shrinkage, differences_for
from mvrecon.methods.classical import solver
from mvrecon.methods.classical.mlem import checked_start, likelihood_of_residual, uniform
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.solver import Common
from mvrecon.methods.classical.total_variation import RELAXATION, total_variation, voxel_steps
from mvrecon.operators.operator import LinearOperator


@solver.declares(data_kind="counts", iterates=True, differentiable=False)
def tv_map(
    A: LinearOperator,
    counts: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 200,
    weight: float = 0.05,
    balance: float = 0.3,
    background: float | Float[Tensor, "b c m v u"] = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Minimise sum(ybar - y log ybar) + weight c sum |D x| over x >= 0, with ybar = A x + r, in the
    unit of the volume, by a primal-dual method.

    The method of Chambolle and Pock (J. Math. Imaging Vis. 40, 2011) for the Kullback-Leibler
    divergence (Sidky, Jorgensen, Pan, Phys. Med. Biol. 57 (2012) 3065, algorithm 5), with the steps
    and the relaxation of `pdhg_tv`. Bins without counts have no dual variable and add <s, x>.

    Not differentiable: raises if counts require a gradient.

    Args:
        A: the operator, in counts per unit of the volume.
        counts: measured counts.
        iterations: number of iterations, each over all counts.
        weight: weight of the total variation, in mm; c is the mean sensitivity of the visible
            voxels, so f(a y) = a f(y): longer measurements are not smoothed more. 1e-3 to 1 is
            usual.
        balance: ratio of dual to primal steps; affects the speed only.
        background: expected background counts, a number or views that broadcast to the counts.
        common: start, support, monitor: see `Common`. The start is uniform by default. A monitor
            also receives the objective (infinite while the iterate makes counts impossible), which
            costs one projection per iteration.

    Raises:
        ValueError: as `mlem`; a negative weight, or a balance that is not positive.
    """
    solver.check_not_negative(weight=weight)
    if not balance > 0:
        raise ValueError(f"Expected a positive balance, got {balance}")
    steps = voxel_steps(A)
    problem = solver.InverseProblem.of(A, counts, iterations, common, background)
    plain = PoissonLikelihood(problem.A, problem.views, problem.background)
    s = plain.sensitivity(problem.views.dtype)
    unit = uniform([plain], s)[..., :1, :1, :1]
    unit = torch.where(unit > 0, unit, 1)
    scaled = problem.divided(unit)
    fit = PoissonLikelihood(scaled.A, scaled.views, scaled.background)
    x, level = checked_start([fit], [s], scaled.start), positive_mean(s, 1.0)

    def objective(volume: Tensor, residual: Tensor) -> Tensor:
        roughness = total_variation(volume, steps).sum(dim=1)
        return likelihood_of_residual(problem.views, volume, residual) + weight * level * roughness

    iterates = _primal_dual(fit, x, weight, level, balance, steps)
    return solver.solve(replace(problem, start=x * unit), iterates, unit, objective)


def _primal_dual(
    fit: PoissonLikelihood,
    x: Float[Tensor, "b c d h w"],
    weight: float,
    level: float,
    balance: float,
    steps: Sequence[float],
) -> Iterator[solver.Step]:
    """Yield the iterates without end, for counts and a start of about one.

    Args:
        fit: the likelihood.
        x: the start.
        weight: weight of the total variation, in mm.
        level: mean sensitivity c.
        balance: ratio of dual to primal steps.
        steps: voxel size along (z, y, x), in mm.
    """
    s = fit.sensitivity(x.dtype)
    rows, columns = fit.bins(torch.ones_like(x[:1, :1])), fit.bins.T(torch.ones_like(fit.counts))
    primal = (s > 0) / (balance * (columns[:1, :1] + level))
    dual = divided(balance, rows)
    shrinkage, kernels = Shrinkage(weight * level * primal, steps, True), differences_for(x)
    rate = balance * min(steps) / (4 * weight * sum(1 / step for step in steps)) if weight else 0.0
    field = kernels.dual_step(x, x.new_zeros(3, *x.shape), rate, steps)
    expected = fit.expected(x)
    ratio = torch.where(fit.counts > 0, fit.counts / torch.where(expected > 0, expected, 1), 0)
    while True:
        volume = torch.addcmul(x, primal, fit.bins.T(ratio) - s)
        volume = kernels.primal(volume, field, shrinkage)
        yield solver.Step(volume)
        ahead = torch.lerp(x, volume, 2)
        fresh = _stepped(fit.counts, dual * (fit.bins(ahead) + fit.background) - ratio, dual)
        ratio, x = ratio.lerp(fresh, RELAXATION), x.lerp(volume, RELAXATION)
        if weight:
            field = field.lerp(kernels.dual_step(ahead, field.clone(), rate, steps), RELAXATION)


def _stepped(
    counts: Float[Tensor, "b c *n"], v: Float[Tensor, "b c *n"], dual: Float[Tensor, "1 1 *n"]
) -> Float[Tensor, "b c *n"]:
    """The proximal map of the likelihood's conjugate: the positive root q of q (q + v) = dual y.

    Args:
        counts: y.
        v: dual (A x + r) minus the ratio y / ybar before the step.
        dual: length of the step.
    """
    root = torch.sqrt(v.square() + 4 * dual * counts)
    beyond = root + v.abs()
    # avoids the difference of two nearly equal numbers
    small = 2 * dual * counts / torch.where(beyond > 0, beyond, 1)
    return torch.where(v > 0, small, beyond / 2)
