"""Whether another rig explains a scan's line integrals better than the stored one: mirrored views,
exchanged axes, an axis of rotation aside, another range of angles.

Each hypothesis is a set of cameras with an order of the views' axes. A few iterations of SIRT on a
coarse grid compare it with the stored rig; those that leave least are compared again after more
iterations. Views are blurred, so that the right rig explains them whatever the object's details.
Views that end inside the object are explained by a grid that extends beyond them.
"""

import math
from contextlib import suppress
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.apps.scan import Scan
from mvrecon.core.numbers import SIGMA_PER_MEDIAN, second_differences
from mvrecon.data.projections.stack import Region
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import auto_grid, extended_to_field, pixels_of_voxel
from mvrecon.geometry.grid import Grid, coarse
from mvrecon.methods.calibration.alignment import blurred
from mvrecon.methods.classical.orbit import orbit_of
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.classical.truncation import CUT_EDGE, edge_shares, ends_of
from mvrecon.operators.operator import Scaled

#: Size of the field, relative to a grid's, from which on the grid is only a part of the object.
FAR_LARGER = 2.0
#: Voxels along the longest side of a slice and of a volume, and views.
SLICE_VOXELS, VOLUME_VOXELS, MAX_VIEWS = 32, 24, 40
#: Standard deviation of the views' blur, in coarse pixels.
BLUR_PX = 1.0
#: Iterations of SIRT with momentum that find hypotheses, and that decide; hypotheses to decide on.
SEARCH_ITERATIONS, FINAL_ITERATIONS, MAX_HYPOTHESES = 8, 30, 4
#: View NRMSE beyond noise up to which a rig explains the views, and from which on another one is
#: sought than that with shifted detectors, and two faults at once.
MAX_EXPLAINED, MIN_CONTRADICTION, MIN_TWO_FAULTS = 0.005, 0.015, 0.05
#: Another rig is reported where it leaves less than this beyond noise, and than this part of what
#: the stored one leaves, together with those that leave up to so many times as much.
MAX_UNEXPLAINED, MAX_RESIDUAL_RATIO, MAX_ALIKE_RATIO = 0.1, 0.4, 1.5
#: Shifted detectors, on which all views agree, are reported where they leave less than this part,
#: and by this difference less, the root of that of the squares, which is above rounding.
MAX_SHIFTED_UNEXPLAINED, MAX_SHIFTED_RATIO, MIN_SHIFT_DIFFERENCE = 0.03, 0.98, 2e-3
#: An offset of the detector is reported from so many pixels on, from so many pixels of the coarse
#: views, and from so many standard errors.
MIN_OFFSET_PX, MIN_COARSE_OFFSET_PX, MIN_STANDARD_ERRORS = 1.0, 0.1, 4.0
#: Ranges of angles that are tried for views at equal steps, in degrees, the likeliest first, and
#: how many of them together with another axis; deviation of a step, and least change of the range,
#: relative to it.
ARCS_DEGREES, MAX_ARCS_ASIDE = (360, 180, 210, 240, 270, 300, 330), 3
MAX_STEP_DEVIATION, MIN_ARC_CHANGE = 0.02, 0.05
#: Greatest residual that wrong angles leave, relative to the variation between views: over half a
#: turn, a small object at a distance r from the axis is off-centre by r / sqrt(2) in its views
#: (root mean square), and by up to 2 r / pi in their mean.
MAX_LEFT_BY_ANGLES = (0.5 / (0.5 - 4 / math.pi**2)) ** 0.5
#: Size of the grid for views that end inside the object, relative to theirs.
EXTENDED_GRID_FACTOR = 1.5
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
    """The sentence of the rig that explains views better than the stored one, or of several ones if
    the views do not tell; or none.
    """
    if not seen.views.any():
        return None
    settled = seen.settled(seen.cameras)
    before = _beyond(settled, seen.noise)
    if before < MAX_EXPLAINED:
        return None
    stored = seen.rig(seen.cameras)
    contradicted = before > MIN_CONTRADICTION
    # of views cut at a side, as of a half fan, a slight shift may make up for coarse voxels
    slight = not seen.cut[1].any()
    axis = _shifted(seen, stored, contradicted) if contradicted or slight else []
    # angles do not affect the part that all views share: a body of revolution fits any
    by_angles = before <= MAX_LEFT_BY_ANGLES * seen.variation
    turned = _turned(seen) if contradicted and by_angles else []
    rigs = [*axis, *(_oriented(seen) if contradicted else ()), *turned]
    least = min((rig.nrmse for rig in rigs), default=0.0)
    if before > MIN_TWO_FAULTS and least > MAX_RESIDUAL_RATIO * stored.nrmse:
        # two changes can help together where neither does alone
        rigs += [both for rig in turned[:MAX_ARCS_ASIDE] for both in _shifted(seen, rig, far=True)]
    known = enumerate(rigs)  # their order decides among those that are equally good
    likely = sorted((r.nrmse, n, r) for n, r in known if r.nrmse < stored.nrmse)[:MAX_HYPOTHESES]
    found = [(n, seen.settled(rig.cameras, rig.order), rig) for _, n, rig in likely]
    least = max(MAX_EXPLAINED, min((_beyond(left, seen.noise) for _, left, _ in found), default=0))
    best: list[tuple[float, Rig]] = []
    for _, left, rig in sorted(found):
        if _beyond(left, seen.noise) > MAX_ALIKE_RATIO * least:
            continue
        if not any(other.cure in rig.cure for _, other in best):
            best.append((left, rig))
    if not best or not all(_reported(seen, rig, settled, left) for left, rig in best):
        return None
    figures = [f"{rig.words}, view NRMSE {left:.2g}" for left, rig in best]
    if len(best) == 1:
        return (
            f"views fit the rig better {figures[0]} in place of {settled:.2g} (SIRT on a coarse "
            f"grid); {best[0][1].cure}"
        )
    return (
        f"views do not fit the rig, view NRMSE {settled:.2g} (SIRT on a coarse grid), and do not "
        f"tell which of these is right: {', or '.join(figures)}"
    )


