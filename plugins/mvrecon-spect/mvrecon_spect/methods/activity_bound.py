"""Empty bricks from counts: an upper bound of the activity of every brick of voxels, at a given
confidence.

Other activity in the scene only adds counts, so a brick of activity a, for which a set of pixels
expects S counts per unit of activity, yields at most n counts with a probability of at most delta
if a S > U(n, delta), the one-sided bound of a Poisson mean (Garwood, Biometrika 28, 1936). Hence a
<= U / S with confidence 1 - delta. The least of several such bounds holds too, if they share delta
and the sets do not depend on the counts.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, bricks_along
from mvrecon.kernels.cuda.bricks import Prints
from mvrecon.operators.visual_hull.footprints import (
    AT_ONCE,
    Bricks,
    footprint_sums,
    footprints_of,
    prints_of,
    summed_area_tables,
)
from mvrecon.operators.visual_hull.hull import REACH, check_measured, expand

#: Views in a group whose counts are added.
GROUP = 10
#: Newton's steps to the bound of a Poisson mean.
STEPS = 8


def support_of_counts(
    counts: Float[Tensor, "b 1 m v u"],
    cameras: Cameras,
    grid: Grid,
    sensitivity: Float[Tensor, "m z y x"],
    tolerance: float,
    delta: float = 1e-3,
    *,
    brick: int,
) -> Bool[Tensor, "b 1 d h w"]:
    """Return the voxels of the bricks whose activity may reach a tolerance, with confidence
    1 - delta, as for `A.with_support`.

    Args:
        counts: raw counts, whole numbers, without subtraction.
        cameras, grid: the rig and the voxels.
        sensitivity: see `activity_bound`.
        tolerance: activity, in the unit of the sensitivity, below which a brick is empty.
        delta: probability of at least one incorrect brick in a scene; each item of a batch is a
            scene.
        brick: edge in voxels.

    Raises:
        ValueError: a tolerance that is not positive; as `activity_bound`.
    """
    if not tolerance > 0:
        raise ValueError(f"A brick is empty below a positive tolerance, got {tolerance}")
    bound = activity_bound(counts, cameras, grid, brick, sensitivity, delta)
    return expand(bound >= tolerance, brick, grid.shape)


def activity_bound(
    counts: Float[Tensor, "b 1 m v u"],
    cameras: Cameras,
    grid: Grid,
    brick: int,
    sensitivity: Float[Tensor, "m z y x"],
    delta: float = 1e-3,
) -> Float[Tensor, "b z y x"]:
    """Return simultaneous upper bounds of the activity of every brick, at a confidence of 1 -
    delta.

    The activity is the brick's mean, weighted by the sensitivity of its voxels. The bound is the
    least of a fixed family of sets of views (`view_sets`); infinite where no view has sensitivity.

    Args:
        counts, cameras, grid, brick: see `support_of_counts`.
        sensitivity: expected counts of each view per unit of activity in a whole brick, as from
            `brick_sensitivity`. It must cover only pixels of the brick's footprint (not the tails
            of a wide point spread), and be a lower bound: with the least possible transmission of a
            mu-map.
        delta: shared evenly among all tests of all bricks.

    Raises:
        ValueError: counts of another size than the rig's, or not whole non-negative numbers; a
            sensitivity of another size or negative; delta outside (0, 1).
    """
    check_measured(counts, cameras, on_gpu=False)
    _check_counts(counts, sensitivity, (len(cameras), *bricks_along(grid.shape, brick)), delta)
    lattice, table = sensitivity.shape[1:], summed_area_tables(counts[:, 0].long())
    prints = prints_of(cameras, grid, 0.0)
    prints = prints._replace(numbers=prints.numbers.to(counts.device))
    sets = view_sets(len(cameras)).to(counts.device)
    n_bricks, at_once = math.prod(lattice), max(1, AT_ONCE // (len(cameras) * len(counts)))
    share, expected = delta / (n_bricks * len(sets)), sensitivity.to(sets).flatten(1)
    bounds = []
    for first in range(0, n_bricks, at_once):
        part = range(first, min(first + at_once, n_bricks))
        numbers, back = (sets @ _counted(table, prints, brick, grid, part).to(sets)).unique(
            return_inverse=True
        )
        bound = poisson_bound(numbers, share)[back] / (sets @ expected[:, part.start : part.stop])
        bounds.append(bound.amin(dim=1))
    return torch.cat(bounds, dim=-1).reshape(len(counts), *lattice)


def _counted(
    tables: Int[Tensor, "b m v1 u1"], prints: Prints, brick: int, grid: Grid, part: range
) -> Int[Tensor, "b m n"]:
    """The counts in the footprints of `part` of a grid's bricks, in the order z, y, x, from the
    views' summed-area tables.
    """
    detector = [n - 1 for n in tables.shape[2:]]
    flat = torch.arange(part.start, part.stop, device=tables.device)
    _, rows, columns = bricks_along(grid.shape, brick)
    place = torch.stack([flat // columns // rows, flat // columns % rows, flat % columns], dim=1)
    bricks = Bricks.at(place, brick, grid.shape)
    return footprint_sums(tables, footprints_of(prints, detector, grid.shape, bricks, REACH))


def view_sets(count: int) -> Float[Tensor, "t m"]:
    """The sets of views to test, as rows of ones: each view, consecutive groups of ten, and all; no
    duplicates.
    """
    single = torch.eye(count, dtype=torch.float64)
    groups = torch.arange(count) // GROUP == torch.arange(-(-count // GROUP))[:, None]
    return torch.cat([single, groups.to(single), torch.ones_like(single[:1])]).unique(dim=0)


def brick_sensitivity(
    backprojected: Float[Tensor, "m d h w"], brick: int
) -> Float[Tensor, "m z y x"]:
    """Return the expected counts of each view per unit of activity in every whole brick.

    Args:
        backprojected: for each view, the adjoint of ones in it and zeros in the others, times the
            counts per unit line integral.
        brick: edge of a brick in voxels.
    """
    d, h, w = backprojected.shape[1:]
    padded = torch.nn.functional.pad(backprojected, (0, -w % brick, 0, -h % brick, 0, -d % brick))
    return (
        padded.unflatten(3, (-1, brick))
        .unflatten(2, (-1, brick))
        .unflatten(1, (-1, brick))
        .sum(dim=(2, 4, 6))
    )


def poisson_bound(counts: Float[Tensor, "*n"], delta: float) -> Float[Tensor, "*n"]:
    """Return the mean U for which a Poisson variable is n or less with probability delta: half the
    1 - delta quantile of chi^2 with 2 n + 2 degrees of freedom; -ln delta for n = 0. Accurate to
    1e-9, as torch's incomplete gamma function.

    Newton's method, downwards from Chernoff's bound n + t + sqrt(t^2 + 2 n t), t = -ln delta: the
    log probability is concave in the mean, so no step passes U.
    """
    n, t = counts.to(torch.float64), -math.log(delta)
    U, constant = n + t + (t * t + 2 * n * t).sqrt(), (n + 1).lgamma()
    for _ in range(STEPS):
        below = torch.special.gammaincc(n + 1, U)
        slope = (n * U.log() - U - constant).exp() / below
        U = U + (below.log() + t) / slope
    return U


def _check_counts(
    counts: Float[Tensor, "b 1 m v u"],
    sensitivity: Float[Tensor, "m z y x"],
    sizes: tuple[int, ...],
    delta: float,
) -> None:
    if ((counts < 0) | (counts != counts.round())).any():
        low, high = counts.aminmax()
        raise ValueError(
            f"Expected counts, whole numbers from 0, got values between {low:g} and {high:g}"
        )
    if tuple(sensitivity.shape) != sizes:
        raise ValueError(
            f"Expected a sensitivity [m z y x] of {sizes} bricks, got {tuple(sensitivity.shape)}"
        )
    if not (sensitivity >= 0).all():
        raise ValueError(
            f"A sensitivity must not be negative or NaN, got {int((~(sensitivity >= 0)).sum())} "
            f"that are"
        )
    if not 0 < delta < 1:
        raise ValueError(f"A probability delta must lie between 0 and 1, got {delta}")
