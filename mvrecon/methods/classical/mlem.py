"""MLEM, which maximises the Poisson likelihood of counts, and its ordered-subset form OSEM."""

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

#: Activity below this part of the greatest is set to zero: denormal numbers (below 1e-38) would
#: slow down the processor many times.
MIN_ACTIVITY = 1e-25


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
    """Maximum-likelihood expectation maximisation of Poisson counts: x <- x / s A^T (y / (A x +
    r)), in the unit of the volume.

    Every step raises the likelihood, keeps x >= 0, and without background preserves the counts:
    sum(s x) = sum(y). Zero voxels stay zero; after one step these include all voxels that no counts
    reach (Shepp and Vardi, IEEE Trans. Med. Imaging 1, 1982). With n subsets of the cameras one
    iteration makes n steps: nearly n times as fast, without guaranteed convergence. A subset
    without counts for a voxel sets it to zero for good, so at few counts some bins may become
    inexplicable (OSEM: Hudson and Larkin, IEEE Trans. Med. Imaging 13, 1994).

    Not differentiable: raises if counts require a gradient.

    Args:
        A: the operator, in counts per unit of the volume.
        counts: measured counts.
        iterations: number of iterations, each over all counts.
        background: expected counts of other origin, one number or views that broadcast to the
            counts.
        subsets: number of subsets of the cameras, for OSEM.
        skip_zero_bins: skip the rays of bins without counts where that is faster; the volume is the
            same.
        common: start, support, monitor: see `Common`. By default the start is uniform over the
            visible voxels, with as many counts as measured. A monitor costs one projection an
            iteration.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `PoissonLikelihood`; counts that the start makes impossible, a negative or
            non-finite start, a number of subsets below one or above that of the cameras, iterations
            that are not a whole number of at least 0.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> counts = torch.poisson(A(x), generator=torch.Generator().manual_seed(0))
        >>> activity = mv.mlem(A, counts, iterations=10)
        >>> torch.allclose(A(activity).sum(), counts.sum())  # counts are preserved
        True
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
    shortened in proportion.

    x <- x + x (A_k^T (y_k / ybar_k) - s_k) / max(s_k, s / n), between OSEM and RAMLA (Browne and De
    Pierro, IEEE Trans. Med. Imaging 15 (1996) 687). OSEM's own step amplifies the noise of a single
    ray that grazes a voxel, and increases the total activity with every subset where voxels are
    much finer than the ray spacing.

    Args:
        x: the volume.
        part: the subset's likelihood.
        s: its sensitivity s_k.
        share: s / n, the mean sensitivity of the n subsets.
    """
    most = torch.maximum(s, share)
    rest = (most - s) + part.explained(x)
    x = x * divided(rest, most, 1.0)
    return torch.where(x < MIN_ACTIVITY * x.amax(dim=tuple(range(2, x.ndim)), keepdim=True), 0, x)


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
    """OSEM, MLEM over ordered subsets of the cameras: x <- x / s_k A_k^T (y_k / (A_k x + r)) where
    a subset has its share of a voxel's sensitivity, in the unit of the volume.

    Not differentiable, as `mlem`.

    Args:
        A, counts, iterations, background, skip_zero_bins, common: see `mlem`.
        subsets: number of subsets of the cameras; None: the square root of the number of cameras.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `mlem`.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> volume = mv.osem(A, A(x), iterations=10, subsets=4)
        >>> bool((volume - x).norm() < 0.05 * x.norm())
        True
    """
    subsets = usual_subsets(A.range_shape[0]) if subsets is None else subsets
    return mlem(A, counts, iterations, background, subsets, skip_zero_bins, **common)


def ordered(
    problem: InverseProblem, subsets: int, skip_zero_bins: bool = True
) -> tuple[InverseProblem, list[PoissonLikelihood], list[Float[Tensor, "1 1 d h w"]]]:
    """Return the problem with its initial volume (uniform by default), and the likelihoods and
    sensitivities of the ordered subsets of the cameras.

    Consecutive subsets are far apart.

    Raises:
        ValueError: as `PoissonLikelihood` and `checked_start`; a number of subsets below one or
            above that of the cameras.
    """
    A, counts, background = problem.A, problem.views, problem.background
    dealt = ordered_subsets(A.range_shape[0], subsets)
    parts = [
        PoissonLikelihood(A, counts, background, dealt[subset], skip_zero_bins)
        for subset in distant_order(subsets)
    ]
    sums = [part.sensitivity(counts.dtype) for part in parts]
    return replace(problem, start=checked_start(parts, sums, problem.start)), parts, sums


def checked_start(
    parts: list[PoissonLikelihood], sums: list[Tensor], start: Float[Tensor, "b c d h w"] | None
) -> Float[Tensor, "b c d h w"]:
    """Return the initial volume of a method of counts, uniform by default, in the unit of the
    volume.

    Args:
        parts: the likelihoods of all subsets.
        sums: their sensitivities.
        start: the user's, or None.

    Raises:
        ValueError: a start that is negative or makes counts impossible.
    """
    every = torch.stack(sums).sum(dim=0)
    x = uniform(parts, every) if start is None else start
    if start is not None and (x < 0).any():
        raise ValueError("Expected a non-negative start, got negative values")
    # 0 / 0 is 0: voxels that no ray passes produce no counts
    x = x * (every > 0)
    refuse_impossible(int(torch.stack([part.impossible(part.mean(x)) for part in parts]).sum()))
    return x


def likelihood_of_residual(counts: Tensor, volume: Tensor, residual: Tensor) -> Float[Tensor, " b"]:
    """The negative log-likelihood of a volume with known residual, in float64."""
    return negative_log_likelihood(counts, (counts - residual).clamp_min(0))


def uniform(
    parts: Sequence[PoissonLikelihood], every: Float[Tensor, "1 1 d h w"]
) -> Float[Tensor, "b c d h w"]:
    """The uniform volume with as many expected as measured counts."""
    measured = torch.stack([part.counts.flatten(2).sum(dim=2) for part in parts]).sum(dim=0)
    level = measured / every.sum().clamp_min(torch.finfo(every.dtype).tiny)
    return level[..., None, None, None].expand(*level.shape, *every.shape[2:])
