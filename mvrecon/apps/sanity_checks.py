"""Sanity checks of a reconstruction that raised no error: mirrored views, exchanged axes, a wrong
axis of rotation or range of angles, counts read as line integrals, a volume that does not explain
its views.
"""

import inspect
import math
import warnings
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.apps.run_method import Outcome
from mvrecon.apps.scan import ATTENUATION, Scan, ViewsInMemory
from mvrecon.core.parts import METHODS, PROJECTORS
from mvrecon.data.attenuation import WATER
from mvrecon.data.projections.stack import Region
from mvrecon.data.projections.views import MeasuredViews
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.field import resolution
from mvrecon.geometry.grid import coarse
from mvrecon.methods.classical.orbit import orbit_of
from mvrecon.methods.classical.sirt import sirt
from mvrecon.operators.operator import Projector, sees_integrals
from mvrecon.report.metrics import nrmse

#: Voxels along the grid's longest side, views, and iterations of SIRT that detect mirrored views.
VOXELS, VIEWS, ITERATIONS = 32, 40, 8
#: Views in another orientation are reported where they leave less than this part of the residual.
BETTER = 0.75
#: An offset of the detector is reported from so many pixels on, from so many pixels of the coarse
#: views, and from so many standard errors, where it leaves less than this part of the residual.
ASIDE, FINE, SURE, CENTRED = 1.0, 0.1, 4.0, 0.98
#: View NRMSE on the coarse grid from which on changes of axis and angles are tried together,
#: although neither helps alone.
UNEXPLAINED = 0.15
#: Ranges of angles that are tried for views at equal steps, in degrees; deviation of a step, and
#: least change of the range, relative to it; iterations that compare rigs, as a range matters
#: little where an object is nearly round.
ARCS, UNEVEN, DIFFERENT, ROUND = (360.0, 180.0), 0.02, 0.1, 30
#: Attenuation relative to water's, above that of any matter at 60 keV, where lead has 300.
IMPOSSIBLE = 500.0
#: View NRMSE above which a volume does not explain its views.
POOR = 0.25
#: View NRMSE above which a volume does not explain its views, by that of their noise.
ABOVE_NOISE = 1.25
#: A method needs more views where it leaves at least this part of the residual of consistent ones,
#: and twice as much as of so many times as many.
FEW, DENSER = 0.5, 4
#: Quantile of an activity's voxels; a voxel of more than so many times its value fits noise.
MOST, HOT = 0.999, 50.0
#: Line integral that no X-ray comes through: 2e-9 of it does.
OPAQUE = 20.0
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
STORED, COLUMNS, ROWS, EXCHANGED, TURNED = "stored", *CURES


