"""SIRT (simultaneous iterative reconstruction technique), its robust form, and its ordered-subset
form OS-SART, for any linear operator.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Literal, NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import SIGMA_PER_MEDIAN, divided, positive_mean
from mvrecon.core.quantities import NonNegativeInt, PositiveInt
from mvrecon.methods.classical.solver import Common, InverseProblem, Step, declares, solve
from mvrecon.operators import selection
from mvrecon.operators.operator import LinearOperator


class SirtWeights(NamedTuple):
    """The diagonal matrices of SIRT; zero for empty rays and for voxels that no ray passes.

    Args:
        row: R, the inverse row sums of A.
        column: C, the inverse column sums of A.
    """

    row: Float[Tensor, "1 1 *range"]
    column: Float[Tensor, "1 1 *domain"]


def sirt_weights(A: LinearOperator, dtype: torch.dtype = torch.float32) -> SirtWeights:
    """Return SIRT's weights, the inverse row and column sums of A.

    For a mirror-symmetric rig half of the views are projected; results agree up to rounding.
    """
    ones = torch.ones(1, 1, *A.domain_shape, dtype=dtype, device=A.device)
    with torch.no_grad():
        # on a GPU projecting all views is faster than indexing half of them from the host
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
    """1 / sums of an operator's rows or columns; zero for empty rays and voxels."""
    # else a ray that grazes a corner would be weighted by the inverse of a rounding error
    counts = sums > 1e-6 * sums.flatten(1).amax(1).view(-1, *[1] * (sums.ndim - 1))
    return torch.where(counts, 1 / torch.where(counts, sums, 1), 0)


#: Least share of a voxel's sensitivity that weights of rays must leave for it to change.
MIN_SENSITIVITY_SHARE = 0.05


def with_ray_weights(
    A: LinearOperator, weights: SirtWeights, ray_weights: Float[Tensor, "b c *range"]
) -> SirtWeights:
    """Return R w and C = 1 / A^T w for rays of weight w, with which a step is as stable as SIRT's.
    Zero for a voxel whose rays have lost all but `MIN_SENSITIVITY_SHARE` of their weight, so that
    it keeps its value.
    """
    sums = A.T(ray_weights)
    kept = sums * weights.column > MIN_SENSITIVITY_SHARE
    return SirtWeights(weights.row * ray_weights, divided(1.0, sums * kept))


