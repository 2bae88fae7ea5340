"""BSREM, which maximises the Poisson likelihood of counts with the relative difference prior."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count, product
from typing import Any, NamedTuple, Unpack

import torch
from jaxtyping import Bool, Float
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

#: Half of the 26 neighbours (z, y, x): the others are these seen from the other voxel.
HALF = [offset for offset in product((-1, 0, 1), repeat=3) if offset > (0, 0, 0)]


class Pairs(NamedTuple):
    """All pairs of voxels that one offset joins.

    Args:
        offset: from the first voxel to the second, along (z, y, x).
        weight: of each pair.
    """

    offset: Sequence[int]
    weight: Float[Tensor, "d h w"]


class RelativeDifference:
    """The relative difference prior, R = sum w (a - b)^2 / (a + b + gamma |a - b|) over pairs of
    neighbours a, b >= 0, in the unit of the volume.

    A difference counts relative to the values, R(c x) = c R(x), and beyond 1 / gamma of them it
    costs no longer its square: edges stay (Nuyts, Beque, Dupont, Mortelmans, IEEE Trans. Nucl. Sci.
    49 (2002) 56). It is convex.

    Args:
        steps: voxel size along (z, y, x), in mm.
        mask: the voxels that count.
        gamma: how early edges are spared; 0: never.
        anatomy: an image of the same voxels, such as CT: a voxel's neighbours are only the
            `similar` that are most like it there (Bowsher et al., IEEE Nucl. Sci. Symp. 2004; of
            equal ones all). A pair counts half where only one of the two chooses the other.
        similar: of the 26 neighbours, for `anatomy`.

    Raises:
        ValueError: a gamma below 0, an anatomy of another shape or with values that are not finite,
            or a number of similar neighbours that is not from 1 to 26.
    """

    def __init__(
        self,
        steps: Sequence[float],
        mask: Bool[Tensor, "d h w"],
        gamma: float = 2.0,
        anatomy: Float[Tensor, "d h w"] | None = None,
        similar: int = 7,
    ):
        if not 0 <= gamma < float("inf") or not 1 <= similar <= 26:
            raise ValueError(
                f"Expected a finite gamma of at least 0 and 1 to 26 similar neighbours, got "
                f"{gamma} and {similar}"
            )
        self.gamma, pairs = gamma, []
        reach = None if anatomy is None else _reach(_checked(anatomy, mask), similar)
        for offset in HALF:
            if any(abs(o) >= n for o, n in zip(offset, mask.shape, strict=True)):
                continue
            distance = sum((o * s / min(steps)) ** 2 for o, s in zip(offset, steps, strict=True))
            one, other = ends(mask, offset)
            weight = (one & other).to(torch.float32) / distance**0.5
            if reach is not None and anatomy is not None:
                weight = weight * _chosen(anatomy, reach, offset)
            pairs.append(Pairs(offset, weight))
        # a GPU is waited for once
        some = torch.stack([mask.any(), *(pair.weight.any() for pair in pairs)]).tolist()[1:]
        self.pairs = [pair for pair, any_of_it in zip(pairs, some, strict=True) if any_of_it]

    def __call__(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, " b"]:
        """R of each case in float64, in the unit of the volume; differentiable."""
        total = volume.new_zeros(len(volume), dtype=torch.float64)
        for weight, one, other in self._ends(volume):
            apart, size = (one - other).abs(), one + other
            size = size + self.gamma * apart
            share = apart.square() / torch.where(size > 0, size, 1)
            total = total + (weight * share).flatten(1).sum(dim=1, dtype=torch.float64)
        return total

    def gradient(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c d h w"]:
        """The derivative of R by each voxel, without unit; zero between two voxels of zero."""
        slope = torch.zeros_like(volume)
        parts = zip(self.pairs, self._ends(volume), strict=True)
        for pair, (weight, one, other) in parts:
            apart, whole = one - other, one + other
            edge = self.gamma * apart.abs()
            factor = weight * apart / torch.where(whole > 0, (whole + edge).square(), 1)
            first, second = ends(slope, pair.offset)
            first.addcmul_(factor, one + 3 * other + edge)
            second.addcmul_(factor, 3 * one + other + edge, value=-1)
        return slope

    def weights(self, like: Tensor) -> Float[Tensor, "1 1 d h w"]:
        """The sum of the weights of each voxel's pairs, in the dtype of a tensor [... d h w]."""
        total = like.new_zeros(1, 1, *like.shape[-3:])
        for pair in self.pairs:
            for end in ends(total, pair.offset):
                end.add_(pair.weight.to(total))
        return total

    def _ends(self, volume: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        for pair in self.pairs:
            yield (pair.weight.to(volume), *ends(volume, pair.offset))


def ends(volume: Tensor, offset: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Both voxels of all pairs that an offset (z, y, x) joins, as two windows of a volume [... d h
    w].
    """
    one = other = volume
    for dim, step in zip((-3, -2, -1), offset, strict=True):
        length = volume.shape[dim] - abs(step)
        one = one.narrow(dim, max(0, -step), length)
        other = other.narrow(dim, max(0, step), length)
    return one, other


def _checked(anatomy: Tensor, mask: Tensor) -> Tensor:
    if anatomy.shape != mask.shape or not anatomy.isfinite().all():
        bad = int((~anatomy.isfinite()).sum())
        raise ValueError(
            f"Expected a finite anatomy of shape {tuple(mask.shape)}, got {tuple(anatomy.shape)} "
            f"with {bad} values that are not finite"
        )
    return anatomy


def _reach(anatomy: Float[Tensor, "d h w"], similar: int) -> Float[Tensor, "d h w"]:
    """The anatomy's difference to the last neighbour that each voxel chooses, in its unit."""
    apart = anatomy.new_full((26, *anatomy.shape), torch.inf)
    for n, offset in enumerate(HALF):
        one, other = ends(anatomy, offset)
        difference = (one - other).abs()
        ends(apart[n], offset)[0].copy_(difference)
        ends(apart[n + 13], offset)[1].copy_(difference)
    return apart.kthvalue(similar, dim=0).values


def _chosen(
    anatomy: Float[Tensor, "d h w"], reach: Float[Tensor, "d h w"], offset: Sequence[int]
) -> Float[Tensor, "#d #h #w"]:
    """How many of a pair's two voxels choose the other, halved."""
    one, other = ends(anatomy, offset)
    apart = (one - other).abs()
    by_one, by_other = (apart <= end for end in ends(reach, offset))
    return (by_one.float() + by_other.float()) / 2


#: Steps shrink as 1 / (1 + RELAXATION n), so that they converge, and their sum does not.
RELAXATION = 1 / 15
#: The least value of a voxel that is seen, relative to a uniform volume with all counts: a voxel
#: of zero could not rise again.
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
    check_not_negative(weight=weight)
    subsets = usual_subsets(A.range_shape[0]) if subsets is None else subsets
    problem = InverseProblem.of(A, counts, iterations, common, background)
    # so that the prior squares no value beyond the range of float32
    scale = power_of_two(problem.views, problem.start)
    scaled, parts, sums = ordered(problem.divided(scale), subsets)
    whole = torch.stack(sums).sum(dim=0)
    visible = whole > 0
    penalty = RelativeDifference(voxel_steps(A), visible[0, 0], **(prior or {}))
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
    penalty: RelativeDifference,
    strength: float,
) -> Iterator[Step]:
    """The iterates of the method, without end; the penalty is `strength` R.

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
        yield Step(x)
