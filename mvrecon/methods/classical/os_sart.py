"""OS-SART: SIRT's step for one ordered subset of the views after the other.

RTK and others divide by the column sum of the subset at work. The iterates are nearly the same as
here, but their metric changes with each subset, and the proof for one matrix does not cover them.
There is no momentum, since with subsets it may diverge (Kim, Ramani and Fessler, IEEE Trans. Med.
Imaging 34, 2015).
"""

from functools import partial
from typing import NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.iterative import inverse_sums
from mvrecon.methods.classical.problem import (
    Common,
    Problem,
    Watch,
    declares,
    posed,
    without_gradient,
)
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.selection import (
    ViewSelection,
    distant_order,
    ordered_subsets,
    usual_subsets,
)

#: The longest step, in inverse greatest column sums: below 2, beyond which none is stable.
STABLE = 1.9


class Subset(NamedTuple):
    """One ordered subset of the views: its operator A_k, R_k and y_k."""

    A: LinearOperator
    row: Float[Tensor, "1 1 k v u"]
    views: Float[Tensor, "b c k v u"]


@declares(iterates=True)
@without_gradient
def os_sart(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 10,
    subsets: int | None = None,
    relaxation: float = 1.0,
    reduction: float = 1.0,
    nonnegative: bool = True,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Ordered-subset SART: x <- x + l C A_k^T R_k (y_k - A_k x) for every subset k of the views in
    turn, in the unit of the volume.

    One iteration goes through all views, and does the work of as many SIRT iterations as there are
    subsets. C is the inverse of the *mean* column sum of the subsets, cut off where l C would pass
    1.9 over the *greatest* one, so that every step is stable: for views that agree no step brings x
    farther from any solution that is not negative, in the norm of C^-1, and at a constant
    relaxation x converges to one (Censor and Elfving, SIAM J. Matrix Anal. Appl. 24, 2002, whose C
    is one matrix for all subsets; SART: Andersen and Kak, Ultrason. Imaging 6, 1984). For views
    that do not agree the iterates end in a cycle around the weighted least-squares solution; it
    shrinks with a relaxation that is reduced.

    Convention: RTK and others divide by the column sum of the subset at work: see the module. No
    gradient: views that require one are refused.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: over all views.
        subsets: into which the views are dealt, taken in an order in which neighbours are far from
            each other; None: the square root of the number of views. 1 is SIRT, as many as views
            SART.
        relaxation: l, above 0 and below 2.
        reduction: factor on l after every iteration, at most 1.
        nonnegative: clip at zero after every step.
        common: start, support, monitor: see `Common`. A monitor costs one projection an iteration.

    Raises:
        ValueError: as `posed`; a relaxation or reduction out of its range, fewer than one subset,
            or more than there are views.
    """
    if not (0 < relaxation < 2 and 0 < reduction <= 1):
        raise ValueError(
            f"Expected 0 < relaxation < 2 and 0 < reduction <= 1, got {relaxation} and {reduction}"
        )
    problem = posed(os_sart, A, views, common)
    count = usual_subsets(A.range_shape[0]) if subsets is None else subsets
    parts, column = _subsets(problem, count, relaxation)
    x, watch = problem.start, Watch(problem.monitor)
    for number in range(1, iterations + 1):
        for part in parts:
            residual = part.views - part.A(x)
            back = part.A.T(residual.mul_(part.row))
            # onto the adjoint's memory: a monitor may keep x
            x = torch.addcmul(x, column, back, value=relaxation, out=back)
            x = x.clamp_min_(0) if nonnegative else x
        relaxation *= reduction
        if watch.ends(number, x, partial(_residual, problem, x)):
            break
    return watch.result(x)


def _subsets(
    problem: Problem, count: int, relaxation: float
) -> tuple[list[Subset], Float[Tensor, "1 1 d h w"]]:
    """The subsets in their order, and C."""
    A, views, *_ = problem
    dealt = ordered_subsets(A.range_shape[0], count)
    ones = views.new_ones(1, 1, *A.domain_shape)
    rows, total, greatest = inverse_sums(A(ones)), torch.zeros_like(ones), torch.zeros_like(ones)
    parts = []
    for subset in distant_order(count):
        selection = ViewSelection(A.range_shape, dealt[subset])
        part = Subset(A.subset(selection), selection(rows), selection(views))
        sums = part.A.T(torch.ones_like(part.row))
        total += sums
        greatest = torch.maximum(greatest, sums, out=greatest)
        parts.append(part)
    longest = (STABLE / relaxation) * inverse_sums(greatest)
    return parts, torch.minimum(count * inverse_sums(total), longest)


def _residual(problem: Problem, x: Tensor) -> Tensor:
    return problem.views - problem.A(x)
