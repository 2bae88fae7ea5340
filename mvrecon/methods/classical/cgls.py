"""CGLS, conjugate gradients for least squares, and its stopping rule."""

from collections.abc import Callable
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.problem import (
    Common,
    Problem,
    Watch,
    declares,
    posed,
    without_gradient,
)
from mvrecon.operators.operator import LinearOperator

#: N x of a penalty <x, N x>, for a volume x.
Penalty = Callable[[Tensor], Tensor]


@declares(iterates=True)
@without_gradient
def cgls(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 20,
    damping: float = 0.0,
    tolerance: float = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Conjugate gradients for least squares: min |y - A x|^2 + damping^2 |x|^2, in the unit of the
    volume.

    Each iteration lowers the residual as far as any method can that uses as many products with A
    and A^T (Hestenes and Stiefel, 1952; CGLS as in Bjorck, Numerical Methods for Least Squares
    Problems, 1996, 7.4). The iterates are those of LSQR. With noise the first iterations are the
    best: few are a regularisation. Linear in the views, if it starts at zero and tolerance is 0.

    No gradient: views that require one are refused.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: at most.
        damping: of large volumes, in the unit of A, mm; 0: none.
        tolerance: a sample is done when |A^T r| is at most so much of |A^T y| or, without damping,
            |r| of |y|; rounding's own at least.
        common: start, support, monitor: see `Common`.

    Raises:
        ValueError: as `posed`; a damping or tolerance that is negative.
    """
    check_not_negative(damping=damping, tolerance=tolerance)
    problem = posed(cgls, A, views, common)
    penalty = (lambda x: damping**2 * x) if damping else None
    return conjugate_gradients(problem, iterations, tolerance, penalty)


def conjugate_gradients(
    problem: Problem,
    iterations: int,
    tolerance: float,
    penalty: Penalty | None = None,
    weights: Float[Tensor, "#b #c m v u"] | None = None,
    pull: Float[Tensor, "b c d h w"] | None = None,
) -> Float[Tensor, "b c d h w"]:
    """The volume that minimises |y - A x|^2_W + <x, N x> - 2 <g, x>, by conjugate gradients, for
    each sample.

    On a GPU the host asks only with a tolerance or a monitor, once an iteration, whether samples
    are left to go on with; else all iterations run, and what is done stays as it is.

    Args:
        problem: operator, views, start.
        iterations: at most.
        tolerance: of |A^T W y| for the gradient, and of |y| for the residual without a penalty.
        penalty: N x.
        weights: W of the views; None: one.
        pull: g; None: zero.
    """
    A, views, x, monitor, started = problem
    asked = views.is_cpu or tolerance > 0 or monitor is not None
    root = None if weights is None else weights.sqrt()

    def gradient(residual: Tensor, volume: Tensor | None) -> Tensor:
        back = A.T(residual if weights is None else weights * residual)
        back = back if pull is None else back + pull
        return back if penalty is None or volume is None else back - penalty(volume)

    r = problem.unexplained()
    s = gradient(r, x)
    floor = max(tolerance, torch.finfo(views.dtype).eps)
    goal = floor * (norms(gradient(views, None)) if started else norms(s))
    # with a penalty a residual of zero is no sign of the minimum
    enough = floor * norms(views) if penalty is None else torch.full_like(goal, -1)
    p, size, watch = s, norms(s), Watch(monitor)
    for number in range(1, iterations + 1):
        # what is not finite is never done, so that it shows in the volume
        active = ~((size <= goal) | (norms(r) <= enough))
        if asked and not active.any():
            break
        q = A(p)
        curvature = norms(q if root is None else root * q).square()
        if penalty is not None:
            curvature = curvature + _products(p, penalty(p))
        # <s, p> is |s|^2 up to rounding, and with it no step goes up, however many are taken
        moves = active & ~(curvature <= 0)
        step = torch.where(moves, _products(s, p) / torch.where(moves, curvature, 1), 0)
        x, r = torch.addcmul(x, step, p), torch.addcmul(r, step, q, value=-1)
        if watch.ends(number, x, lambda: r):  # noqa: B023
            break
        s, last = gradient(r, x), size
        size = norms(s)
        ratio = torch.where(active, (size / torch.where(active, last, 1)).square(), 0)
        p = torch.addcmul(s, ratio, p)
    return watch.result(x)


def _products(one: Float[Tensor, "b c *n"], other: Float[Tensor, "b c *n"]) -> Tensor:
    return (one * other).flatten(2).sum(dim=2)[..., None, None, None]


def norms(tensor: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c 1 1 1"]:
    """The 2-norm of each sample's volume or views."""
    return torch.linalg.vector_norm(tensor.flatten(2), dim=2)[..., None, None, None]


def check_not_negative(**options: float) -> None:
    """Refuse options that are negative or not finite.

    Raises:
        ValueError: with the option's name.
    """
    for name, value in options.items():
        if not 0 <= value < float("inf"):
            raise ValueError(f"Expected {name} of at least 0, got {value}")