def sanity_checks(
    scan: Scan,
    method: str,
    outcome: Outcome,
    device: str = "cpu",
    as_read: MeasuredViews | ViewsInMemory | None = None,
) -> list[str]:
    """Return the failed checks of a scan's reconstruction, as sentences.

    A projector of weighted integrals, or without `pixel_integral`, is checked by the residual of
    its volume alone; a method declares its data, `declares`.

    Args:
        scan: that was reconstructed.
        method: name of the method.
        outcome: its volume, in the unit of the views per mm.
        device: for the comparison.
        as_read: the views before a correction, which leaves no whole counts; None: the scan's.
    """
    words: list[str] = []
    limit, view_nrmse = POOR, outcome.view_nrmse
    orders, kind = _orders(scan), getattr(METHODS.get(method), "data_kind", "integrals")
    if outcome.lost:
        words.append(
            f"lost views, zero everywhere: {', '.join(map(str, outcome.lost))} (from 0); "
            f"correct=align replaces them by the volume's"
        )
    if sees_integrals(orders[0].A):
        first, views = _read(scan, orders)
        if kind == "integrals":
            words += _of_counts(first)
            times = outcome.volume.max().item() / WATER
            if scan.unit == ATTENUATION and times > IMPOSSIBLE and not words:
                words.append(
                    f"the volume reaches {times:.0f} times the attenuation of water: expected "
                    f"lengths in mm, are the rig's and the grid's in metres?"
                )
        figures = _nrmse(orders, views, device)
        best = min(figures, key=lambda name: figures[name])
        oriented, moved = figures[best] < BETTER * figures[STORED], None
        if not words:
            with suppress(ValueError):  # of a projector that refuses such cameras
                moved = _Rigs(scan, orders[0], views[0][:1].to(device)).best()
        # a moved rig can look like exchanged axes, which it then explains better; reversed columns
        # are a reversed rotation, too
        if moved and (not oriented or moved[0] < CENTRED * _settled(best, orders, views, device)):
            words.append(moved[1])
        elif oriented:
            words.append(
                f"views with their {best} fit the rig better, view NRMSE {figures[best]:.2g} in "
                f"place of {figures[STORED]:.2g} (SIRT on a coarse grid); {CURES[best]}"
            )
    elif kind == "counts":
        noise = _noise_of_counts((as_read or scan.measured).read(0, 1).views)
        limit = max(POOR, ABOVE_NOISE * (noise or 0))
        if noise is None and view_nrmse > POOR:
            words.append(
                f"expected counts, got numbers that are not whole, which the volume does not "
                f"explain (view NRMSE {view_nrmse:.2g}); projector=drr is for line integrals"
            )
        elif noise is not None:
            words += _of_hot_voxels(outcome.volume)
    if view_nrmse > limit and not words:
        cause = "" if kind == "counts" else _cause(scan, method, orders[0], view_nrmse)
        words.append(
            f"the volume does not explain the views (view NRMSE {view_nrmse:.2g}); "
            + (
                cause
                or "look at rig.png, and whether lengths are mm, the views whole, the grid "
                "large enough, and a network was trained for such views"
            )
        )
    return words


def _cause(scan: Scan, method: str, order: "_Order", view_nrmse: float) -> str:
    """Why a volume does not explain line integrals, where that is not the rig: their noise, or a
    method that needs more views; else empty.

    A method needs more views where its volume explains neither these views nor, on a coarse grid,
    those of a known volume by the same rig, but those of four times as many cameras on its orbit.
    """
    if not sees_integrals(order.A):
        return ""
    noise = _noise(scan.measured.read(0, 1).views)
    if view_nrmse < ABOVE_NOISE * noise:
        return (
            f"their noise alone is about {noise:.2g} of them, by the second differences of pixels"
        )
    part = METHODS.get(method)
    if not inspect.isfunction(part):
        return ""
    A, y = order.A, _read(scan, [order])[1][0][:1]
    with suppress(ValueError), torch.no_grad():  # cameras that are not on a circle
        x = sirt(A, y, ITERATIONS, momentum=True)
        orbit = orbit_of(A.cameras, A.grid)
        step = (torch.remainder(orbit.angles.diff() + 180, 360) - 180).mean()
        turns = (step.expand(len(A.cameras)) * k / DENSER for k in range(DENSER))
        rigs = [orbit.turned(A.cameras, turn) for turn in turns]
        dense: dict[str, Any] = {
            name: torch.stack([getattr(rig, name) for rig in rigs], dim=1).flatten(0, 1)
            for name in VECTORS
        }
        rig = replace(A.cameras, **dense)
        few, many = (
            nrmse(B(part(B, B(x))), B(x))
            for B in (A, PROJECTORS.from_config(scan.projector, grid=A.grid, cameras=rig))
        )
        if few > max(FEW * view_nrmse, 2 * many):
            return (
                f"{method} of {len(scan.cameras)} views leaves {few:.2g} of views that fit this "
                f"rig, and {many:.2g} of {DENSER} times as many: these are too few for it, and an "
                f"iterative method such as sirt explains them better"
            )
    return ""


def _noise(view: Float[Tensor, "1 v u"]) -> float:
    """NRMSE of a view's noise, of independent pixels, by second differences along both axes, in
    which smooth parts vanish (Immerkaer, CVIU 64, 1996).
    """
    rest = view.double().diff(n=2, dim=-1).diff(n=2, dim=-2)
    if not rest.numel() or not view.any():
        return 0.0
    return (rest.square().mean().sqrt() / 6 / view.double().square().mean().sqrt()).item()


