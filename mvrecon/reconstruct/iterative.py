"""Iterative reconstruction that needs a projector and nothing else."""

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


def sirt(
    A: Projector,
    views: Float[Tensor, "b c m v u"],
    iterations: int,
    start: Float[Tensor, "b c d h w"] | None = None,
    relaxation: float = 1.0,
    nonnegative: bool = True,
    weights: tuple[Tensor, Tensor] | None = None,
) -> Float[Tensor, "b c d h w"]:
    """Simultaneous iterative reconstruction: x <- x + relaxation * C A^T R (y - A x), in the unit of the volume.

    Converges to the least-squares solution weighted by R for 0 < relaxation < 2 (Gregor & Benson, IEEE Trans. Med.
    Imaging 27, 2008).

    Args:
        A: the projector.
        views: measured integrals.
        iterations: how many.
        start: the first volume; zero by default.
        relaxation: step length.
        nonnegative: clip each iterate at zero.
        weights: (R, C) from `sirt_weights`, where they are known already.
    """
    row, column = weights or sirt_weights(A, views.dtype if views.dtype == torch.float64 else torch.float32)
    x = row.new_zeros(*views.shape[:2], *A.grid.shape) if start is None else start
    for _ in range(iterations):
        x = x + relaxation * column * A.T(row * (views - A(x)))
        x = x.clamp_min(0) if nonnegative else x
    return x
