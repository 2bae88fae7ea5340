"""Empty bricks from noisy views: for X-rays by a threshold above the noise, for counts by an upper
bound of the activity at a given confidence.

Counts can only bound the activity of a brick. Other activity in the scene only adds counts, so a
brick of activity a, for which a set of pixels expects S counts per unit of activity, yields at most
n counts with a probability of at most delta if a S > U(n, delta), the one-sided bound of a Poisson
mean (Garwood, Biometrika 28, 1936). Hence a <= U / S with confidence 1 - delta. The least of
several such bounds holds too, if they share delta and the sets do not depend on the counts.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, bricks_along
from mvrecon.kernels import self_test
from mvrecon.kernels.cuda.bricks import Prints
from mvrecon.kernels.device_cache import device_cached, grid_key
from mvrecon.operators.visual_hull import footprints
from mvrecon.operators.visual_hull.hull import REACH, check_measured

#: Views in a group whose counts are added.
GROUP = 10
#: Newton's steps to the bound of a Poisson mean.
STEPS = 8
#: Device of the self-test.
DETECTOR = {"pixels": [40, 44], "pixel_mm": 1.0}
#: Default number of noisy views that must prove a brick empty.
WITNESSES = 3


@dataclass(frozen=True)
class Evidence:
    """Confidence that the empty bricks are empty, from bounded counts.

    Args:
        tolerance: upper bound of an empty brick's mean activity, weighted by its sensitivity.
        delta: probability that at least one of a scene's empty bricks is not.
        tests: bounds per brick that share delta.
    """

    tolerance: float
    delta: float
    tests: int


def noise_threshold(
    views: Float[Tensor, "b 1 m v u"], photons: float, sigmas: float = 4.0
) -> Float[Tensor, "b 1 m v u"]:
    """Return the background threshold of X-ray line integrals p: `sigmas` standard deviations of
    the photon noise, exp(p / 2) / sqrt(photons).

    For `visual_hull` of noisy views, with several witnesses. Objects that add less to every ray may
    be lost: at 1e5 photons and 4 sigma p = 0.013, or 0.6 mm of water. Beyond p = 2, where the noise
    grows faster than p, the threshold is constant: a ray with hardly a photon is no sign of
    emptiness.

    Args:
        views: p = -ln(I / I0).
        photons: I0, of an unattenuated pixel.
        sigmas: standard deviations.

    Raises:
        ValueError: photons or sigmas are not positive.
    """
    if not (photons > 0 and sigmas > 0):
        raise ValueError(f"Noise needs positive photons and sigmas, got {photons} and {sigmas}")
    steepest = 2 * math.log(2 * math.sqrt(photons) / sigmas)
    return sigmas * (views.clamp(max=steepest) / 2).exp() / math.sqrt(photons)


def bounded_hull(
    counts: Float[Tensor, "b 1 m v u"],
    cameras: Cameras,
    grid: Grid,
    brick: int,
    sensitivity: Float[Tensor, "m z y x"],
    tolerance: float,
    delta: float = 1e-3,
) -> tuple[Bool[Tensor, "b z y x"], Evidence]:
    """Return the bricks whose activity may reach a tolerance, from Poisson counts, with the
    confidence.

    Args:
        counts: raw counts, whole numbers, without subtraction.
        cameras, grid, brick: as of `visual_hull`.
        sensitivity: as of `activity_bound`.
        tolerance: activity, in the unit of the sensitivity, below which a brick is empty.
        delta: probability of at least one wrong brick in a scene; each item of a batch is a scene.

    Raises:
        ValueError: a tolerance that is not positive; as `activity_bound`.
    """
    if not tolerance > 0:
        raise ValueError(f"A brick is empty below a positive tolerance, got {tolerance}")
    bound = activity_bound(counts, cameras, grid, brick, sensitivity, delta)
    return bound >= tolerance, Evidence(tolerance, delta, len(view_sets(len(cameras))))


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
        counts, cameras, grid, brick: as of `bounded_hull`.
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
    lattice, table = sensitivity.shape[1:], footprints.summed_area_tables(counts[:, 0])
    sets, prints = _known(cameras, grid, counts)
    n_bricks, at_once = (
        math.prod(lattice),
        max(1, footprints.AT_ONCE // (len(cameras) * len(counts))),
    )
    share, expected = delta / (n_bricks * len(sets)), sensitivity.to(sets).flatten(1)
    there = counts.is_cuda and not self_test.failure(
        counts.device, "counts", torch.float64, _self_test
    )
    counting = footprints.counted_at_once if there else footprints.counted
    bounds = []
    for first in range(0, n_bricks, at_once):
        part = range(first, min(first + at_once, n_bricks))
        sums = counting(table, prints, brick, REACH, grid.shape, part).to(sets)
        bound = _bounds(sets @ sums, share) / (sets @ expected[:, part.start : part.stop])
        bounds.append(bound.amin(dim=1))
    return torch.cat(bounds, dim=-1).reshape(len(counts), *lattice)


def _known(cameras: Cameras, grid: Grid, like: Tensor) -> tuple[Float[Tensor, "t m"], Prints]:
    """The sets of views and the footprints' data, cached for a rig on a device."""

    def made() -> tuple[Tensor, Prints]:
        prints = footprints.prints_of(cameras, grid, 0.0)
        prints = prints._replace(numbers=prints.numbers.to(like.device))
        return view_sets(len(cameras)).to(like.device), prints

    return device_cached(cameras, ("footprints of counts", grid_key(grid)), like, made)


def _bounds(counts: Float[Tensor, "b t n"], delta: float) -> Float[Tensor, "b t n"]:
    """`poisson_bound`, computed in main memory once for each distinct number."""
    if counts.is_cuda:
        return poisson_bound(counts, delta)
    numbers, back = counts.unique(return_inverse=True)
    return poisson_bound(numbers, delta)[back]


def _self_test(device: str, dtype: torch.dtype, purpose: str) -> self_test.Errors:
    """Counts in the bricks of a small grid, of three views with distinct pixels."""
    cameras = CAMERAS.build("circular", n_views=3, sid=40.0, sdd=70.0, detector=DETECTOR)
    grid = Grid.centred(size=(13, 12, 10), spacing=1.5)
    views = torch.arange(3.0 * math.prod(cameras.shape), device=device)
    table = footprints.summed_area_tables(views.reshape(1, 3, *cameras.shape))
    _, prints = _known(cameras, grid, views)
    rest = table, prints, 4, REACH, grid.shape, range(5, 30)
    yield (
        "counts",
        self_test.error_of(
            footprints.counted_at_once(*rest).double(), footprints.counted(*rest).double()
        ),
    )


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
