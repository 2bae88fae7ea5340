"""Accelerated proximal gradient descent, the loop that SIRT and FISTA share."""

import math
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.reconstructors.problem import Problem, Watch, check_iterations

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
