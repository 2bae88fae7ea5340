"""Iterative reconstruction that needs a projector and nothing else."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.projectors.base import Projector


def sirt_weights(A: Projector, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Inverse row sums R [1 1 m v u] and column sums C [1 1 d h w] of A, zero where a ray or voxel is empty."""
    device = A.lines.device
    with torch.no_grad():
        rows = A(torch.ones(1, 1, *A.grid.shape, dtype=dtype, device=device))
        columns = A.T(torch.ones_like(rows))
    return _inverse(rows), _inverse(columns)


def _inverse(sums: Tensor) -> Tensor:
    # a ray that grazes a corner would otherwise be weighted by the inverse of a rounding error
    counts = sums > 1e-6 * sums.max()
    return torch.where(counts, 1 / torch.where(counts, sums, 1), 0)


def correction(
    A: Projector, residual: Float[Tensor, "b c m v u"], weights: tuple[Tensor, Tensor]
) -> Float[Tensor, "b c d h w"]:
    """What residual views ask of each voxel, C A^T R r, in the unit of the volume; `weights` are (R, C)."""
    row, column = weights
    return column * A.T(row * residual)


def sirt(
    A: Projector,
    views: Float[Tensor, "b c m v u"],
    iterations: int,
    start: Float[Tensor, "b c d h w"] | None = None,
    nonnegative: bool = True,
    weights: tuple[Tensor, Tensor] | None = None,
    momentum: bool = False,
) -> Float[Tensor, "b c d h w"]:
    """Simultaneous iterative reconstruction: x <- x + C A^T R (y - A x), in the unit of the volume.

    Converges to the least-squares solution weighted by R (Gregor & Benson, IEEE Trans. Med. Imaging 27, 2008). With
    momentum n iterations do the work of about n^2 / 4 (Nesterov's sequence, as in FISTA: Beck & Teboulle, SIAM J.
    Imaging Sci. 2, 2009, eq. 4.2 and 4.3).

    Args:
        A: the projector.
        views: measured integrals.
        iterations: how many.
        start: the first volume; zero by default.
        nonnegative: clip each iterate at zero.
        weights: (R, C) from `sirt_weights`, where they are known already.
        momentum: carry each step on into the next.
    """
    weights = weights or sirt_weights(A, views.dtype if views.dtype == torch.float64 else torch.float32)
    x = weights[0].new_zeros(*views.shape[:2], *A.grid.shape) if start is None else start
    ahead, t = x, 1.0
    for _ in range(iterations):
        last, x = x, ahead + correction(A, views - A(ahead), weights)
        x = x.clamp_min(0) if nonnegative else x
        t, before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        ahead = x + (before - 1) / t * (x - last) if momentum else x
    return x
