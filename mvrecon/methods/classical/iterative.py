"""SIRT, the simultaneous iterative reconstruction technique, with any linear operator."""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.problem import (
    Common,
    Problem,
    Watch,
    check_iterations,
    declares,
    posed,
)
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.selection import ViewSelection

#: From the residual views y - A x to a change of the volume, or from a volume to an allowed one.
Map = Callable[[Tensor], Tensor]


def descend(
    problem: Problem,
    step: Map,
    proximal: Map,
    iterations: int,
    momentum: Literal["none", "nesterov", "restarted"],
) -> Float[Tensor, "b c d h w"]:
    """Proximal gradient descent, x <- prox(x + step(y - A x)), in the unit of the volume.

    With momentum a step begins at x + beta (x - last), and n of them do the work of about n^2 / 4
    (Nesterov's sequence: Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, eq. 4.1 to 4.3).

    Args:
        problem: operator, views and start.
        step: a stable gradient step, such as r -> C A^T R r.
        proximal: the proximal map of the penalty in the metric of the step.
        iterations: how many.
        momentum: "nesterov" begins each step beyond the last volume; "restarted" does so as long as
            the steps do not turn back, for each sample (O'Donoghue and Candes, Found. Comput. Math.
            15, 2015, 3.2): an inexact proximal map needs it.
    """
    check_iterations(iterations)
    A, views, x, monitor, _ = problem
    ahead, watch = x, Watch(monitor)
    t: float | Tensor = 1.0
    beta: float | Tensor = 0.0
    if momentum == "restarted":
        t = views.new_ones(*views.shape[:2], 1, 1, 1)
    for number in range(iterations):
        residual = views - A(ahead)
        if watch.ends(number, x, lambda: residual, beta):  # noqa: B023
            return watch.result(x)
        last, x = x, proximal(ahead + step(residual))
        if momentum == "none":
            ahead = x
            continue
        if momentum == "restarted":
            t = torch.where(_turns_back(ahead, x, last), 1, t)
        root = 1 + 4 * t * t
        root = root.sqrt() if isinstance(root, Tensor) else math.sqrt(root)
        t, before = (1 + root) / 2, t
        beta = (before - 1) / t
        ahead = x + beta * (x - last)
    watch.ends(iterations, x, lambda: views - A(x))
    return watch.result(x)


def _turns_back(ahead: Tensor, x: Tensor, last: Tensor) -> Bool[Tensor, "b c 1 1 1"]:
    """Whether a sample's step from `ahead` to x points against the way from its last volume."""
    products = ((ahead - x) * (x - last)).flatten(2).sum(dim=2)
    return (products > 0)[..., None, None, None]


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
        # a GPU does the whole in less time than its host waits for lists of views
        mirror = None if A.device.type == "cuda" else A.mirror()
        if mirror is None:
            rows = A(ones)
            return SirtWeights(inverse_sums(rows), inverse_sums(A.T(torch.ones_like(rows))))
        selection = ViewSelection(A.range_shape, mirror.share.nonzero()[:, 0].tolist())
        share = mirror.share.to(ones)[:, None, None]
        half = A.subset(selection)
        rows = share * selection.T(half(ones))
        columns = half.T(selection(share.expand_as(rows)))
        rows, columns = rows + mirror.views(rows), columns + mirror.volume(columns)
        return SirtWeights(inverse_sums(rows), inverse_sums(columns))


def inverse_sums(sums: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """1 / sums of an operator's rows or columns, zero where a ray or voxel is empty."""
    # a ray that grazes a corner would otherwise be weighted by the inverse of a rounding error
    counts = sums > 1e-6 * sums.flatten(1).amax(1).view(-1, *[1] * (sums.ndim - 1))
    return torch.where(counts, 1 / torch.where(counts, sums, 1), 0)


@torch.no_grad()
def backprojection(
    A: LinearOperator, views: Float[Tensor, "b c m v u"]
) -> Float[Tensor, "b c d h w"]:
    """The back-projection of the mean density along each ray, C A^T R y, in the unit of the volume.

    Raises:
        ValueError: views of another shape, or not finite.
    """
    problem = posed(backprojection, A, views, {})
    return correction(A, problem.views, sirt_weights(A, problem.views.dtype))


def correction(
    A: LinearOperator, residual: Float[Tensor, "b c m v u"], weights: SirtWeights
) -> Float[Tensor, "b c d h w"]:
    """The SIRT step C A^T R r of residual views r, in the unit of the volume."""
    return weights.column * A.T(weights.row * residual)


@declares(iterates=True)
def sirt(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 50,
    nonnegative: bool = True,
    momentum: bool = False,
    weights: SirtWeights | None = None,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Simultaneous iterative reconstruction: x <- x + C A^T R (y - A x), in the unit of the volume.

    Converges to the least-squares solution weighted by R (Gregor & Benson, IEEE Trans. Med. Imaging
    27, 2008). With momentum n iterations do the work of about n^2 / 4 (Nesterov's sequence, as in
    FISTA: Beck & Teboulle, SIAM J. Imaging Sci. 2, 2009, eq. 4.2 and 4.3).

    Args:
        A: the operator.
        views: measured integrals.
        iterations: how many.
        nonnegative: clip each iterate at zero.
        momentum: carry each step on into the next.
        weights: of `sirt_weights`, where they are known already.
        common: start, support, monitor: see `Common`.

    Raises:
        ValueError: views that are not finite, such as logarithms of no intensity, and what else
            `posed` refuses.
    """
    problem = posed(sirt, A, views, common)
    known = weights or sirt_weights(problem.A, problem.views.dtype)

    def step(residual: Tensor) -> Tensor:
        return correction(problem.A, residual, known)

    def proximal(volume: Tensor) -> Tensor:
        return volume.clamp_min(0) if nonnegative else volume

    return descend(problem, step, proximal, iterations, "nesterov" if momentum else "none")
