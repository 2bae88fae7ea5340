"""Whether another rig explains a scan's line integrals better than the stored one: mirrored views,
exchanged axes, an axis of rotation aside, another range of angles.

Each hypothesis is a set of cameras with an order of the views' axes. Few iterations of SIRT on a
coarse grid compare it with the stored rig; of those that leave less, the best ones are compared
again after more iterations. Views that end inside the object are explained by a grid that extends
beyond them.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.apps.scan import Scan
from mvrecon.core.parts import PROJECTORS
from mvrecon.data.projections.stack import Region
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import auto_grid, resolution
from mvrecon.geometry.grid import Grid, coarse
from mvrecon.methods.classical.orbit import orbit_of
from mvrecon.methods.classical.sirt import sirt
from mvrecon.operators.operator import Scaled

#: Voxels along the longest side of a slice and of a volume, and views.
SLICE_VOXELS, VOLUME_VOXELS, MAX_VIEWS = 32, 24, 40
#: Iterations of SIRT with momentum that find hypotheses, and that decide; hypotheses to decide on.
SEARCH_ITERATIONS, FINAL_ITERATIONS, MAX_HYPOTHESES = 8, 30, 4
#: A hypothesis is reported where it leaves less than this part of the stored rig's residual, and a
#: detector that is shifted where it leaves less than that one.
MAX_RESIDUAL_RATIO, MAX_SHIFTED_RATIO = 0.8, 0.98
#: Least difference of two residuals, the root of that of their squares, relative to the views. It
#: is above differences by discretisation and truncation, which reach 0.009 for right rigs of balls,
#: and grows as views get fewer than `MAX_VIEWS`, which wrong rigs explain as well; a smaller
#: residual of the stored rig explains the views. Of a shift, on which all views agree, it is above
#: rounding.
MIN_DIFFERENCE, MIN_SHIFT_DIFFERENCE = 0.01, 2e-3
#: Hypotheses whose residuals differ by less are equally good.
MAX_EQUAL_RATIO = 1.02
#: An offset of the detector is reported from so many pixels on, from so many pixels of the coarse
#: views, and from so many standard errors.
MIN_OFFSET_PX, MIN_COARSE_OFFSET_PX, MIN_STANDARD_ERRORS = 1.0, 0.1, 4.0
#: Residual beyond the views' noise from which on larger shifts are tried, and changes of axis and
#: angles together.
SUSPICIOUS_RESIDUAL = 0.1
#: Ranges of angles that are tried for views at equal steps, in degrees; deviation of a step, and
#: least change of the range, relative to it.
ARCS_DEGREES, MAX_STEP_DEVIATION, MIN_ARC_CHANGE = (360.0, 180.0), 0.02, 0.1
#: Mean value of both sides, or of an end, of the views, relative to the mean of their greatest
#: values, from which on they end inside the object; size of the grid for them, relative to theirs.
MIN_TRUNCATED_EDGE, EXTENDED_GRID_FACTOR = 0.05, 1.5
#: Median of the absolute value of a normal variable of unit variance.
MEDIAN_OF_NORMAL = 0.6745
#: What is asked of views that fit better in another orientation than in the stored one.
CURES = {
    "columns reversed": "does the rig turn the other way (camera.clockwise, or the other sign of "
    "the angles or of camera.arc_degrees), or are the images mirrored (views.flip_columns=true)? "
    "The two volumes are mirror images",
    "rows reversed": "do the rows of the views run upwards (views.flip_rows=true)?",
    "axes exchanged": "are the images stored as [u, v]? Expected [v, u], a row of the detector "
    "after the other; exchange the axes of the file (numpy: swapaxes(1, 2))",
    "axes exchanged and columns reversed": "are the images turned by a quarter? Turn them back, or "
    "exchange the axes of the file (numpy: swapaxes(1, 2)) and give views.flip_columns=true",
}
COLUMNS, ROWS, EXCHANGED, TURNED = CURES
#: The same: whether axes are exchanged, and those that are reversed afterwards.
ORDERS = {
    COLUMNS: (False, (-1,)),
    ROWS: (False, (-2,)),
    EXCHANGED: (True, ()),
    TURNED: (True, (-1,)),
}
STORED_ORDER = (False, ())
AXIS_CURE = "is the axis of rotation wrong? calibrate=[offset_u] fits it"
ARC_CURE = "are the angles or camera.arc_degrees wrong?"


def better_rig(seen: "SomeViews") -> str | None:
    """The sentence of the rig that explains views better than the stored one, or none."""
    if not seen.views.any():
        return None
    stored = seen.rig(seen.cameras)
    settled = seen.settled(stored)
    least = MIN_DIFFERENCE * MAX_VIEWS / len(seen.cameras)
    if settled < least:
        return None
    suspicious = _beyond(settled, seen.noise) > SUSPICIOUS_RESIDUAL
    axis, turned = _shifted(seen, stored, suspicious), _turned(seen, stored)
    mirrored, exchanged = _oriented(seen)
    best = _best(seen, (settled, stored), [*axis, *mirrored, *turned], 1.0)
    # of a nearly round object other faults look like exchanged axes
    alike = _best(seen, best, exchanged, MAX_RESIDUAL_RATIO) is not best
    if alike or (suspicious and _beyond(best[0], seen.noise) > SUSPICIOUS_RESIDUAL):
        # two changes can help together where neither does alone
        pairs = [both for rig in axis for both in _turned(seen, rig)]
        pairs += [both for rig in turned for both in _shifted(seen, rig, far=True)]
        best = _best(seen, best, pairs, MAX_RESIDUAL_RATIO)
    figure, rig = _best(seen, best, exchanged, MAX_RESIDUAL_RATIO)
    part, least = (
        (MAX_SHIFTED_RATIO, MIN_SHIFT_DIFFERENCE)
        if AXIS_CURE in rig.cure
        else (MAX_RESIDUAL_RATIO, least)
    )
    if figure >= part * settled or _beyond(settled, figure) < least:
        return None
    return (
        f"views {rig.words}, view NRMSE {figure:.2g} in place of {settled:.2g} (SIRT on a coarse "
        f"grid); {rig.cure}"
    )


def _beyond(a: float, b: float) -> float:
    """The root of the difference of two squares; zero where it is negative."""
    return math.sqrt(max(0.0, a * a - b * b))


class Rig(NamedTuple):
    """A hypothesis about the rig.

    Args:
        cameras: of the coarse views.
        order: of the views' axes, of `ORDERS` or `STORED_ORDER`.
        squares: of each view's residual after `SEARCH_ITERATIONS`, relative to those of all views.
        words: that state how the views fit it better; empty for the stored one.
        cure: what the user is asked.
    """

    cameras: Cameras
    order: tuple[bool, tuple[int, ...]]
    squares: Float[Tensor, " m"]
    words: str = ""
    cure: str = ""

    @property
    def nrmse(self) -> float:
        """The view NRMSE."""
        return self.squares.sum().sqrt().item()


class SomeViews(NamedTuple):
    """Some views of a scan, binned to the size of a coarse voxel's image.

    Args:
        scan: of line integrals, that they are of.
        numbers: of the views.
        first: the first view as it is stored.
        region: the pixels that are joined to one.
        cameras: stored ones of the coarse views.
        grid: coarse, about as large as what the views show.
        views: means of the measured pixels.
        mask: pixels with a measured one; zero elsewhere, and for views of zero.
        noise: NRMSE of the coarse views by the noise of single pixels.
    """

    scan: Scan
    numbers: Tensor
    first: Float[Tensor, "1 v u"]
    region: Region
    cameras: Cameras
    grid: Grid
    views: Float[Tensor, "1 1 m i j"]
    mask: Float[Tensor, "m i j"]
    noise: float

    @classmethod
    def of(cls, scan: Scan, grid: Grid, device: str = "cpu") -> Self:
        """Read the views, each once, for a coarse grid."""
        count = len(scan.cameras)
        numbers = torch.arange(0, count, math.ceil(count / MAX_VIEWS))
        region = _region(scan, grid)
        views, shares, noise, first = [], [], [], torch.empty(0)
        for number in numbers.tolist():
            part = scan.measured.read(number, number + 1)
            first = first if number else part.views
            mask = part.mask.to(part.views)
            values, share = (region.binned(region.cropped(x)) for x in (part.views * mask, mask))
            views.append(values / share.clamp_min(1e-9))
            shares.append(((share > 0) & values.any()).to(values))
            noise.append(noise_of(part.views).abs().median().item() / MEDIAN_OF_NORMAL)
        y, seen = torch.cat(views), torch.cat(shares)
        level = sum(noise) / len(noise) / math.sqrt(math.prod(region.binning))
        rms = y.double().square().mean().sqrt().item()
        return cls(
            scan,
            numbers,
            first,
            region,
            region.seen_by(scan.cameras[numbers]),
            _extended(grid, y),
            y[None, None].to(device),
            seen.to(device),
            level / rms if rms else 0.0,
        )

    @torch.no_grad()
    def squares(
        self,
        cameras: Cameras,
        iterations: int = SEARCH_ITERATIONS,
        order: tuple[bool, tuple[int, ...]] = STORED_ORDER,
    ) -> Float[Tensor, " m"]:
        """Of each view's residual by a hypothesis, relative to those of all views.

        Raises:
            ValueError: of a projector that refuses the cameras.
        """
        exchanged, reversed_axes = order
        y, mask = (x.mT if exchanged else x for x in (self.views, self.mask))
        y, mask = (x.flip(reversed_axes).contiguous() for x in (y, mask))
        A = PROJECTORS.from_config(self.scan.projector, grid=self.grid, cameras=cameras)
        A = A.to(y.device)
        A = A if mask.all() else Scaled(A, pixels=mask)
        rest = A(sirt(A, y, iterations, momentum=True)) - y
        squares = rest.double().square().sum(dim=(0, 1, 3, 4)).cpu()
        return squares / y.double().square().sum().item()

    def rig(self, cameras: Cameras, words: str = "", cure: str = "", order=STORED_ORDER) -> Rig:
        """A hypothesis with its residual; raises as `squares`."""
        return Rig(cameras, order, self.squares(cameras, order=order), words, cure)

    def settled(self, rig: Rig) -> float:
        """The view NRMSE after `FINAL_ITERATIONS` iterations."""
        return self.squares(rig.cameras, FINAL_ITERATIONS, rig.order).sum().sqrt().item()


def noise_of(view: Float[Tensor, "1 v u"]) -> Float[Tensor, "1 i j"]:
    """Second differences of a view along both axes, of a row along it, in which smooth parts vanish
    (Immerkaer, CVIU 64, 1996); of noise of independent pixels they have its variance.
    """
    rest, variance = view.double(), 1
    for dim in (-1, -2):
        if rest.shape[dim] > 2:
            rest, variance = rest.diff(n=2, dim=dim), 6 * variance
    return rest / math.sqrt(variance) if variance > 1 else torch.zeros_like(rest)


def coarse_grid(scan: Scan) -> Grid:
    """A coarse grid of the scan's box, or of the field of half of the views if that is larger."""
    box = scan.grid
    with suppress(ValueError):  # of a rig without a common field
        field = auto_grid(scan.cameras, seen_by=0.5)
        sizes = [
            [n * mm for n, mm in zip(grid.size, grid.spacing, strict=True)] for grid in (field, box)
        ]
        if all(a >= b * (1 - 1e-6) for a, b in zip(*sizes, strict=True)):
            box = field
    return coarse(box, SLICE_VOXELS if 1 in box.shape else VOLUME_VOXELS)


