"""SIRT, the simultaneous iterative reconstruction technique, with any linear operator."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.views import check_finite
from mvrecon.projectors.operator import LinearOperator
from mvrecon.projectors.selection import ViewSelection


class SirtWeights(NamedTuple):
    """The diagonal matrices of SIRT, zero where a ray meets no voxel or a voxel no ray.

    Args:
        row: R, the inverse row sums of A.
        column: C, the inverse column sums of A.
    """

    row: Float[Tensor, "1 1 *range"]
    column: Float[Tensor, "1 1 *domain"]


def sirt_weights(A: LinearOperator, dtype: torch.dtype = torch.float32) -> SirtWeights:
    """SIRT's weights: the inverse sums of the rows and of the columns of A.

    A rig that is its own mirror image is projected by half; the numbers are the same up to
    rounding.
    """
    ones = torch.ones(1, 1, *A.domain_shape, dtype=dtype, device=A.device)
    with torch.no_grad():
        mirror = A.mirror()
        if mirror is None:
            rows = A(ones)
            return SirtWeights(inverse_sums(rows), inverse_sums(A.T(torch.ones_like(rows))))
        share = mirror.share.to(ones)[:, None, None]
        selection = ViewSelection(A.range_shape, share.flatten().nonzero()[:, 0].tolist())
        half = A.subset(selection)
        rows = share * selection.T(half(ones))
        columns = half.T(selection(share.expand_as(rows)))
        rows, columns = rows + mirror.views(rows), columns + mirror.volume(columns)
        return SirtWeights(inverse_sums(rows), inverse_sums(columns))


def inverse_sums(sums: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """1 / sums of an operator's rows or columns, zero where a ray or voxel is empty."""
    # a ray that grazes a corner would otherwise be weighted by the inverse of a rounding error
    counts = sums > 1e-6 * sums.max()
    return torch.where(counts, 1 / torch.where(counts, sums, 1), 0)


def correction(
    A: LinearOperator, residual: Float[Tensor, "b c m v u"], weights: tuple[Tensor, Tensor]
) -> Float[Tensor, "b c d h w"]:
    """The SIRT step C A^T R r of residual views r, in the unit of the volume; weights (R, C)."""
    row, column = weights
    return column * A.T(row * residual)


def sirt(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: int,
    start: Float[Tensor, "b c d h w"] | None = None,
    nonnegative: bool = True,
    weights: tuple[Tensor, Tensor] | None = None,
    momentum: bool = False,
) -> Float[Tensor, "b c d h w"]:
    """Simultaneous iterative reconstruction: x <- x + C A^T R (y - A x), in the unit of the volume.

    Converges to the least-squares solution weighted by R (Gregor & Benson, IEEE Trans. Med. Imaging
    27, 2008). With momentum n iterations do the work of about n^2 / 4 (Nesterov's sequence, as in
    FISTA: Beck & Teboulle, SIAM J. Imaging Sci. 2, 2009, eq. 4.2 and 4.3).

    Args:
        A: the operator.
        views: measured integrals.
        iterations: how many.
        start: the first volume; zero by default.
        nonnegative: clip each iterate at zero.
        weights: (R, C) from `sirt_weights`, where they are known already.
        momentum: carry each step on into the next.

    Raises:
        ValueError: views that are not finite, such as logarithms of no intensity.
    """
    check_finite(views)
    weights = weights or sirt_weights(
        A, views.dtype if views.dtype == torch.float64 else torch.float32
    )
    x = weights[0].new_zeros(*views.shape[:2], *A.domain_shape) if start is None else start
    ahead, t = x, 1.0
    for _ in range(iterations):
        last, x = x, ahead + correction(A, views - A(ahead), weights)
        x = x.clamp_min(0) if nonnegative else x
        t, before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        ahead = x + (before - 1) / t * (x - last) if momentum else x
    return x
