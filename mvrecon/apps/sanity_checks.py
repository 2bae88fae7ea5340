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
from mvrecon.apps.scan import ATTENUATION, Scan
from mvrecon.core.parts import METHODS, PROJECTORS
from mvrecon.data.attenuation import WATER
from mvrecon.data.projections.stack import Region
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
#: An offset of the detector is reported from so many pixels on where it leaves less than this part
#: of the residual, and sought among so many pixels of the coarse views.
ASIDE, CENTRED, REACH = 1.0, 0.9, 8
#: Ranges of angles that are tried for views at equal steps, in degrees; deviation of a step, and
#: least change of the range, relative to it; iterations, as a range matters little where an object
#: is nearly round.
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


def sanity_checks(scan: Scan, method: str, outcome: Outcome, device: str = "cpu") -> list[str]:
    """Return the failed checks of a scan's reconstruction, as sentences.

    A projector of weighted integrals, or without `pixel_integral`, is checked by the residual of
    its volume alone; a method declares its data, `declares`.

    Args:
        scan: that was reconstructed.
        method: name of the method.
        outcome: its volume, in the unit of the views per mm.
        device: for the comparison.
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
        oriented, moved = figures[best] < BETTER * figures[STORED], []
        # reversed columns are a reversed rotation, too
        checks = (_of_axis,) if oriented and best == COLUMNS else (_of_axis, _of_arc)
        for check in () if words else checks:
            with suppress(ValueError):  # of a projector that refuses such cameras, or no orbit
                moved += check(scan, orders[0], views[0][:1].to(device), figures[STORED])
        # a moved rig can look like exchanged axes, which it then explains better
        if moved and min(moved)[0] * figures[STORED] <= figures[best]:
            words.append(min(moved)[1])
        elif oriented:
            words.append(
                f"views with their {best} fit the rig better, view NRMSE {figures[best]:.2g} in "
                f"place of {figures[STORED]:.2g} (SIRT on a coarse grid); {CURES[best]}"
            )
    elif kind == "counts":
        noise = _noise_of_counts(scan.measured.read(0, 1).views)
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


def _moved(
    scan: Scan, order: "_Order", cameras: Cameras, views: Tensor, iterations: int = ITERATIONS
) -> float:
    """The view NRMSE of views with other cameras."""
    A = PROJECTORS.from_config(scan.projector, grid=order.A.grid, cameras=cameras)
    return _residuals(A.to(views.device), views, iterations)[0]


def _of_axis(scan: Scan, order: "_Order", views: Tensor, stored: float) -> list[tuple[float, str]]:
    """Check whether views fit the rig better with the detector shifted, by the vertex of a
    parabola through the least residual and its neighbours; returns the view NRMSE relative to
    `stored`, that of the rig, and a sentence. `order` is that of the stored axes.
    """
    if scan.cameras.parallel:
        return []

    def figure(offset: float) -> float:
        cameras = order.A.cameras.shifted(torch.tensor([[offset, 0.0]]))
        return _moved(scan, order, cameras, views)

    found = {0: stored}
    for side in (1, -1):
        for n in range(side, side * REACH, side):
            found[n] = figure(n)
            if found[n] >= found[n - side]:
                break
    best = min(found, key=lambda n: found[n])
    if not {best - 1, best + 1} <= set(found):
        return []
    before, here, behind = (found[best + n] ** 2 for n in (-1, 0, 1))
    offset = best + (before - behind) / 2 / max(before + behind - 2 * here, 1e-30)
    pixels, mended = offset * order.region.binning[1], figure(offset)
    if abs(pixels) < ASIDE or mended > CENTRED * stored:
        return []
    words = (
        f"views fit the rig better with the detector {pixels:+.1f} pixels aside along u, view "
        f"NRMSE {mended:.2g} in place of {stored:.2g} (SIRT on a coarse grid); is the axis of "
        f"rotation wrong? calibrate=[offset_u] fits it"
    )
    return [(mended / stored, words)]


def _of_arc(scan: Scan, order: "_Order", views: Tensor, stored: float) -> list[tuple[float, str]]:
    """Check whether views at equal steps fit better over a full or a half circle, or the other way
    round; arguments and result as in `_of_axis`.

    Raises:
        ValueError: cameras that are not on a circle.
    """
    cameras, numbers, count = order.A.cameras, torch.tensor(_numbers(scan)), len(scan.cameras)
    orbit = orbit_of(cameras, order.A.grid)
    steps = torch.remainder(orbit.angles.diff() + 180, 360) - 180
    step = steps.mean() / numbers[1]
    if (steps / numbers[1] - step).abs().max() > UNEVEN * step.abs():
        return []
    arc = count * step.item()
    turned = {
        other: orbit.turned(cameras, numbers * (other / count - step))
        for other in (-arc, *(math.copysign(size, arc) for size in ARCS))
        if abs(other - arc) > DIFFERENT * abs(other)
    }
    figures = {other: _moved(scan, order, rig, views) for other, rig in turned.items()}
    best = min(figures, key=lambda other: figures[other])
    if figures[best] >= stored:
        return []
    before, after = (_moved(scan, order, rig, views, ROUND) for rig in (cameras, turned[best]))
    if after > BETTER * before:
        return []
    cure = CURES[COLUMNS] if best == -arc else "are the angles or camera.arc_degrees wrong?"
    words = (
        f"views fit the rig better over {best:.0f} degrees, view NRMSE {after:.2g} in place of "
        f"{before:.2g} over {arc:.0f} (SIRT on a coarse grid); {cure}"
    )
    return [(after / before, words)]


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


@torch.no_grad()
def _residuals(
    A: Projector, views: Float[Tensor, "n 1 m i j"], iterations: int = ITERATIONS
) -> list[float]:
    """The view NRMSE of each sample's volume by SIRT."""
    again = A(sirt(A, views, iterations, momentum=True))
    return [nrmse(a, b) for a, b in zip(again, views, strict=True)]


def _numbers(scan: Scan) -> range:
    return range(0, len(scan.cameras), math.ceil(len(scan.cameras) / VIEWS))