class _Rig(NamedTuple):
    """A hypothesis about the rig.

    Args:
        cameras: on the coarse grid.
        squares: of each view's residual after `ITERATIONS`, relative to those of all views.
        words: that state the change of the rig; empty for the stored one.
        cure: what the user is asked.
    """

    cameras: Cameras
    squares: Float[Tensor, " m"]
    words: str = ""
    cure: str = ""

    @property
    def nrmse(self) -> float:
        """The view NRMSE."""
        return self.squares.sum().sqrt().item()


class _Rigs:
    """The rigs that may explain the views better than the stored one: an axis of rotation aside,
    another range of angles, and both.

    Args:
        scan: its projector and numbers of views.
        order: of the stored axes.
        views: the stored ones.
    """

    def __init__(self, scan: Scan, order: "_Order", views: Float[Tensor, "1 1 m i j"]):
        self._scan, self._order, self._views = scan, order, views
        self._stored = self._rig(order.A.cameras)

    def best(self) -> tuple[float, str] | None:
        """The view NRMSE and the sentence of the rig that explains the views best, or none, where
        the stored one does about as well.
        """
        least = self._stored.nrmse
        axes, arcs = self._axes(self._stored), self._arcs(self._stored)
        # two changes can help together where neither does alone
        limit = least if least < UNEXPLAINED else math.inf
        pairs = [both for rig in axes if rig.nrmse < limit for both in self._arcs(rig)]
        pairs += [both for rig in arcs if rig.nrmse < limit for both in self._axes(rig)]
        stored = after = self._settled(self._stored)
        best = self._stored
        for kind, part in (([*axes, *arcs], 1.0), (pairs, BETTER)):
            figures = [(self._settled(rig), rig) for rig in kind if rig.nrmse < least]
            figure, rig = min(figures, key=lambda pair: pair[0], default=(math.inf, best))
            if figure < part * after:
                after, best = figure, rig
        if after >= (CENTRED if "aside" in best.words else BETTER) * stored:
            return None
        return after, (
            f"views fit the rig better {best.words}, view NRMSE {after:.2g} in place of "
            f"{stored:.2g} (SIRT on a coarse grid); {best.cure}"
        )

    def _rig(self, cameras: Cameras, words: str = "", cure: str = "") -> _Rig:
        return _Rig(cameras, self._squares(cameras, ITERATIONS), words, cure)

    def _settled(self, rig: _Rig) -> float:
        """The view NRMSE after `ROUND` iterations."""
        return self._squares(rig.cameras, ROUND).sum().sqrt().item()

    @torch.no_grad()
    def _squares(self, cameras: Cameras, iterations: int) -> Float[Tensor, " m"]:
        A = PROJECTORS.from_config(self._scan.projector, grid=self._order.A.grid, cameras=cameras)
        A = A.to(self._views.device)
        rest = A(sirt(A, self._views, iterations, momentum=True)) - self._views
        squares = rest.double().square().sum(dim=(0, 1, 3, 4)).cpu()
        return squares / self._views.double().square().sum().item()

    def _axes(self, start: _Rig) -> list[_Rig]:
        """The rig with its detectors shifted along u, if that explains the views better.

        Shifts of 1, 2, 4, ... pixels of the coarse views up to a third of the detector, halved
        about the best one; then twice the vertex of a parabola through the least squares of the
        residual and its neighbours. The shift is reported where all views agree: a jackknife's
        standard error (Efron & Stein, Ann. Stat. 9, 1981) is far below it.
        """
        columns, pixels = start.cameras.shape[1], self._order.region.binning[1]
        found = {0.0: start.squares}

        def at(shift: float) -> Float[Tensor, " m"]:
            if shift not in found:
                cameras = start.cameras.shifted(torch.tensor([[shift, 0.0]]))
                found[shift] = self._squares(cameras, ITERATIONS)
            return found[shift]

        def best() -> float:
            return min(found, key=lambda shift: found[shift].sum().item())

        gap = 1.0
        while gap <= max(columns / 3, 1.0):
            at(gap), at(-gap)
            gap *= 2
        gap = abs(best()) / 4 or 1.0
        while gap >= 1:
            middle = best()
            at(middle - gap), at(middle + gap)
            gap /= 2
        shift, error = best(), 0.0
        for step in (1.0, 0.5):
            behind, here, ahead = (at(shift + side * step) for side in (-1, 0, 1))
            slope, bend = (behind - ahead) / 2, behind + ahead - 2 * here
            if not bend.sum() > 0:
                return []
            move = (slope.sum() / bend.sum()).clamp(-1, 1).item()
            error = step * ((slope - move * bend).norm() / bend.sum()).item()
            shift += step * move
        if abs(shift) < max(ASIDE / pixels, FINE, SURE * error):
            return []
        moved = start.cameras.shifted(torch.tensor([[shift, 0.0]]))
        words = f"with the detector {pixels * shift:+.1f} pixels aside along u"
        cure = "is the axis of rotation wrong? calibrate=[offset_u] fits it"
        return [self._rig(moved, *_joined(start, words, cure))]

    def _arcs(self, start: _Rig) -> list[_Rig]:
        """Rigs of views at equal steps over a full or a half circle, or the other way round; none
        where the cameras are not on a circle.
        """
        numbers, count = torch.tensor(_numbers(self._scan)), len(self._scan.cameras)
        try:
            orbit = orbit_of(start.cameras, self._order.A.grid)
        except ValueError:
            return []
        steps = torch.remainder(orbit.angles.diff() + 180, 360) - 180
        step = steps.mean() / numbers[1]
        if (steps / numbers[1] - step).abs().max() > UNEVEN * step.abs():
            return []
        arc = count * step.item()
        rigs = []
        for other in (-arc, *(math.copysign(size, arc) for size in ARCS)):
            if abs(other - arc) > DIFFERENT * abs(other):
                cameras = orbit.turned(start.cameras, numbers * (other / count - step))
                cure = "are the angles or camera.arc_degrees wrong?"
                cure = CURES[COLUMNS] if other == -arc else cure
                words = f"over {other:.0f} degrees instead of over {arc:.0f}"
                rigs.append(self._rig(cameras, *_joined(start, words, cure)))
        return rigs


