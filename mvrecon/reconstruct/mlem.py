"""MLEM, which maximises the Poisson likelihood of counts, and OSEM, the same over ordered subsets
of the cameras.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.projectors.operator import LinearOperator
from mvrecon.projectors.selection import ordered_subsets
from mvrecon.reconstruct.poisson import PoissonLikelihood


def mlem(
    A: LinearOperator,
    counts: Float[Tensor, "b c m v u"],
    iterations: int,
    background: float | Float[Tensor, "b c m v u"] = 0.0,
    start: Float[Tensor, "b c d h w"] | None = None,
    subsets: int = 1,
    skip_zero_bins: bool = True,
) -> Float[Tensor, "b c d h w"]:
    """Maximum likelihood of Poisson counts by expectation maximisation: x <- x / s A^T (y / (A x +
    r)).

    Every step raises the likelihood, keeps x >= 0, and without background keeps the counts: sum(s
    x) = sum(y). A voxel that is zero stays zero; after one step those are the voxels that no counts
    reach (Shepp and Vardi, IEEE Trans. Med. Imaging 1, 1982). With subsets, cameras taken in turn,
    n steps make one iteration: nearly n times as fast, but no longer sure to converge. A voxel is
    then zero for ever as soon as one subset that sees it has no counts for it, which at few counts
    leaves bins with counts that no voxel explains (OSEM: Hudson and Larkin, IEEE Trans. Med.
    Imaging 13, 1994).

    Args:
        A: the operator, in counts per unit of the volume.
        counts: measured.
        iterations: over all counts.
        background: expected counts of other origin, one number or views that broadcast to the
            counts.
        start: the first volume; by default uniform where a ray passes, with as many counts as are
            measured.
        subsets: of the cameras, for OSEM.
        skip_zero_bins: leave out the rays of bins without counts where that pays; the volume is the
            same.

    Raises:
        ValueError: as `PoissonLikelihood`; counts that the start does not allow, a start that is
            negative somewhere or not finite, a number of subsets that is below one or above that of
            the cameras.
    """
    dealt = ordered_subsets(A.range_shape[0], subsets)
    parts = [PoissonLikelihood(A, counts, background, views, skip_zero_bins) for views in dealt]
    with torch.no_grad():
        return _expectation_maximised(parts, iterations, start)


def _expectation_maximised(
    parts: list[PoissonLikelihood], iterations: int, start: Float[Tensor, "b c d h w"] | None
) -> Float[Tensor, "b c d h w"]:
    dtype = parts[0].counts.dtype if start is None else start.dtype
    sums = [part.sensitivity(dtype) for part in parts]
    every = torch.stack(sums).sum(dim=0)
    x = _uniform(parts, every) if start is None else start
    if bool((~(x >= 0) | ~x.isfinite()).any()):
        raise ValueError(
            "MLEM starts from a volume that is finite and nowhere negative, got another"
        )
    # 0 / 0 is 0: no counts can come from a voxel that no ray passes
    x = x * (every > 0)
    for part in parts:
        part.expected(x)
    for _ in range(iterations):
        for part, s in zip(parts, sums, strict=True):
            # a voxel that these views do not see, though others do, is left to the others
            x = torch.where(s > 0, x * (part.explained(x) / torch.where(s > 0, s, 1)), x)
    return x


def _uniform(
    parts: list[PoissonLikelihood], every: Float[Tensor, "1 1 d h w"]
) -> Float[Tensor, "b c d h w"]:
    """As many counts as are measured, from the same number in each voxel."""
    measured = torch.stack([part.counts.flatten(2).sum(dim=2) for part in parts]).sum(dim=0)
    level = measured / every.sum().clamp_min(torch.finfo(every.dtype).tiny)
    return level[..., None, None, None].expand(*level.shape, *every.shape[2:])
