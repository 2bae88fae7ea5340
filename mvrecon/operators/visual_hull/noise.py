"""Empty bricks from noisy views: for X-rays by a threshold above the noise, for counts by an upper
bound of the activity that holds with a stated probability.

Counts prove nothing empty: a brick can be shown to hold less than a tolerance. Whatever else is in
the scene only adds counts, so a brick of activity a, from which a set of pixels is to expect S
counts per unit of activity, gives n counts or fewer with a probability of at most delta where a S >
U(n, delta), the one-sided bound of a Poisson mean (Garwood, Biometrika 28, 1936). So a <= U / S,
but for that probability. The least of several such bounds holds too, where each gets its part of
delta and the sets were chosen without a look at the counts.
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
#: Of what kernels are tried on.
DETECTOR = {"pixels": [40, 44], "pixel_mm": 1.0}
#: Witness views: how many noisy views must agree that a brick is empty.
WITNESSES = 3


@dataclass(frozen=True)
class Evidence:
    """How sure it is that the bricks left out are empty, where counts were bounded.

    Args:
        tolerance: mean activity of a brick, weighted by its sensitivity, that an empty one is
            below.
        delta: probability that one or more of a scene's bricks were declared empty and are not.
        tests: bounds per brick, among which delta was shared out.
    """

    tolerance: float
    delta: float
    tests: int


def noise_threshold(
    views: Float[Tensor, "b 1 m v u"], photons: float, sigmas: float = 4.0
) -> Float[Tensor, "b 1 m v u"]:
    """The background threshold of X-ray line integrals p: `sigmas` standard deviations of the
    photon noise, which is exp(p / 2) / sqrt(photons).

    A `visual_hull` of noisy views takes it as its threshold, with several witnesses. What gives no
    ray more may then be lost: at 1e5 photons and 4 sigma that is p = 0.013, or 0.6 mm of water.
    Behind so much matter that the noise grows faster than p the threshold stays as it is, at 2: a
    ray that hardly a photon passes is no sign of emptiness.

    Args:
        views: p = -ln(I / I0).
        photons: I0, of a pixel that nothing covers.
        sigmas: standard deviations.

    Raises:
        ValueError: photons or sigmas that are not positive.
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
    """The bricks whose activity may reach a tolerance, from Poisson counts, and how sure that is.

    Args:
        counts: raw counts, whole numbers; nothing subtracted.
        cameras, grid, brick: as of `visual_hull`.
        sensitivity: as of `activity_bound`.
        tolerance: activity, in the unit of the sensitivity, below which a brick counts as empty.
        delta: probability of one or more wrong bricks in a scene; each item of a batch is a scene.

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
    """Upper bounds of the activity of every brick, which all hold at once with a probability of at
    least 1 - delta.

    The activity bounded is the brick's mean, weighted with the sensitivity of its voxels. It is the
    least bound of a family of sets of views that does not depend on the data (`view_sets`);
    infinite where no view has sensitivity.

    Args:
        counts, cameras, grid, brick: as of `bounded_hull`.
        sensitivity: expected counts of each view from each brick if it is full of one unit of
            activity, as from `brick_sensitivity`. It must count only pixels of the brick's
            footprint on the detector (not the tails of a wide point spread), and be a lower bound:
            with the least transmission that a mu-map may leave.
        delta: shared out evenly among all tests of all bricks.

    Raises:
        ValueError: counts of another size than the rig's, or not whole numbers from zero; a
            sensitivity of another size or negative; a delta not between 0 and 1.
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
    """The sets of views, and what footprints are told from, made once for a rig on a device."""

    def made() -> tuple[Tensor, Prints]:
        prints = footprints.prints_of(cameras, grid, 0.0)
        prints = prints._replace(numbers=prints.numbers.to(like.device))
        return view_sets(len(cameras)).to(like.device), prints

    return device_cached(cameras, ("footprints of counts", grid_key(grid)), like, made)


def _bounds(counts: Float[Tensor, "b t n"], delta: float) -> Float[Tensor, "b t n"]:
    """`poisson_bound`, in main memory of every number once: there are few of them."""
    if counts.is_cuda:
        return poisson_bound(counts, delta)
    numbers, back = counts.unique(return_inverse=True)
    return poisson_bound(numbers, delta)[back]


def _self_test(device: str, dtype: torch.dtype, purpose: str) -> self_test.Errors:
    """Counts in the bricks of a small grid, of three views of pixels of which no two are alike."""
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
    """The sets of views that are tested, as rows of ones: each view, consecutive groups of ten, and
    all; none twice.
    """
    single = torch.eye(count, dtype=torch.float64)
    groups = torch.arange(count) // GROUP == torch.arange(-(-count // GROUP))[:, None]
    return torch.cat([single, groups.to(single), torch.ones_like(single[:1])]).unique(dim=0)


def brick_sensitivity(
    backprojected: Float[Tensor, "m d h w"], brick: int
) -> Float[Tensor, "m z y x"]:
    """Counts that each view is to expect from every brick full of one unit of activity.

    Args:
        backprojected: the adjoint of views of which only one is ones and the others zeros, for each
            view; times the counts that a line integral of one gives.
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
    """The mean U for which a Poisson variable is n or less with probability delta: half the 1 -
    delta quantile of chi^2 with 2 n + 2 degrees of freedom; -ln delta for n = 0. Accurate to 1e-9,
    as torch's incomplete gamma function.

    By Newton's steps down from Chernoff's bound n + t + sqrt(t^2 + 2 n t), t = -ln delta: the
    logarithm of the probability is a concave function of the mean, so that no step passes U.
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