def _joined(start: _Rig, words: str, cure: str) -> tuple[str, str]:
    """The words and the cure of a change of a rig that has been changed before."""
    if not start.words:
        return words, cure
    return f"{start.words} and {words}", f"{start.cure}; {cure}"


def _of_counts(view: Float[Tensor, "1 v u"]) -> list[str]:
    """Check for a view whose values are whole numbers too large for line integrals."""
    if view.max() <= OPAQUE or not _whole(view):
        return []
    return [
        f"expected line integrals, got whole numbers up to {view.max().item():g}; grey values want "
        f"views.kind=intensities and views.flat, counts of emission osem"
    ]


def _of_hot_voxels(volume: Float[Tensor, "d h w"]) -> list[str]:
    """Check for voxels that are far above almost all others."""
    values = volume.flatten().sort().values
    high, most = values[int(MOST * (len(values) - 1))].item(), values[-1].item()
    if not 0 < HOT * high < most:
        return []
    return [
        f"single voxels reach {most / high:.0f} times the {100 * MOST:g}th percentile: unless the "
        f"object is a point, the volume fits the noise of the counts; use fewer iterations "
        f"(method.iterations), or bsrem, which has a prior"
    ]


def _noise_of_counts(view: Float[Tensor, "1 v u"]) -> float | None:
    """NRMSE of a view's Poisson noise, where it holds counts, or counts times a factor, the least
    value above zero, as simulated views of an activity of one do; none where it holds no counts.
    """
    if not (view > 0).any():
        return 0.0
    counts = view.double() / (1 if _whole(view) else view[view > 0].min())
    if not torch.allclose(counts, counts.round(), rtol=1e-4, atol=0):
        return None
    return (counts.sum().sqrt() / counts.norm()).item()


