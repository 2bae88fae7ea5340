"""Correction of a measured scan before its reconstruction: alignment of the views, and calibration
of the rig from its views.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.apps.progress import Bar
from mvrecon.apps.scan import Scan, ViewsInMemory
from mvrecon.core.machine import check_memory
from mvrecon.data.projections.stack import binned
from mvrecon.data.projections.views import Corrected, MeasuredViews
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import extended_to_field, pixels_of_voxel
from mvrecon.geometry.cameras.random_rigs import misaligned
from mvrecon.geometry.grid import Grid, coarse
from mvrecon.geometry.rigid import unit
from mvrecon.methods.calibration.alignment import blurred, translated
from mvrecon.methods.calibration.axis import KEPT, refined_axis
from mvrecon.methods.calibration.conjugate import conjugate_axis
from mvrecon.methods.calibration.from_data import (
    KINDS,
    UNCERTAIN_SHARE,
    Estimate,
    calibrated,
    unknowns,
)
from mvrecon.methods.calibration.hardening import Linearisation, fit_linearisation
from mvrecon.methods.calibration.self_alignment import MAX_BESIDE, share_beside, warn_unless_aligned
from mvrecon.methods.classical.truncation import cut_sides
from mvrecon.methods.method import Alignment
from mvrecon.operators.operator import LinearOperator

#: Voxels along the longest side of the grid that a rig is fitted on; largest numbers of rounds, and
#: of fits of a tilt: each begins with the axis for the tilt found before, whose change is about a
#: fifth of the previous one.
MAX_GRID_VOXELS, MAX_ROUNDS, MAX_FITS = 64, 12, 3
#: Arrays of the views' size that a fit holds.
HELD_ARRAYS = 8
#: Share of pixels that were not measured up to which views are aligned, and the weight of one in an
#: aligned pixel from which on that counts as not measured either.
MAX_UNMEASURED, MAX_UNMEASURED_WEIGHT = 0.1, 0.05
#: f(A, views) -> aligned views, and the errors of their cameras.
Align: TypeAlias = Callable[[LinearOperator, Tensor], tuple[Tensor, Alignment]]


@dataclass(frozen=True)
class Corrections:
    """Corrections of a scan before its reconstruction.

    Args:
        free: errors of the rig that are fitted to the views, see `unknowns`.
        grid: f(cameras) -> the grid that is reconstructed with a fitted rig.
        align: aligns the views; None: they stay.
        self_calibrate: with `align`, correct the gains of the views, and the positions of the
            cameras instead of shifting their views.

    Raises:
        ValueError: `self_calibrate` without `align`.
    """

    free: Sequence[str]
    grid: Callable[[Cameras], Grid]
    align: Align | None = None
    self_calibrate: bool = False

    def __post_init__(self) -> None:
        if self.self_calibrate and self.align is None:
            raise ValueError("expected correct=align for self_calibrate=true, got correct=null")

    def check(self, scan: Scan) -> None:
        """Check that they fit a scan, before any view is read.

        Raises:
            ValueError: names that `unknowns` refuses; views that do not fit into memory.
        """
        if self.free:
            unknowns(scan.cameras, self.free)
            check_memory(
                4 * HELD_ARRAYS * len(scan.cameras) * math.prod(scan.cameras.shape),
                "Calibration holds all views (views.binning=2 or views.every=2 takes fewer; or "
                "calibrate once so, and give the rig that it writes to the streamed run): it",
            )


def corrected_scan(
    scan: Scan, align: Align, self_calibrate: bool = False, device: str = "cpu"
) -> tuple[Scan, Alignment]:
    """The scan with aligned views, and the errors of its cameras.

    Views are aligned on the scan's grid, or where the object extends beyond it, in the field of
    half of the views, in at most `MAX_GRID_VOXELS` voxels a side. Pixels that were not measured are
    filled from their neighbours; the mask moves with the views.

    Raises:
        ValueError: many pixels that were not measured; as `self_aligned`.

    Warns:
        UserWarning: views that are not aligned, as most of them are lost.
    """
    whole = scan.measured.whole()
    if (missing := (~whole.mask).double().mean().item()) > MAX_UNMEASURED:
        raise ValueError(
            f"expected at most {MAX_UNMEASURED:.0%} of dead or saturated pixels for correct=align, "
            f"got {missing:.0%}; crop them by views.rows and views.columns"
        )
    views = _filled(whole, 1, scan.counts).to(device)
    box = _grid_about(scan, views)
    grid = scan.grid if box is scan.grid else coarse(box, MAX_GRID_VOXELS)
    corrected, by = align(replace(scan, grid=grid).operator().to(device), views)
    by = by.to("cpu")
    warn_unless_aligned(by)
    if self_calibrate:
        if lost := (by.gain[0] == 0).nonzero().flatten().tolist():
            raise ValueError(
                f"Expected a view of every camera for self_calibrate, got none of {lost}"
            )
        measured = ViewsInMemory(whole.views, whole.mask).divided_by(by.gain[0])
        cameras = scan.cameras.shifted(by.shift_px[0].to(scan.cameras.origin))
        return replace(scan, measured=measured, cameras=cameras), by
    weight = translated((~whole.mask)[None, None].to(by.shift_px), -by.shift_px)[0, 0].abs()
    mask = weight < MAX_UNMEASURED_WEIGHT
    return replace(scan, measured=ViewsInMemory(corrected[0, 0].cpu(), mask)), by


def calibrate(scan: Scan, free: Sequence[str], device: str, bar: Bar) -> tuple[Scan, Estimate]:
    """The scan with the rig and the gains fitted to its views, and the estimate in pixels of the
    scan and degrees.

    The axis is that of conjugate rays where these determine it, of a tilted one those of the tilt.
    The fit has at most `MAX_GRID_VOXELS` voxels a side for the scan's box, or where the object
    extends beyond it, for the field of half of the views, and pixels binned to the size of a
    voxel's image; an axis that is part of it is then refined on one slice.

    Raises:
        ValueError: as `calibrated`.
    """
    bar.phase("reading")
    whole = scan.measured.whole()
    pixels = _filled(whole, 1, scan.counts)
    axis = conjugate_axis(scan.cameras, pixels, scan.grid) if "offset_u" in free else KEPT
    about = replace(scan, cameras=scan.cameras.shifted(torch.tensor([[axis.offset, 0.0]])))
    cut, box = cut_sides(pixels), _grid_about(about, pixels.to(device))

    def operator_of(grid, cameras):
        return scan.on(grid, cameras).to(device)

    box = _grown(box) if cut.all(dim=-1).any() else box
    grid = coarse(box, MAX_GRID_VOXELS)
    joined = _joined(scan, grid)
    rig = scan.cameras.binned(joined)
    views = _filled(whole, joined, scan.counts).to(device)
    bar.phase("calibrating", MAX_ROUNDS)
    for _ in range(MAX_FITS):
        with warnings.catch_warnings(record=True) as remarks:  # those of the last fit count
            warnings.simplefilter("always")
            fit = calibrated(
                partial(operator_of, grid),
                rig,
                views,
                free,
                rounds=MAX_ROUNDS,
                monitor=lambda r: bar(*r),
                known={} if axis == KEPT else {"offset_u": axis.offset / joined},
            )
        by = fit.misalignment._replace(offset_px=joined * fit.misalignment.offset_px)
        if "offset_u" not in free or "tilt" not in fit.uncertainty:
            break
        # other rays are conjugate where the axis is tilted, and the tilt is another where it moves
        change = conjugate_axis(misaligned(scan.cameras, by), pixels, scan.grid)
        by.offset_px[:, 0] += change.offset
        axis = KEPT if change == KEPT else change._replace(offset=by.offset_px[0, 0].item())
        if abs(change.offset) <= change.uncertainty:
            break
    for remark in remarks:
        warnings.warn(remark.message, stacklevel=2)
    size = {kind: x * (joined if "offset" in kind else 1) for kind, x in fit.uncertainty.items()}
    if axis != KEPT:
        size["offset_u"] = axis.uncertainty
        if "tilt" in size:  # which the axis follows
            turned = by._replace(tilt_degrees=by.tilt_degrees.clone())
            turned.tilt_degrees[:, KINDS["tilt"].column] += size["tilt"]
            change = conjugate_axis(misaligned(scan.cameras, turned), pixels, scan.grid)
            size["offset_u"] = math.hypot(axis.uncertainty, change.offset)
        fit = fit._replace(kept=[name for name in fit.kept if name != "offset_u"])
    elif "offset_u" in free and "offset_u" not in fit.kept:
        pixels = (pixels / fit.gains[:, None, None].to(pixels)).to(device)
        rig = misaligned(scan.cameras, by)
        axis = refined_axis(operator_of, rig, pixels, box, size["offset_u"] / UNCERTAIN_SHARE)
        by.offset_px[:, 0] += axis.offset
        if axis.uncertainty < math.inf:
            size["offset_u"] = axis.uncertainty
    cameras = misaligned(scan.cameras, by)
    measured = scan.measured.divided_by(fit.gains.float()) if "gains" in free else scan.measured
    estimate = fit._replace(cameras=cameras, misalignment=by, uncertainty=size)
    return replace(scan, cameras=cameras, measured=measured), estimate


def rig_on_disk(
    measured: MeasuredViews, rig: Cameras, nominal: Cameras, fitted: Cameras
) -> Cameras:
    """The cameras of all views on disk, each moved rigidly as those of the scan were by a fit.

    A view that the scan leaves out (`views.every`) moves as the last one before it.

    Args:
        measured: the views of the scan.
        rig: the cameras of all views on disk, before the fit.
        nominal, fitted: the cameras of the scan before and after the fit.
    """
    fit = torch.arange(len(rig)) // measured.options.every
    part, inverse = measured.region.seen_by(rig), torch.linalg.inv(_axes(nominal))
    axes = _axes(part)
    turn = axes @ (inverse @ _axes(fitted))[fit] @ torch.linalg.inv(axes)
    moved = (inverse @ (fitted.origin - nominal.origin)[..., None])[fit]

    def turned(vectors: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        return (turn @ vectors[..., None])[..., 0]

    origin = part.origin + (axes @ moved)[..., 0] + turned(rig.origin - part.origin)
    source = origin + rig.source - rig.origin if rig.parallel else rig.source
    return replace(rig, source=source, origin=origin, u=turned(rig.u), v=turned(rig.v))


def _axes(cameras: Cameras) -> Float[Tensor, "m 3 3"]:
    """The steps of each detector and its normal, as columns."""
    normal = unit(torch.linalg.cross(cameras.u, cameras.v))
    return torch.stack([cameras.u, cameras.v, normal], dim=2)


def linearised(scan: Scan, device: str, bar: Bar) -> tuple[Scan, Linearisation | None]:
    """The scan with views corrected by the polynomial that is fitted to them, and the fit; the same
    and None without `views.linearise=fit`.

    Raises:
        ValueError: as `fit_linearisation`; views that do not fit into memory.
    """
    measured = scan.measured
    if isinstance(measured, ViewsInMemory) or measured.options.linearise != "fit":
        return scan, None
    bar.phase("reading")
    views = _filled(measured.whole(), 1, scan.counts).to(device)
    bar.phase("linearising")
    fit = fit_linearisation(scan.operator().to(device), views)
    return replace(scan, measured=measured.linearised(fit.coefficients)), fit


def in_words(estimate: Estimate, free: Sequence[str]) -> str:
    """The errors of a rig, in pixels and degrees, and the residual before and after."""
    parts, by = [], estimate.misalignment
    for name in free:
        if name in estimate.kept:
            parts.append(f"{name} kept at the nominal value")
        elif name == "shifts":
            length = by.offset_px.norm(dim=1)
            parts.append(
                f"shifts of {length.square().mean().sqrt():.2f} pixels (rms), at most "
                f"{length.max():.2f} (view {int(length.argmax())})"
            )
        elif name == "gains":
            off = estimate.gains - 1
            parts.append(
                f"gains off by {off.square().mean().sqrt():.2%} (rms), at most "
                f"{off.abs().max():.2%} (view {int(off.abs().argmax())})"
            )
        else:
            kind = KINDS[name]
            value = getattr(by, kind.field or "")[0, kind.column]
            unit = "pixels" if kind.field == "offset_px" else "degrees"
            most = estimate.uncertainty[name]
            parts.append(f"{name} {value:+.3f} {unit}, uncertain by up to {most:.2g}")
    before, after = estimate.residual[0], estimate.residual[-1]
    rounds = f"{len(estimate.residual) - 1} rounds"
    return (
        f"{', '.join(parts)}; residual of the blurred views {before:.3g} before, {after:.3g} after "
        f"{rounds if estimate.settled else rounds + ', in the last of which the rig still changed'}"
    )


def calibration_table(estimate: Estimate, free: Sequence[str]) -> dict[str, Any]:
    """The estimate in words and as plain numbers, for `results.json`."""
    by = estimate.misalignment
    return {
        "words": in_words(estimate, free),
        "free": list(free),
        "offset_px": by.offset_px.tolist(),
        "tilt_degrees": by.tilt_degrees.tolist(),
        "gains": estimate.gains.tolist(),
        "residual": estimate.residual,
        "kept": estimate.kept,
        "left_out": list(estimate.left_out),
        "settled": estimate.settled,
        "uncertainty": estimate.uncertainty,
    }


def _grid_about(scan: Scan, pixels: Float[Tensor, "1 1 m v u"]) -> Grid:
    """The scan's grid, or the field of half of its views where the object extends beyond it."""
    A = scan.on(coarse(scan.grid, MAX_GRID_VOXELS), scan.cameras)
    beside = share_beside(A.to(pixels.device), pixels).item()
    return extended_to_field(scan.cameras, scan.grid) if beside > MAX_BESIDE else scan.grid


def _grown(grid: Grid) -> Grid:
    """The grid with a quarter of its voxels more on each side along axes of several, for what lies
    beside the field of views that end inside the object at both sides.
    """
    return grid.resized([n + 2 * (n // 4) for n in grid.size])


def _joined(scan: Scan, grid: Grid) -> int:
    """Pixels joined into one each way: the most that a voxel's image holds and the detector has a
    multiple of.
    """
    shared = math.gcd(*scan.cameras.shape)
    most = min(shared, pixels_of_voxel(scan.cameras, grid))
    return max(n for n in range(1, most + 1) if shared % n == 0)


def _filled(whole: Corrected, joined: int, counts: bool) -> Float[Tensor, "1 1 m v u"]:
    """All views, binned, and pixels that were not measured filled from their neighbours."""
    share = binned(whole.mask.float(), (joined, joined))
    total = binned(torch.where(whole.mask, whole.views, 0.0), (joined, joined), counts)
    views = (total / share.clamp_min(1e-9))[None, None]
    mask = share > 0
    return views if mask.all() else torch.where(mask, views, blurred(views, 2.0, mask))