def _reported(seen: "SomeViews", rig: "Rig", settled: float, left: float) -> bool:
    """Whether a rig that leaves less than the stored one is named."""
    before, after = _beyond(settled, seen.noise), _beyond(left, seen.noise)
    if rig.cure == AXIS_CURE and after < MAX_SHIFTED_UNEXPLAINED and not seen.cut[1].any():
        return left < MAX_SHIFTED_RATIO * settled and _beyond(settled, left) > MIN_SHIFT_DIFFERENCE
    return after < min(MAX_UNEXPLAINED, MAX_RESIDUAL_RATIO * before)


def _beyond(a: float, b: float) -> float:
    """The root of the difference of two squares; zero where it is negative."""
    return math.sqrt(max(0.0, a * a - b * b))


class Rig(NamedTuple):
    """A hypothesis about the rig.

    Args:
        cameras: cameras of the coarse views.
        squares: squared norm of each view's residual after `SEARCH_ITERATIONS`, relative to that of
            all views.
        words: how the views fit this rig better, in words; empty for the stored one.
        cure: question that the warning asks the user.
        order: order of the views' axes, one of `ORDERS` or `STORED_ORDER`.
    """

    cameras: Cameras
    squares: Float[Tensor, " m"]
    words: str = ""
    cure: str = ""
    order: tuple[bool, tuple[int, ...]] = STORED_ORDER

    @property
    def nrmse(self) -> float:
        """The view NRMSE."""
        return self.squares.sum().sqrt().item()


