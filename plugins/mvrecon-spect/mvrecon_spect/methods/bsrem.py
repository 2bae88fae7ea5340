"""BSREM, which maximises the Poisson likelihood of counts, penalised by a neighbourhood prior."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import positive_mean
from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.mlem import likelihood_of_residual, ordered, uniform
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.methods.classical.solver import (
    Common,
    InverseProblem,
    Step,
    check_not_negative,
    declares,
    power_of_two,
    solve,
)
from mvrecon.methods.classical.total_variation import voxel_steps
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.selection import usual_subsets
from mvrecon_spect.methods.priors import Prior, prior_of

#: Steps decrease as 1 / (1 + RELAXATION n): they converge to zero, and their sum diverges.
RELAXATION = 1 / 15
#: Minimum value of a visible voxel, relative to a uniform volume with all counts: a voxel at zero
#: would remain zero.
FLOOR = 1e-6


@declares(data_kind="counts", iterates=True, differentiable=False)
def bsrem(
    A: LinearOperator,
    counts: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 20,
    weight: float = 0.01,
    subsets: int | None = None,
    prior: Mapping[str, Any] | None = None,
    background: float | Float[Tensor, "b c m v u"] = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Penalised likelihood of counts by BSREM: minimises sum(ybar - y log ybar) + weight c R(x),
    with ybar = A x + r and a prior R of `mvrecon_spect.methods.priors`.

    See `_iterates` for the update. Convergence is slow for large weights: with the relative
    difference prior, an update changes the mean of a region by s / (s + 2 weight c W), W about 19.

    Not differentiable: raises if counts require a gradient.

    Args:
        A: the operator, in counts per unit of the volume.
        counts: measured counts.
        iterations: number of passes over all counts.
        weight: weight of the prior, dimensionless; c is the mean sensitivity of the visible voxels,
            so f(a y) = a f(y): smoothing does not depend on the duration of the measurement.
            Typical values are 1e-3 to 1e-1.
        subsets: number of ordered subsets of the cameras; None: the square root of their number.
        prior: name and options, see `prior_of`: relative_difference (gamma), quadratic, log_cosh
            (delta), each with anatomy and similar; None: relative_difference with gamma 2. The
            level of the last two is the uniform volume with all counts.
        background: expected background counts, a number or views that broadcast to the counts.
        common: start, support, monitor: see `Common`. The initial volume is uniform by default. A
            monitor receives the objective, which costs one projection per iteration.

    Raises:
        TypeError: an unknown option of the prior.
        ValueError: a negative weight; see `mlem` and `prior_of`.
    """
    check_not_negative(weight=weight)
    subsets = usual_subsets(A.range_shape[0]) if subsets is None else subsets
    problem = InverseProblem.of(A, counts, iterations, common, background)
    # keeps squares in the prior within the range of float32
    scale = power_of_two(problem.views, problem.start)
    scaled, parts, sums = ordered(problem.divided(scale), subsets)
    whole = torch.stack(sums).sum(dim=0)
    visible = whole > 0
    level = uniform(parts, whole)[..., :1, :1, :1]
    level = torch.where(level > 0, level, 1)
    penalty = prior_of(prior or {}, level, voxel_steps(A), visible[0, 0])
    strength = weight * positive_mean(whole, 0.0)

    def objective(volume: Tensor, residual: Tensor) -> Tensor:
        likelihood = likelihood_of_residual(problem.views, volume, residual)
        return likelihood + strength * scale.flatten().double() * penalty(volume / scale)

    steps = _iterates(scaled.first, parts, sums, penalty, strength)
    return solve(replace(problem, start=scaled.first * scale), steps, scale, objective)


def _iterates(
    x: Float[Tensor, "b c d h w"],
    parts: Sequence[PoissonLikelihood],
    sums: Sequence[Float[Tensor, "1 1 d h w"]],
    penalty: Prior,
    strength: float,
) -> Iterator[Step]:
    """Yield the iterates indefinitely; the penalty is `strength` R.

    The update is x <- x + a_n S D (grad L_k - grad penalty / S) for the k-th of S subsets, with
    relaxation a_n (De Pierro and Yamagishi, IEEE Trans. Med. Imaging 20 (2001) 280; with a positive
    lower bound of the values it converges to the minimum: Ahn and Fessler, IEEE Trans. Med. Imaging
    22 (2003) 613). There D = x / s; here D = x / (s + strength B), where B / x bounds the prior's
    curvature (`Prior.bound`; 2 W for the relative difference, W the sum of a voxel's weights), so
    that unit steps are stable for any weight. With zero weight the first iteration is that of OSEM
    with the same sensitivity for all subsets.
    """
    s, subsets = torch.stack(list(sums)).sum(dim=0), len(parts)
    visible = s > 0
    floor = FLOOR * uniform(parts, s) * visible
    x = x.maximum(floor)
    for number in count():
        length = subsets / (1 + RELAXATION * number)
        for part, sensitivity in zip(parts, sums, strict=True):
            slope = part.explained(x) - sensitivity
            if strength:
                slope = slope - strength / subsets * penalty.gradient(x)
            metric = visible / torch.where(visible, s + strength * penalty.bound(x), 1)
            x = torch.addcmul(x, x * metric, slope, value=length).maximum(floor)
        yield Step(x)