def _region(scan: Scan, grid: Grid) -> Region:
    """Pixels of the size of a voxel's image."""
    size = max(1, int(max(grid.spacing) / resolution(scan.cameras, grid.centre)))
    rows, columns = scan.cameras.shape
    joined = (min(size, rows), min(size, columns))
    kept = (0, rows - rows % joined[0]), (0, columns - columns % joined[1])
    return Region((rows, columns), kept[0], kept[1], joined)


def _extended(grid: Grid, views: Float[Tensor, "m i j"]) -> Grid:
    """The grid with more voxels of the same size along its sides, where views end inside the
    object.
    """
    top = views.flatten(1).amax(dim=1).mean().item()
    left, right, first, last = (
        views.select(*edge).mean().item() for edge in ((2, 0), (2, -1), (1, 0), (1, -1))
    )
    inside = [min(left, right)] if views.shape[2] > 1 else []  # not of a half fan
    inside += [max(first, last)] if views.shape[1] > 1 else []
    if not top > 0 or max(inside, default=0.0) < MIN_TRUNCATED_EDGE * top:
        return grid
    sizes = [n if n == 1 else math.ceil(n * EXTENDED_GRID_FACTOR) for n in grid.size]
    affine = grid.affine.clone()
    gap = affine.new_tensor([(a - b) / 2 for a, b in zip(grid.size, sizes, strict=True)])
    affine[:3, 3] = grid.to_world(gap)
    return Grid((sizes[2], sizes[1], sizes[0]), affine)