class WeightedFit(NamedTuple):
    """The data term of all penalised methods, |y - A x|^2_R / (2 c), in the square of the unit of
    the volume, summed over voxels.

    R are the inverse row sums of A, as in SIRT, and c is the mean column sum of the voxels that
    rays pass. Changing all voxels by t adds t^2 / 2 per voxel whatever the numbers of views, pixels
    and voxels (finer changes add less), so a penalty's weight transfers between rigs.

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


def backprojection(
    A: LinearOperator, views: Float[Tensor, "b c m v u"]
) -> Float[Tensor, "b c d h w"]:
    """Return C A^T R y, the back-projection of each ray's mean density, in the unit of the volume.

    Raises:
        ValueError: views of another shape, or not finite.
    """
    views = InverseProblem.of(A, views, 1, {}).views
    return correction(A, sirt_weights(A, views.dtype), views)


def correction(
    A: LinearOperator, weights: SirtWeights, residual: Float[Tensor, "b c m v u"]
) -> Float[Tensor, "b c d h w"]:
    """The SIRT step C A^T R r of residual views r, in the unit of the volume."""
    return weights.column * A.T(weights.row * residual)


#: Maps residual views y - A x to a change of the volume, or a volume to a feasible one.
Map = Callable[[Tensor], Tensor]


def feasible(nonnegative: bool) -> Map:
    """The map to the nearest volume without negative values, or that to the volume itself."""
    return (lambda volume: volume.clamp_min(0)) if nonnegative else (lambda volume: volume)


def proximal_gradient(
    problem: InverseProblem,
    gradient_step: Map,
    proximal: Map,
    momentum: Literal["none", "nesterov", "restarted"],
) -> Iterator[Step]:
    """Proximal gradient descent, x <- prox(x + step(y - A x)), in the unit of the volume.

    With momentum a step begins at x + beta (x - last); n such steps do the work of about n^2 / 4
    (Nesterov's sequence: Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009, eq. 4.1 to 4.3). The
    residual at x follows by linearity, so a monitor costs one extra projection, at the end.

    Args:
        problem: operator, views and start.
        gradient_step: a stable gradient step, such as r -> C A^T R r.
        proximal: the proximal map of the penalty in the metric of the step.
        momentum: "nesterov" extrapolates before each step; "restarted" also restarts each sample
            whose step turns back (O'Donoghue and Candes, Found. Comput. Math. 15, 2015, 3.2), as an
            inexact proximal map needs.
    """
    A, views, x = problem.A, problem.views, problem.first
    # restarts are per sample
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
                # the sample's step points against its last change
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
        iterations: number of iterations.
        nonnegative: clip each iterate at zero.
        momentum: use Nesterov's momentum.
        weights: weights as `sirt_weights` returns them, if already computed.
        common: start, support, monitor: see `Common`.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: non-finite views, such as the logarithm of zero intensity, and as
            `InverseProblem`.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> volume = mv.sirt(A, A(x), iterations=20, momentum=True)
        >>> bool((volume - x).norm() < 0.05 * x.norm())
        True
    """
    problem = InverseProblem.of(A, views, iterations, common)
    known = weights or sirt_weights(problem.A, problem.views.dtype)
    gradient_step, kind = partial(correction, problem.A, known), "nesterov" if momentum else "none"
    return solve(problem, proximal_gradient(problem, gradient_step, feasible(nonnegative), kind))


#: Residual of weight 1/2 in standard deviations of a normal distribution, for which the estimate
#: has 95 % of the efficiency of least squares (Holland & Welsch).
CAUCHY_SCALE = 2.385
#: Rays hit the object if they expect more than this share of the greatest expected value.
HIT_SHARE = 0.05


@declares(iterates=True, differentiable=False)
def robust_sirt(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 84,
    every: PositiveInt = 6,
    nonnegative: bool = True,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """SIRT with momentum for views in which some pixels are wrong, such as dead ones, metal and
    cables; in the unit of the volume.

    Iteratively reweighted least squares with the Cauchy weights w = 1 / (1 + (r / (2.385 s))^2) of
    the residuals r (Holland & Welsch, Commun. Stat. A 6 (1977) 813), s their standard deviation
    from the median of |r| over the rays that hit the object. Each `every` iterations rays are
    weighted anew, from equal weights at first, and SIRT restarts with R w and C = 1 / A^T w.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: number of iterations.
        every: iterations between reweightings.
        nonnegative: clip each iterate at zero.
        common: start, support, monitor: see `Common`.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `InverseProblem`; `every` below 1.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> y = A(x)
        >>> y[:, :, 2, :, 7] = 0  # a dead column
        >>> robust, plain = mv.robust_sirt(A, y), mv.sirt(A, y, 84, momentum=True)
        >>> bool((robust - x).norm() < 0.5 * (plain - x).norm())
        True
    """
    if every < 1:
        raise ValueError(f"Expected every, a number of at least 1, got {every}")
    problem = InverseProblem.of(A, views, iterations, common)
    equal = sirt_weights(problem.A, problem.views.dtype)

    def steps() -> Iterator[Step]:
        part, weights, proximal = problem, equal, feasible(nonnegative)
        while True:
            gradient_step = partial(correction, problem.A, weights)
            run = proximal_gradient(part, gradient_step, proximal, "nesterov")
            for step in islice(run, every):
                part = replace(problem, start=step.volume)
                yield step
            expected = problem.A(part.first)
            rays = cauchy_weights(problem.views - expected, expected)
            weights = with_ray_weights(problem.A, equal, rays)

    return solve(problem, steps())


def cauchy_weights(
    residual: Float[Tensor, "b c *range"], expected: Float[Tensor, "b c *range"]
) -> Float[Tensor, "b c *range"]:
    """Weights of residual and expected views, as in `robust_sirt`."""
    apart, seen = residual.abs().flatten(2), expected.flatten(2)
    hit = seen > HIT_SHARE * seen.amax(dim=2, keepdim=True)
    ordered = torch.where(hit, apart, torch.inf).sort(dim=2).values
    middle = (hit.sum(dim=2, keepdim=True) - 1).clamp_min(0) // 2
    sigma = SIGMA_PER_MEDIAN * ordered.gather(2, middle)
    relative = torch.where(apart > 0, apart / (CAUCHY_SCALE * sigma), 0)
    return (1 / (1 + relative.square())).view_as(residual)


#: The longest step in inverse greatest column sums; from 2 on steps are unstable.
MAX_STEP = 1.9


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

    One iteration uses all views, and does the work of as many SIRT iterations as there are subsets.
    C is the inverse of the *mean* column sum of the subsets, limited so that l C is at most 1.9
    over the *greatest* one. Every step is therefore stable: for consistent views no step moves x
    farther from any non-negative solution in the norm of C^-1, and at constant relaxation x
    converges to a solution (Censor and Elfving, SIAM J. Matrix Anal. Appl. 24, 2002, with one
    matrix C for all subsets; SART: Andersen and Kak, Ultrason. Imaging 6, 1984). For inconsistent
    views the iterates end in a cycle around the weighted least-squares solution, which shrinks as
    the relaxation is reduced.

    Convention: RTK and others divide by the column sum of the current subset. The iterates are
    nearly the same, but the proof needs one matrix. Momentum is not supported, as it may diverge
    with subsets (Kim, Ramani and Fessler, IEEE Trans. Med. Imaging 34, 2015). Not differentiable:
    raises if views require a gradient.

    Args:
        A: the operator.
        views: measured integrals.
        iterations: number of passes over all views.
        subsets: number of subsets, visited in an order in which neighbours are far apart; None: the
            square root of the number of views. 1 is SIRT, one per view is SART.
        relaxation: l, above 0 and below 2.
        reduction: factor on l after every iteration, in (0, 1].
        nonnegative: clip at zero after every step.
        common: start, support, monitor: see `Common`. A monitor costs one projection an iteration.

    Returns:
        The last iterate, in float32, or in float64 for float64 views.

    Raises:
        ValueError: as `InverseProblem`; relaxation, reduction or number of subsets out of range.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> x = torch.nn.functional.pad(torch.ones(1, 1, 4, 4, 4), [2] * 6)  # a cube
        >>> volume = mv.os_sart(A, A(x), iterations=10, subsets=4)
        >>> bool((volume - x).norm() < 0.05 * x.norm())
        True
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
    longest = (MAX_STEP / relaxation) * inverse_sums(greatest)
    column = torch.minimum(subsets * inverse_sums(total), longest)

    def steps() -> Iterator[Step]:
        x, length = problem.first, relaxation
        while True:
            for part, row, of_part in parts:
                back = part.T((of_part - part(x)).mul_(row))
                # not in place: a monitor may keep x
                x = torch.addcmul(x, column, back, value=length, out=back)
                x = x.clamp_min_(0) if nonnegative else x
            length *= reduction
            yield Step(x)

    return solve(problem, steps())
