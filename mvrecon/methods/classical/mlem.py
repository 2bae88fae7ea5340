"""MLEM, which maximises the Poisson likelihood of counts, and OSEM, the same over ordered subsets
of the cameras.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import divided
from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.poisson import (
    PoissonLikelihood,
    negative_log_likelihood,
    refuse_impossible,
)
from mvrecon.methods.classical.solver import Common, InverseProblem, Step, declares, solve
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.selection import distant_order, ordered_subsets, usual_subsets

#: Part of the greatest activity below which a voxel has none: on their way to zero voxels would
#: pass numbers with fewer digits (below 1e-38), with which a processor takes many times as long.
GONE = 1e-25


@declares(data_kind="counts", iterates=True, differentiable=False)
def mlem(
    A: LinearOperator,
    counts: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 50,
    background: float | Float[Tensor, "b c m v u"] = 0.0,
    subsets: int = 1,
    skip_zero_bins: bool = True,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Maximum likelihood of Poisson counts by expectation maximisation: x <- x / s A^T (y / (A x +
    r)).

    Every step raises the likelihood, keeps x >= 0, and without background keeps the counts: sum(s
    x) = sum(y). A voxel that is zero stays zero; after one step those are the voxels that no counts
    reach (Shepp and Vardi, IEEE Trans. Med. Imaging 1, 1982). With subsets, cameras taken in turn,
    n steps make one iteration: nearly n times as fast, but no longer sure to converge. A voxel is
    then zero for ever as soon as one subset that sees its share of it has no counts for it, which
    at few counts leaves bins with counts that no voxel explains (OSEM: Hudson and Larkin, IEEE
    Trans. Med. Imaging 13, 1994).

    No gradient: counts that require one are refused.

    Args:
        A: the operator, in counts per unit of the volume.
        counts: measured.
        iterations: over all counts.
        background: expected counts of other origin, one number or views that broadcast to the
            counts.
        subsets: of the cameras, for OSEM.
        skip_zero_bins: leave out the rays of bins without counts where that pays; the volume is the
            same.
        common: start, support, monitor: see `Common`. The start is uniform by default where a ray
            passes, with as many counts as are measured. A monitor costs one projection an
            iteration.

    Raises:
        ValueError: as `PoissonLikelihood`; counts that the start does not allow, a start that is
            negative somewhere or not finite, a number of subsets that is below one or above that of
            the cameras, iterations that are no whole number of at least 0.
    """
    problem = InverseProblem.of(A, counts, iterations, common, background)
    problem, parts, sums = ordered(problem, subsets, skip_zero_bins)
    share = torch.stack(sums).mean(dim=0)

    def steps() -> Iterator[Step]:
        x = problem.first
        while True:
            for part, s in zip(parts, sums, strict=True):
                x = _step(x, part, s, share)
            yield Step(x)

    return solve(problem, steps(), objective=partial(likelihood_of_residual, problem.views))


def _step(
    x: Float[Tensor, "b c d h w"],
    part: PoissonLikelihood,
    s: Float[Tensor, "1 1 d h w"],
    share: Float[Tensor, "1 1 d h w"],
) -> Float[Tensor, "b c d h w"]:
    """One step by a subset: OSEM's where the subset has its share of a voxel's sensitivity, else
    shortened to the part of the share that it has.

    x <- x + x (A_k^T (y_k / ybar_k) - s_k) / max(s_k, s / n), between OSEM and RAMLA (Browne and De
    Pierro, IEEE Trans. Med. Imaging 15 (1996) 687). OSEM's own step follows the noise of the one
    ray that grazes a voxel, and adds counts with every subset: 60 % in one iteration where voxels
    are much finer than the gap of rays.

    Args:
        x: the volume.
        part: the subset's likelihood.
        s: its sensitivity s_k.
        share: s / n, the mean sensitivity of the n subsets.
    """
    most = torch.maximum(s, share)
    rest = (most - s) + part.explained(x)
    x = x * divided(rest, most, 1.0)
    return torch.where(x < GONE * x.amax(dim=tuple(range(2, x.ndim)), keepdim=True), 0, x)


@declares(data_kind="counts", iterates=True, differentiable=False)
def osem(
    A: LinearOperator,
    counts: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 10,
    subsets: int | None = None,
    background: float | Float[Tensor, "b c m v u"] = 0.0,
    skip_zero_bins: bool = True,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """MLEM over ordered subsets of the cameras, x <- x / s_k A_k^T (y_k / (A_k x + r)) where a
    subset sees its share of a voxel, in the unit of the volume.

    No gradient, as `mlem`.

    Args:
        A, counts, iterations, background, skip_zero_bins, common: as for `mlem`.
        subsets: into which the cameras are dealt; None: the square root of their number.

    Raises:
        ValueError: as `mlem`.
    """
    subsets = usual_subsets(A.range_shape[0]) if subsets is None else subsets
    return mlem(A, counts, iterations, background, subsets, skip_zero_bins, **common)


def ordered(
    problem: InverseProblem, subsets: int, skip_zero_bins: bool = True
) -> tuple[InverseProblem, list[PoissonLikelihood], list[Float[Tensor, "1 1 d h w"]]]:
    """The problem of counts with its first volume, uniform by default, and likelihoods and
    sensitivities of the ordered subsets of the cameras.

    The subsets are in an order in which one is far from those just before it.

    Raises:
        ValueError: as `PoissonLikelihood` and `admitted`; a number of subsets that is below one or
            above that of the cameras.
    """
    A, counts, background = problem.A, problem.views, problem.background
    dealt = ordered_subsets(A.range_shape[0], subsets)
    parts = [
        PoissonLikelihood(A, counts, background, dealt[subset], skip_zero_bins)
        for subset in distant_order(subsets)
    ]
    sums = [part.sensitivity(counts.dtype) for part in parts]
    return replace(problem, start=admitted(parts, sums, problem.start)), parts, sums


def admitted(
    parts: list[PoissonLikelihood], sums: list[Tensor], start: Float[Tensor, "b c d h w"] | None
) -> Float[Tensor, "b c d h w"]:
    """The start of a method of counts, uniform by default, in the unit of the volume.

    Args:
        parts: the likelihoods of all subsets.
        sums: their sensitivities.
        start: the user's.

    Raises:
        ValueError: a start that is negative somewhere or does not allow every count.
    """
    every = torch.stack(sums).sum(dim=0)
    x = uniform(parts, every) if start is None else start
    if start is not None and (x < 0).any():
        raise ValueError("Expected a start that is nowhere negative, got another")
    # 0 / 0 is 0: no counts can come from a voxel that no ray passes
    x = x * (every > 0)
    refuse_impossible(int(torch.stack([part.impossible(part.mean(x)) for part in parts]).sum()))
    return x


def likelihood_of_residual(counts: Tensor, volume: Tensor, residual: Tensor) -> Float[Tensor, " b"]:
    """The negative log-likelihood of a volume whose residual is known, in float64."""
    return negative_log_likelihood(counts, (counts - residual).clamp_min(0))


def uniform(
    parts: Sequence[PoissonLikelihood], every: Float[Tensor, "1 1 d h w"]
) -> Float[Tensor, "b c d h w"]:
    """As many counts as are measured, from the same number in each voxel."""
    measured = torch.stack([part.counts.flatten(2).sum(dim=2) for part in parts]).sum(dim=0)
    level = measured / every.sum().clamp_min(torch.finfo(every.dtype).tiny)
    return level[..., None, None, None].expand(*level.shape, *every.shape[2:])