def _best(
    seen: SomeViews, known: tuple[float, Rig], rigs: Sequence[Rig], part: float
) -> tuple[float, Rig]:
    """The figure of the hypothesis that leaves least of the views, and it, if that is less than a
    part of the known one's; the first one of equally good ones.
    """
    better = [rig for rig in rigs if _beyond(known[1].nrmse, rig.nrmse) > MIN_SHIFT_DIFFERENCE]
    better = sorted(better, key=lambda rig: rig.nrmse)[:MAX_HYPOTHESES]
    figures = [(seen.settled(rig), rig) for rig in better]
    least = min((figure for figure, _ in figures), default=math.inf)
    if least >= part * known[0]:
        return known
    equal = [pair for pair in figures if pair[0] <= MAX_EQUAL_RATIO * least]
    return min(equal, key=lambda pair: next(n for n, rig in enumerate(rigs) if rig is pair[1]))


def _oriented(seen: SomeViews) -> tuple[list[Rig], list[Rig]]:
    """Rigs of mirrored views, and of exchanged axes unless the projector refuses such cameras.

    Of exchanged axes those with reversed rows are left out: of a circular scan they fit as well.
    Reversed rows of parallel beams are those of the mirrored object.
    """
    cameras, region = seen.scan.cameras[seen.numbers].transposed(), seen.region
    region = Region(cameras.shape, region.columns, region.rows, region.binning[::-1])
    swapped, parallel = region.seen_by(cameras), cameras.parallel
    mirrored, exchanged = [], []
    for name, rig, rigs in (
        (COLUMNS, seen.cameras, mirrored),
        (ROWS, None if parallel or 1 in swapped.shape else seen.cameras, mirrored),
        (EXCHANGED, None if 1 in swapped.shape else swapped, exchanged),
        (TURNED, None if parallel or 1 in swapped.shape else swapped, exchanged),
    ):
        with suppress(ValueError):
            if rig is not None:
                words = f"with their {name} fit the rig better"
                rigs.append(seen.rig(rig, words, CURES[name], ORDERS[name]))
    return mirrored, exchanged


