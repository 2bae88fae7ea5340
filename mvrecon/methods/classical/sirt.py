"""SIRT, the simultaneous iterative reconstruction technique, and OS-SART, the same over ordered
subsets of the views, with any linear operator.
"""

import math
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import divided, positive_mean
from mvrecon.core.quantities import NonNegativeInt
from mvrecon.methods.classical.solver import Common, InverseProblem, Step, declares, solve
from mvrecon.operators import selection
from mvrecon.operators.operator import LinearOperator


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
        chosen = selection.ViewSelection(A.range_shape, mirror.share.nonzero()[:, 0].tolist())
        share = mirror.share.to(ones)[:, None, None]
        half = A.subset(chosen)
        rows = share * chosen.T(half(ones))
        columns = half.T(chosen(share.expand_as(rows)))
        rows, columns = rows + mirror.views(rows), columns + mirror.volume(columns)
        return SirtWeights(inverse_sums(rows), inverse_sums(columns))


def inverse_sums(sums: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """1 / sums of an operator's rows or columns, zero where a ray or voxel is empty."""
    # a ray that grazes a corner would otherwise be weighted by the inverse of a rounding error
    counts = sums > 1e-6 * sums.flatten(1).amax(1).view(-1, *[1] * (sums.ndim - 1))
    return torch.where(counts, 1 / torch.where(counts, sums, 1), 0)


class WeightedFit(NamedTuple):
    """The data term of the penalised methods, one for all, so that a weight means the same in them:
    |y - A x|^2_R / (2 c), in the square of the unit of the volume, summed over
    voxels.

    R are the inverse row sums of A, as in SIRT, and c is the mean column sum of the voxels that a
    ray meets. For a change of all voxels alike it is half the square of that change, summed over
    voxels, and the less the finer a change is; whatever the number of views, pixels and voxels, so
    that a penalty's weight means the same on every rig.

    Args:
        weights: R and C of `sirt_weights`.
        level: c, rays through a voxel times their length in it, in mm.
    """

    weights: SirtWeights
    level: float

    @classmethod
    def of(cls, A: LinearOperator, dtype: torch.dtype) -> "WeightedFit":
        """The data term of an operator."""
        weights = sirt_weights(A, dtype)
        return cls(weights, positive_mean(divided(1.0, weights.column), 1.0))

    @property
    def columns(self) -> Float[Tensor, "1 1 d h w"]:
        """The column sums of A, in mm."""
        return divided(1.0, self.weights.column)

    def __call__(self, residual: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c"]:
        """The data term of residual views."""
        squares = self.weights.row * residual.square()
        return squares.flatten(2).sum(dim=2) / (2 * self.level)


@torch.no_grad()
def backprojection(
    A: LinearOperator, views: Float[Tensor, "b c m v u"]
) -> Float[Tensor, "b c d h w"]:
    """The back-projection of the mean density along each ray, C A^T R y, in the unit of the volume.

    Raises:
        ValueError: views of another shape, or not finite.
    """
    views = InverseProblem.of(A, views, 1, {}).views
    return correction(A, views, sirt_weights(A, views.dtype))


def correction(
    A: LinearOperator, residual: Float[Tensor, "b c m v u"], weights: SirtWeights
) -> Float[Tensor, "b c d h w"]:
    """The SIRT step C A^T R r of residual views r, in the unit of the volume."""
    return weights.column * A.T(weights.row * residual)


#: From the residual views y - A x to a change of the volume, or from a volume to an allowed one.
Map = Callable[[Tensor], Tensor]


def proximal_gradient(
    problem: InverseProblem,
    gradient_step: Map,
    proximal: Map,
    momentum: Literal["none", "nesterov", "restarted"],
) -> Iterator[Step]:
    """Proximal gradient descent, x <- prox(x + step(y - A x)), in the unit of the volume.

    With momentum a step begins at x + beta (x - last), and n of them do the work of about n^2 / 4
    (Nesterov's sequence: Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, eq. 4.1 to 4.3). The
    residual there gives the one at x by linearity, so that a monitor costs one projection at the
    end.

    Args:
        problem: operator, views and start.
        gradient_step: a stable gradient step, such as r -> C A^T R r.
        proximal: the proximal map of the penalty in the metric of the step.
        momentum: "nesterov" begins each step beyond the last volume; "restarted" does so as long as
            the steps do not turn back, for each sample (O'Donoghue and Candes, Found. Comput. Math.
            15, 2015, 3.2): an inexact proximal map needs it.
    """
    A, views, x = problem.A, problem.views, problem.first
    # each sample has its own restarts
    t = views.new_ones(*views.shape[:2], 1, 1, 1) if momentum == "restarted" else 1.0
    beta: float | Tensor = 0.0
    ahead, residual = x, problem.residual(problem.start)
    of_volume = residual
    while True:
        last, x = x, proximal(ahead + gradient_step(residual))
        if momentum == "none":
            ahead = x
        else:
            if momentum == "restarted":
                # a step of a sample points against the way from its last volume
                turns = ((ahead - x) * (x - last)).flatten(2).sum(dim=2) > 0
                t = torch.where(turns[..., None, None, None], 1, t)
            root = 1 + 4 * t * t
            root = root.sqrt() if isinstance(root, Tensor) else math.sqrt(root)
            t, before = (1 + root) / 2, t
            beta = (before - 1) / t
            ahead = x + beta * (x - last)
        if problem.monitor is None:  # the last iterate needs no projection
            yield Step(x)
            residual = views - A(ahead)
        else:
            residual = views - A(ahead)
            of_volume = (residual + beta * of_volume) / (1 + beta)
            yield Step(x, of_volume)


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
            `InverseProblem` refuses.
    """
    problem = InverseProblem.of(A, views, iterations, common)
    known = weights or sirt_weights(problem.A, problem.views.dtype)

    def gradient_step(residual: Tensor) -> Tensor:
        return correction(problem.A, residual, known)

    def proximal(volume: Tensor) -> Tensor:
        return volume.clamp_min(0) if nonnegative else volume

    kind = "nesterov" if momentum else "none"
    return solve(problem, proximal_gradient(problem, gradient_step, proximal, kind))


#: The longest step, in inverse greatest column sums: below 2, beyond which none is stable.
STABLE = 1.9


@declares(iterates=True, differentiable=False)
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

    Convention: RTK and others divide by the column sum of the subset at work. The iterates are
    nearly the same as here, but their metric changes with each subset, and the proof for one matrix
    does not cover them. There is no momentum, since with subsets it may diverge (Kim, Ramani and
    Fessler, IEEE Trans. Med. Imaging 34, 2015). No gradient: views that require one are refused.

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
        ValueError: as `InverseProblem`; a relaxation or reduction out of its range, fewer than one
            subset, or more than there are views.
    """
    if not (0 < relaxation < 2 and 0 < reduction <= 1):
        raise ValueError(
            f"Expected 0 < relaxation < 2 and 0 < reduction <= 1, got {relaxation} and {reduction}"
        )
    problem = InverseProblem.of(A, views, iterations, common)
    subsets = selection.usual_subsets(A.range_shape[0]) if subsets is None else subsets
    dealt = selection.ordered_subsets(A.range_shape[0], subsets)
    A, views = problem.A, problem.views
    ones = views.new_ones(1, 1, *A.domain_shape)
    rows, total, greatest = inverse_sums(A(ones)), torch.zeros_like(ones), torch.zeros_like(ones)
    parts: list[tuple[LinearOperator, Tensor, Tensor]] = []  # A_k, R_k, y_k
    for subset in selection.distant_order(subsets):
        chosen = selection.ViewSelection(A.range_shape, dealt[subset])
        part = A.subset(chosen)
        parts.append((part, chosen(rows), chosen(views)))
        sums = part.T(torch.ones_like(parts[-1][1]))
        total += sums
        greatest = torch.maximum(greatest, sums, out=greatest)
    longest = (STABLE / relaxation) * inverse_sums(greatest)
    column = torch.minimum(subsets * inverse_sums(total), longest)

    def steps() -> Iterator[Step]:
        x, length = problem.first, relaxation
        while True:
            for part, row, of_part in parts:
                back = part.T((of_part - part(x)).mul_(row))
                # onto the adjoint's memory: a monitor may keep x
                x = torch.addcmul(x, column, back, value=length, out=back)
                x = x.clamp_min_(0) if nonnegative else x
            length *= reduction
            yield Step(x)

    return solve(problem, steps())
