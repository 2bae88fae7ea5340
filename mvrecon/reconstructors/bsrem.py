"""BSREM, which maximises the Poisson likelihood of counts with the relative difference prior."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import count, islice
from typing import Any, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.projectors.operator import LinearOperator
from mvrecon.projectors.selection import usual_subsets
from mvrecon.quantities import NonNegativeInt
from mvrecon.reconstructors.cgls import check_not_negative
from mvrecon.reconstructors.division import positive_mean
from mvrecon.reconstructors.mlem import (
    admitted,
    likelihood_of_residual,
    subset_likelihoods,
    unexplained,
    uniform,
)
from mvrecon.reconstructors.poisson import PoissonLikelihood
from mvrecon.reconstructors.problem import (
    Common,
    Watch,
    check_iterations,
    check_start,
    declares,
    supported,
    without_gradient,
)
from mvrecon.reconstructors.relative_difference import RelativeDifference
from mvrecon.reconstructors.total_variation import voxel_steps

#: Steps shrink as 1 / (1 + RELAXATION n), so that they converge, and their sum does not.
RELAXATION = 1 / 15
#: The least value of a voxel that is seen, relative to a uniform volume with all counts: a voxel
#: of zero could not rise again.
FLOOR = 1e-6


@declares(views="counts", iterates=True)
@without_gradient
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
    """Penalised likelihood of counts by BSREM: sum(ybar - y log ybar) + weight c R(x) is minimised,
    with ybar = A x + r and the relative difference prior R.

    The steps are those of `_iterates`. Strong weights converge slowly: a step changes the mean of a
    region by s / (s + 2 weight c W), W about 19.

    No gradient: counts that require one are refused.

    Args:
        A: the operator, in counts per unit of the volume.
        counts: measured.
        iterations: over all counts.
        weight: of the prior, a number without unit; c is the mean sensitivity of the voxels that
            are seen, so that f(a y) = a f(y), and that a longer measurement is not smoothed more.
            1e-3 to 1e-1 is usual.
        subsets: into which the cameras are dealt; None: the square root of their number.
        prior: options gamma, anatomy and similar of `RelativeDifference`; None: gamma 2.
        background: expected counts of other origin, one number or views that broadcast to the
            counts.
        common: start, support, monitor: see `Common`. The start is uniform by default. A monitor
            sees the objective, and costs one projection an iteration.

    Raises:
        TypeError: an option that the prior does not have.
        ValueError: as `mlem` and `RelativeDifference`; a weight that is negative.
    """
    check_iterations(iterations)
    check_not_negative(weight=weight)
    A, start = supported(bsrem, A, common), common.get("start")
    if start is not None:
        check_start(A, start, counts)
    subsets = usual_subsets(A.range_shape[0]) if subsets is None else subsets
    parts = subset_likelihoods(A, counts, background, subsets)
    sums = [part.sensitivity(parts[0].counts.dtype) for part in parts]
    whole = torch.stack(sums).sum(dim=0)
    visible = whole > 0
    penalty = RelativeDifference(voxel_steps(A), visible[0, 0], **(prior or {}))
    strength = weight * positive_mean(whole, 0.0)

    def objective(volume: Tensor, residual: Tensor) -> Tensor:
        return likelihood_of_residual(counts, volume, residual) + strength * penalty(volume)

    x, watch = admitted(parts, sums, start), Watch(common.get("monitor"), objective)
    iterates = _iterates(x, parts, sums, penalty, strength)
    for number, x in enumerate(islice(iterates, iterations), 1):
        if watch.ends(number, x, partial(unexplained, A, counts, background, x)):
            break
    return watch.result(x)


def _iterates(
    x: Float[Tensor, "b c d h w"],
    parts: Sequence[PoissonLikelihood],
    sums: Sequence[Float[Tensor, "1 1 d h w"]],
    penalty: RelativeDifference,
    strength: float,
) -> Iterator[Float[Tensor, "b c d h w"]]:
    """The volumes of the method, without end; the penalty is `strength` R.

    A step is x <- x + a_n S D (grad L_k - grad penalty / S) for the k-th of S subsets, with relaxed
    a_n (De Pierro and Yamagishi, IEEE Trans. Med. Imaging 20 (2001) 280; with values kept above a
    small number it converges to the minimum: Ahn and Fessler, IEEE Trans. Med. Imaging 22 (2003)
    613). There D = x / s; here D = x / (s + 2 strength W), W the sum of a voxel's weights: 2 W / x
    bounds the prior's curvature, so that a step of one is stable with any weight. Without weight
    the first iteration is one of OSEM whose subsets share one sensitivity.
    """
    s, subsets = torch.stack(list(sums)).sum(dim=0), len(parts)
    visible = s > 0
    metric = visible / torch.where(visible, s + 2 * strength * penalty.weights(s), 1)
    floor = FLOOR * uniform(parts, s) * visible
    x = x.maximum(floor)
    for number in count():
        length = subsets / (1 + RELAXATION * number)
        for part, sensitivity in zip(parts, sums, strict=True):
            slope = part.explained(x) - sensitivity
            if strength:
                slope = slope - strength / subsets * penalty.gradient(x)
            x = torch.addcmul(x, x * metric, slope, value=length).maximum(floor)
        yield x