def _shifted(seen: SomeViews, start: Rig, far: bool) -> list[Rig]:
    """The rig with its detectors shifted along u, if that explains the views better.

    If shifts by a pixel of the coarse views leave less, or far ones are asked for: shifts of 2, 4,
    ... pixels up to a third of the detector, halved about the best one. Then twice the vertex of a
    parabola through the least squares of the residual and its neighbours. The shift is reported
    where all views agree: a jackknife's standard error (Efron & Stein, Ann. Stat. 9, 1981) is far
    below it.
    """
    columns, pixels = start.cameras.shape[1], seen.region.binning[1]
    least = max(MIN_OFFSET_PX / pixels, MIN_COARSE_OFFSET_PX)
    axis = start.cameras.project(seen.grid.centre[None])[:, 0, 0].median().item()
    found = {0.0: start.squares}

    def at(shift: float) -> Float[Tensor, " m"]:
        """The squares; of a detector that the axis is not projected onto, which any object
        explains, infinite.
        """
        if shift not in found and 0 <= axis - shift <= columns - 1:
            cameras = start.cameras.shifted(torch.tensor([[shift, 0.0]]))
            found[shift] = seen.squares(cameras, SEARCH_ITERATIONS)
        return found.get(shift, torch.full_like(start.squares, math.inf))

    def best() -> float:
        return min(found, key=lambda shift: found[shift].sum().item())

    at(1.0), at(-1.0)
    if best() or far:
        gap = 2.0
        while gap <= columns / 3:
            at(gap), at(-gap)
            gap *= 2
        gap = abs(best()) / 4
        while gap >= 1:
            middle = best()
            at(middle - gap), at(middle + gap)
            gap /= 2
    shift, error = best(), 0.0
    for step in (1.0, 0.5):
        behind, here, ahead = (at(shift + side * step) for side in (-1, 0, 1))
        slope, bend = (behind - ahead) / 2, behind + ahead - 2 * here
        if not 0 < bend.sum() < math.inf:
            return []
        move = (slope.sum() / bend.sum()).clamp(-1, 1).item()
        error = step * ((slope - move * bend).norm() / bend.sum()).item()
        shift += step * move
        if abs(shift) < least / 2:
            return []
    if abs(shift) < max(least, MIN_STANDARD_ERRORS * error):
        return []
    moved = start.cameras.shifted(torch.tensor([[shift, 0.0]]))
    words = f"with the detector {pixels * shift:+.1f} pixels aside along u"
    return [seen.rig(moved, *_joined(start, words, AXIS_CURE))]