def _whole(view: Float[Tensor, "1 v u"]) -> bool:
    """Whether all values are whole numbers."""
    return view.equal(view.round())


class _Order(NamedTuple):
    """Some views with their axes in one order.

    Args:
        names: of the orientations: as they are, with reversed columns, with reversed rows.
        A: their operator on a coarse grid.
        region: the pixels that are joined to one of the operator's.
    """

    names: tuple[str, ...]
    A: Projector
    region: Region

    @classmethod
    def of(cls, names: tuple[str, ...], scan: Scan, cameras: Cameras) -> Self:
        """Of a scan's projector; raises what that does."""
        grid = coarse(scan.grid, VOXELS)
        size = max(1, int(max(grid.spacing) / resolution(cameras, grid.centre)))
        rows, columns = cameras.shape
        joined = (min(size, rows), min(size, columns))
        kept = (0, rows - rows % joined[0]), (0, columns - columns % joined[1])
        region = Region((rows, columns), kept[0], kept[1], joined)
        rig = region.seen_by(cameras[torch.tensor(_numbers(scan))])
        return cls(names, PROJECTORS.from_config(scan.projector, grid=grid, cameras=rig), region)

    def oriented(self, view: Float[Tensor, "1 v u"]) -> Float[Tensor, "n i j"]:
        """A view in the orientations, binned."""
        views = [view, view.flip(-1), view.flip(-2)][: len(self.names)]
        return self.region.binned(self.region.cropped(torch.cat(views)))


def _orders(scan: Scan) -> list[_Order]:
    """The axes as they are stored, and exchanged unless the projector refuses such cameras.

    Of exchanged axes those with reversed rows are left out: of a circular scan they fit as well.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the operator of the reconstruction gives these warnings
        orders = [_Order.of((STORED, COLUMNS, ROWS), scan, scan.cameras)]
        with suppress(ValueError):
            orders.append(_Order.of((EXCHANGED, TURNED), scan, scan.cameras.transposed()))
    return orders


def _read(scan: Scan, orders: list[_Order]) -> tuple[Float[Tensor, "1 v u"], list[Tensor]]:
    """The first view as it is stored, and some views in every orientation [n 1 m i j], each read
    once.
    """
    first, seen = torch.empty(0), [[] for _ in orders]
    for number in _numbers(scan):
        view = scan.measured.read(number, number + 1).views
        first = first if number else view
        for order, views, kept in zip(orders, (view, view.mT), seen, strict=False):
            kept.append(order.oriented(views))
    return first, [torch.stack(views, dim=1)[:, None] for views in seen]


def _nrmse(orders: list[_Order], views: list[Tensor], device: str) -> dict[str, float]:
    """The view NRMSE of a volume by SIRT in every orientation, by its name."""
    pairs = zip(orders, (y.to(device) for y in views), strict=True)
    return {
        name: figure
        for order, y in pairs
        for name, figure in zip(order.names, _residuals(order.A.to(device), y), strict=True)
    }


def _settled(name: str, orders: list[_Order], views: list[Tensor], device: str) -> float:
    """The view NRMSE in one orientation after `ROUND` iterations."""
    order, y = next(pair for pair in zip(orders, views, strict=True) if name in pair[0].names)
    at = order.names.index(name)
    return _residuals(order.A.to(device), y[at : at + 1].to(device), ROUND)[0]


@torch.no_grad()
def _residuals(
    A: Projector, views: Float[Tensor, "n 1 m i j"], iterations: int = ITERATIONS
) -> list[float]:
    """The view NRMSE of each sample's volume by SIRT."""
    again = A(sirt(A, views, iterations, momentum=True))
    return [nrmse(a, b) for a, b in zip(again, views, strict=True)]


def _numbers(scan: Scan) -> range:
    return range(0, len(scan.cameras), math.ceil(len(scan.cameras) / VIEWS))
