"""The axis of rotation from conjugate rays: lines that two views in the sources' plane measure.

The ray at fan angle gamma is that at -gamma of the view half a turn less 2 gamma further (Parker,
Med. Phys. 9, 1982). Both measure one integral, whatever of the object lies beside, above or below
the panel, and a shift of the panel by s pixels moves them apart by 2 s: it is right where they
agree best. No volume is needed: one explains most of such a shift over a truncated half turn, so
that a fit of both was more than a pixel off.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import ROUNDING_ERROR
from mvrecon.geometry.grid import Grid
from mvrecon.methods.calibration.axis import KEPT, Axis, scatter
from mvrecon.methods.calibration.from_data import MAX_LEFT_OUT
from mvrecon.methods.classical.orbit import Orbit, fan_coordinate, orbit_of

#: Greatest shift relative to the columns, and at least so many.
REACH, MIN_REACH = 0.1, 4
#: Steps in pixels of the shifts, and of the parabola that is fitted at the best one; the second
#: where the uncertainty by noise is below the third figure; fits, each at the last one's minimum.
STEP, FINE_STEP, FINE_ERROR, FITS = 0.5, 0.25, 0.05, 5
#: Greatest deviation of a step between two views' angles, relative to it, and fewest views.
MAX_STEP_DEVIATION, MIN_VIEWS = 0.02, 8
#: Uncertainty in pixels without noise, in standard errors, and the largest of a shift found.
LEAST_PX, STANDARD_ERRORS, MOST_PX = 0.02, 3.0, 0.1
#: Rays about which the search compares, at even steps of views and columns; the fit takes all.
SEARCHED = 2**17


class _Lines(NamedTuple):
    """The line of each view that is in the plane of the sources, turned by equal steps in radians.

    Args:
        rows: integrals along these lines, one a column.
        camera: the first camera, whose row 0 is this line.
        orbit: the sources' orbit.
        step: angle between two views.
    """

    rows: Float[Tensor, "m u"]
    camera: Cameras
    orbit: Orbit
    step: float

    def differences(
        self, shift: float, every: int
    ) -> tuple[Float[Tensor, "n k"], Bool[Tensor, "n k"]]:
        """Differences between rays of a shifted panel, at so many views and columns each, and their
        conjugates, in the unit of the views, and which rays have one.

        Conjugates are interpolated, which averages noise. Unless its standard deviation were
        divided out, panels with conjugates half-way between pixels would agree best.
        """
        views, columns = self.rows.shape
        u = torch.arange(columns, dtype=torch.float64)
        fan = fan_coordinate(self.camera, self.orbit, u + shift, u.new_zeros(1))[0, 0]
        sign = 1 if fan[-1] > fan[0] else -1
        rays = fan[::every]
        right = torch.searchsorted(sign * fan, -sign * rays).clamp(1, columns - 1)
        column = right - (fan[right] + rays) / (fan[right] - fan[right - 1])
        angle = math.pi - (0 if self.camera.parallel else 2) * rays
        turn = abs(2 * math.pi / self.step)
        view = torch.arange(0, views, every).double()[:, None] + angle / self.step
        # rounding does not decide between the first and the last view
        view = torch.remainder(view + ROUNDING_ERROR, turn) - ROUNDING_ERROR
        last = views if abs(turn - views) < 0.5 else views - 1  # the first view follows
        inside = (view <= last + ROUNDING_ERROR) & (column >= -ROUNDING_ERROR)
        inside &= column <= columns - 1 + ROUNDING_ERROR
        i = view.floor().clamp(0, last - 1).long()
        j = column.floor().clamp(0, columns - 2).long().expand_as(i)
        a, b = view - i, column - j
        before, behind = (
            self.rows[k, j] * (1 - b) + self.rows[k, j + 1] * b for k in (i, (i + 1) % views)
        )
        variance = 1 + (a**2 + (1 - a) ** 2) * (b**2 + (1 - b) ** 2)
        measured = self.rows[::every, ::every]
        return (measured - before * (1 - a) - behind * a) / variance.sqrt(), inside

    def misfits(self, shifts: Float[Tensor, " k"], every: int = 1) -> Float[Tensor, "k n"]:
        """The contribution of each view to the mean square of the differences, from which the mean
        of each column over the views is subtracted: it is due to flat field, rings and scatter.
        Infinite where fewer than `MIN_VIEWS` views have conjugate rays.

        Only rays that have conjugates at all shifts count. Otherwise a greater shift loses rays of
        air, which have little noise, and the rest would agree worse in the mean.
        """
        found = [self.differences(shift, every) for shift in shifts.tolist()]
        inside = torch.stack([each for _, each in found]).all(dim=0)
        count, views = inside.sum(), inside.sum(dim=0)
        if views.max() < MIN_VIEWS:
            return self.rows.new_full((len(shifts), len(found[0][0])), torch.inf)
        parts = []
        for difference, _ in found:
            fixed = (difference * inside).sum(dim=0) / views.clamp_min(1)
            parts.append(((difference - fixed).square() * inside).sum(dim=1) / count)
        return torch.stack(parts)


@torch.no_grad()
def conjugate_axis(cameras: Cameras, views: Float[Tensor, "1 1 m v u"], grid: Grid) -> Axis:
    """Return the shift of all detectors along u by which conjugate rays agree best; 0 with infinite
    uncertainty for views that do not determine it: of parallel beams over half a turn, without
    contrast, at unequal steps, that differ from their conjugates by half of themselves, or of
    periodic objects, which agree as well at another shift.

    The uncertainty is three standard errors, from the spread of the contributions of
    groups of views, and at least 0.02 pixels. An object that moves, a wrong arc, or a tilt that the
    cameras do not have, between views half a turn apart looks like a shift: no conjugate ray tells
    them apart.

    Args:
        cameras: a rig on a circle, with rows across its axis.
        views: measured integrals.
        grid: a box about the object.
    """
    lines = _lines(cameras, views, grid)
    if lines is None:
        return KEPT
    reach = max(MIN_REACH, int(REACH * lines.rows.shape[1]))
    shifts = torch.arange(-reach, reach + STEP, STEP, dtype=torch.float64)
    every = math.ceil(math.sqrt(lines.rows.numel() / SEARCHED))
    sums = torch.stack([lines.misfits(shift[None], every).sum() for shift in shifts])
    best = shifts[sums.argmin()].item()
    if abs(best) == reach or not sums.isfinite().any():
        return KEPT
    step, five = STEP, torch.arange(-2.0, 3.0, dtype=torch.float64)
    change = error = least = curvature = math.inf
    for _ in range(FITS):
        places = step * five
        misfits = lines.misfits(best + places)
        slopes = places @ misfits / places.square().sum()  # of each view
        bend = places.square() - places.square().mean()
        curvature = (2 * (bend @ misfits.sum(dim=1)) / bend.square().sum()).item()
        if not 0 < curvature < math.inf:
            return KEPT
        change = -slopes.sum().item() / curvature
        best += max(-1.0, min(1.0, change))
        error = STANDARD_ERRORS * scatter(slopes) / curvature
        step = FINE_STEP if error < FINE_ERROR else STEP
        least = misfits[2].sum().item()
    if abs(best) > reach or abs(change) > STEP or error > MOST_PX:
        return KEPT
    # what a minimum as deep as this one has at the nearest of the shifts
    as_good = least + curvature * (STEP / 2) ** 2 / 2
    periodic = sums[(shifts - best).abs() > 1].min() < as_good
    if periodic or least > MAX_LEFT_OUT**2 * lines.rows.square().mean():
        return KEPT
    return Axis(best, max(LEAST_PX, error))


def _lines(cameras: Cameras, views: Float[Tensor, "1 1 m v u"], grid: Grid) -> _Lines | None:
    """The rows in the plane of the sources; None of rigs or views that have none."""
    try:
        orbit = orbit_of(cameras, grid)
    except ValueError:
        return None
    steps = torch.deg2rad(torch.remainder(orbit.angles.diff() + 180, 360) - 180)
    step = steps.mean().item()
    column, middle = cameras.project(orbit.centre[None])[:, 0, :2].median(dim=0).values.tolist()
    rows, columns = cameras.shape
    if columns < 2 or not -0.5 <= middle <= rows - 0.5:
        return None
    if not (steps - step).abs().max() <= MAX_STEP_DEVIATION * abs(step):
        return None
    # of a tilted detector, the line in the plane of the sources crosses its rows
    slope = -(cameras.u @ orbit.axis / (cameras.v @ orbit.axis)).median().item()
    u = torch.arange(columns, device=views.device)
    v = (middle + slope * (u.double() - column)).clamp(0, rows - 1)
    first = v.long().clamp_max(max(0, rows - 2))
    before, behind = (
        views[0, 0, :, k, u].double().cpu() for k in (first, (first + 1).clamp_max(rows - 1))
    )
    share, camera = (v - first).cpu(), cameras[:1]
    shift = (middle - slope * column) * camera.v
    source = camera.source + shift if camera.parallel else camera.source
    in_plane = camera.u + slope * camera.v
    camera = replace(camera, source=source, origin=camera.origin + shift, u=in_plane)
    return _Lines(before * (1 - share) + behind * share, camera, orbit, step)
