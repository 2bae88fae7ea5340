"""Accelerated proximal gradient descent, the loop that SIRT and FISTA share."""

import math
from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from mvrecon.reconstruct.problem import Problem, Watch

#: From the residual views y - A x to a change of the volume, or from a volume to an allowed one.
Map = Callable[[Tensor], Tensor]


def descend(
    problem: Problem, step: Map, proximal: Map, iterations: int, momentum: bool = True
) -> Float[Tensor, "b c d h w"]:
    """Proximal gradient descent, x <- prox(x + step(y - A x)), in the unit of the volume.

    With momentum a step begins at x + beta (x - last), and n of them do the work of about n^2 / 4
    (Nesterov's sequence: Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, eq. 4.1 to 4.3).

    Args:
        problem: operator, views and start.
        step: a stable gradient step, such as r -> C A^T R r.
        proximal: the proximal map of the penalty in the metric of the step.
        iterations: how many.
        momentum: begin each step beyond the last volume.
    """
    A, views, x, monitor = problem
    ahead, t, beta, watch = x, 1.0, 0.0, Watch(monitor)
    for number in range(iterations):
        residual = views - A(ahead)
        if watch.ends(number, x, lambda: residual, beta):  # noqa: B023
            return x
        last, x = x, proximal(ahead + step(residual))
        t, before = (1 + math.sqrt(1 + 4 * t * t)) / 2, t
        beta = (before - 1) / t if momentum else 0.0
        ahead = x + beta * (x - last) if momentum else x
    watch.ends(iterations, x, lambda: views - A(x))
    return x