def _turned(seen: SomeViews, start: Rig) -> list[Rig]:
    """Rigs of views at equal steps over a full or a half circle, or the other way round; none where
    the cameras are not on a circle.
    """
    count = len(seen.scan.cameras)
    try:
        orbit = orbit_of(start.cameras, seen.grid)
    except ValueError:
        return []
    steps = (torch.remainder(orbit.angles.diff() + 180, 360) - 180) / seen.numbers[1]
    step = steps.mean().item()
    if (steps - step).abs().max() > MAX_STEP_DEVIATION * abs(step):
        return []
    arc = count * step
    rigs = []
    # parallel beams that turn the other way are those of the mirrored object
    reverse = [] if start.cameras.parallel else [-arc]
    for other in (*reverse, *(math.copysign(size, arc) for size in ARCS_DEGREES)):
        if abs(other - arc) > MIN_ARC_CHANGE * abs(other):
            cameras = orbit.turned(start.cameras, seen.numbers * (other / count - step))
            cure = CURES[COLUMNS] if other == -arc else ARC_CURE
            words = f"over {other:.0f} degrees instead of over {arc:.0f}"
            rigs.append(seen.rig(cameras, *_joined(start, words, cure)))
    return rigs


def _joined(start: Rig, words: str, cure: str) -> tuple[str, str]:
    """The words and the cure of a change of a rig that may have been changed before."""
    if not start.words:
        return f"fit the rig better {words}", cure
    return f"{start.words} and {words}", f"{start.cure}; {cure}"