class SomeViews(NamedTuple):
    """Some views of a scan, binned to the size of a coarse voxel's image.

    Args:
        scan: the scan, of line integrals.
        numbers: numbers of the views.
        first: the first view as it is stored.
        region: crop and binning from the detector to the coarse views.
        cameras: the rig as stored, for the coarse views.
        grid: coarse grid, about as large as what the views show.
        cut: whether views end inside the object at the first and the last row, and at the first and
            the last column: a half fan ends at one.
        views: blurred means of the measured pixels.
        mask: pixels with a measured one; zero elsewhere, and for views of zero.
        noise: NRMSE of the coarse views by the noise of single pixels.
    """

    scan: Scan
    numbers: Tensor
    first: Float[Tensor, "1 v u"]
    region: Region
    cameras: Cameras
    grid: Grid
    cut: Bool[Tensor, "2 2"]
    views: Float[Tensor, "1 1 m i j"]
    mask: Float[Tensor, "m i j"]
    noise: float

    @classmethod
    def of(cls, scan: Scan, grid: Grid, device: str = "cpu") -> Self:
        """Read the views, each once, for a coarse grid."""
        count = len(scan.cameras)
        numbers = torch.arange(0, count, math.ceil(count / MAX_VIEWS))
        region = _region(scan, grid)
        views, shares, noise, edges, first = [], [], [], [], torch.empty(0)
        for number in numbers.tolist():
            part = scan.measured.read(number, number + 1)
            first = first if number else part.views
            mask = part.mask.to(part.views)
            values, share = (region.binned(region.cropped(x)) for x in (part.views * mask, mask))
            views.append(values / share.clamp_min(1e-9))
            shares.append(((share > 0) & values.any()).to(values))
            edges.append(ends_of((part.views * mask)[None, None]))
            noise.append(SIGMA_PER_MEDIAN * noise_of(part.views).abs().median().item())
        y, seen = torch.cat(views), torch.cat(shares)
        cut = edge_shares(torch.cat(edges, dim=2))[0] > CUT_EDGE
        if cut[0].any() or cut[1].all():
            sizes = [n if n == 1 else math.ceil(n * EXTENDED_GRID_FACTOR) for n in grid.size]
            grid = grid.resized(sizes)
        y = blurred(y[None, None], BLUR_PX, seen > 0) * seen
        # pixels that a blurred one is the mean of, along an axis
        several = [2 * math.sqrt(math.pi) * BLUR_PX for size in seen.shape[1:] if size > 1]
        level = sum(noise) / len(noise) / math.sqrt(math.prod([*region.binning, *several]))
        rms = y.double().square().mean().sqrt().item()
        return cls(
            scan,
            numbers,
            first,
            region,
            region.seen_by(scan.cameras[numbers]),
            grid,
            cut,
            y.to(device),
            seen.to(device),
            level / rms if rms else 0.0,
        )

    @property
    def variation(self) -> float:
        """Deviation of the views from their mean, relative to them."""
        apart = self.views - self.views.mean(dim=2, keepdim=True)
        return (apart.norm() / self.views.norm()).item()

    @torch.no_grad()
    def squares(
        self,
        cameras: Cameras,
        iterations: int = SEARCH_ITERATIONS,
        order: tuple[bool, tuple[int, ...]] = STORED_ORDER,
    ) -> Float[Tensor, " m"]:
        """The square of each view's residual by a hypothesis, relative to those of all views.

        Raises:
            ValueError: the projector refuses the cameras.
        """
        exchanged, reversed_axes = order
        y, mask = (x.mT if exchanged else x for x in (self.views, self.mask))
        y, mask = (x.flip(reversed_axes).contiguous() for x in (y, mask))
        A = self.scan.on(self.grid, cameras).to(y.device)
        A = A if mask.all() else Scaled(A, pixels=mask)
        rest = A(sirt(A, y, iterations, momentum=True)) - y
        squares = rest.double().square().sum(dim=(0, 1, 3, 4)).cpu()
        return squares / y.double().square().sum().item()

    def rig(self, cameras: Cameras, words: str = "", cure: str = "", order=STORED_ORDER) -> Rig:
        """A hypothesis with its residual; raises as `squares`."""
        return Rig(cameras, self.squares(cameras, order=order), words, cure, order)

    def settled(
        self, cameras: Cameras, order: tuple[bool, tuple[int, ...]] = STORED_ORDER
    ) -> float:
        """The view NRMSE of a hypothesis after `FINAL_ITERATIONS` iterations; raises as
        `squares`.
        """
        return self.squares(cameras, FINAL_ITERATIONS, order).sum().sqrt().item()


def noise_of(view: Float[Tensor, "1 v u"]) -> Float[Tensor, "1 i j"]:
    """Second differences of a view along both axes, of a row along it; zero of fewer pixels."""
    dims = [dim for dim in (-1, -2) if view.shape[dim] > 2]
    rest = view.double() if dims else torch.zeros_like(view)
    for dim in dims:
        rest = second_differences(rest, dim)
    return rest


def coarse_grid(scan: Scan) -> Grid:
    """A coarse grid of the scan's box; instead, of the field of half of the views if that is larger
    along all axes, or of both if the field is far larger along one, as of a slice.
    """
    box = scan.grid
    with suppress(ValueError):  # of a rig without a common field
        field = auto_grid(scan.cameras, seen_by=0.5)
        sizes = [
            [n * mm for n, mm in zip(grid.size, grid.spacing, strict=True)] for grid in (field, box)
        ]
        if all(a >= b * (1 - 1e-6) for a, b in zip(*sizes, strict=True)):
            box = field
    whole = extended_to_field(scan.cameras, box)
    if any(n >= FAR_LARGER * own for n, own in zip(whole.size, box.size, strict=True)):
        box = whole
    return coarse(box, SLICE_VOXELS if 1 in box.shape else VOLUME_VOXELS)


def _region(scan: Scan, grid: Grid) -> Region:
    """Pixels of the size of a voxel's image."""
    size = pixels_of_voxel(scan.cameras, grid)
    rows, columns = scan.cameras.shape
    joined = (min(size, rows), min(size, columns))
    kept = (0, rows - rows % joined[0]), (0, columns - columns % joined[1])
    return Region((rows, columns), kept[0], kept[1], joined)


def _oriented(seen: SomeViews) -> list[Rig]:
    """Rigs of mirrored views, and of exchanged axes unless the projector refuses such cameras.

    Of exchanged axes those with reversed rows are left out: of a circular scan they fit as well.
    Reversed rows of parallel beams are those of the mirrored object. Exchanged views that end
    inside the object on their sides are explained by almost any object.
    """
    cameras, region = seen.scan.cameras[seen.numbers].transposed(), seen.region
    region = Region(cameras.shape, region.columns, region.rows, region.binning[::-1])
    swapped, parallel = region.seen_by(cameras), cameras.parallel
    row = 1 in swapped.shape
    other = None if row or seen.cut[0].all() else swapped
    same = None if seen.cut[1].all() else seen.cameras
    rigs = []
    for name, rig in (
        (COLUMNS, same),
        (ROWS, None if parallel or row else same),
        (EXCHANGED, other),
        (TURNED, None if parallel else other),
    ):
        with suppress(ValueError):
            if rig is not None:
                rigs.append(seen.rig(rig, f"with their {name}", CURES[name], ORDERS[name]))
    return rigs


def _shifted(seen: SomeViews, start: Rig, far: bool) -> list[Rig]:
    """The rig with its detectors shifted along u, if that explains the views better.

    If shifts by a pixel of the coarse views leave less, or far ones are asked for: shifts of 2, 4,
    ... pixels up to a third of the detector, halved about the best one. Then twice the vertex of a
    parabola through the least squares of the residual and its neighbours. The shift is reported
    where all views agree: a jackknife's standard error (Efron & Stein, Ann. Stat. 9, 1981) is far
    below it.
    """
    columns, pixels = start.cameras.shape[1], seen.region.binning[not start.order[0]]
    least = max(MIN_OFFSET_PX / pixels, MIN_COARSE_OFFSET_PX)
    axis = start.cameras.project(seen.grid.centre[None])[:, 0, 0].median().item()
    iterations, found = SEARCH_ITERATIONS, {0.0: start.squares}
    if seen.cut[1].any():  # as of a half fan, which few of them place pixels aside
        iterations, found = FINAL_ITERATIONS, {}

    def at(shift: float) -> Float[Tensor, " m"]:
        """The squares; of a detector that the axis is not projected onto, which any object
        explains, infinite.
        """
        if shift not in found and 0 <= axis - shift <= columns - 1:
            cameras = start.cameras.shifted(torch.tensor([[shift, 0.0]]))
            found[shift] = seen.squares(cameras, iterations, start.order)
        return found.get(shift, torch.full_like(start.squares, math.inf))

    def best() -> float:
        return min(found, key=lambda shift: found[shift].sum().item())

    at(0.0), at(1.0), at(-1.0)
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
    if start.words:
        words = f"{start.words} and {words}"
    cure = f"{start.cure}; {AXIS_CURE}" if start.cure else AXIS_CURE
    return [seen.rig(moved, words, cure, start.order)]


def _turned(seen: SomeViews) -> list[Rig]:
    """Rigs of views at equal steps over a full circle or a part of it, or the other way round; none
    where the cameras are not on a circle, or views end inside the object at a side, of which half a
    turn is explained by almost any object.
    """
    count = len(seen.scan.cameras)
    if seen.cut[1].any():
        return []
    try:
        orbit = orbit_of(seen.cameras, seen.grid)
    except ValueError:
        return []
    steps = (torch.remainder(orbit.angles.diff() + 180, 360) - 180) / seen.numbers[1]
    step = steps.mean().item()
    if (steps - step).abs().max() > MAX_STEP_DEVIATION * abs(step):
        return []
    arc, rigs = count * step, []
    # parallel beams that turn the other way are those of the mirrored object
    reverse = [] if seen.cameras.parallel else [-arc]
    for other in (*reverse, *(math.copysign(size, arc) for size in ARCS_DEGREES)):
        if abs(other - arc) > MIN_ARC_CHANGE * abs(other):
            cameras = orbit.turned(seen.cameras, seen.numbers * (other / count - step))
            cure = CURES[COLUMNS] if other == -arc else ARC_CURE
            words = f"over {other:.0f} degrees instead of over {arc:.0f}"
            rigs.append(seen.rig(cameras, words, cure))
    return rigs
