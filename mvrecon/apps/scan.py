"""A measured scan: its views on disk, its rig, and the grid that is reconstructed."""

import math
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.apps.stated_rig import completed
from mvrecon.core.files.checks import Refused
from mvrecon.core.machine import check_memory
from mvrecon.core.parts import (
    CAMERAS,
    FACTORS,
    PROJECTORS,
    SCATTER,
    CameraPart,
    FactorsPart,
    ProjectorPart,
    ScatterPart,
)
from mvrecon.core.quantities import PositiveFloat, PositiveInt, Triple
from mvrecon.data.projections.stack import MU_FILE
from mvrecon.data.projections.views import Corrected, Measured, MeasuredViews
from mvrecon.data.volume_files import open_volume
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import auto_grid, check_rig_sees, full_fan
from mvrecon.geometry.cameras.formats.common import flips_rows
from mvrecon.geometry.cameras.formats.rtk_xml import detector_of_image
from mvrecon.geometry.cameras.rigs import Detector
from mvrecon.geometry.grid import Grid, coarse
from mvrecon.operators.operator import LinearOperator, Projector, Scaled, sees_integrals
from mvrecon.operators.selection import ViewSelection
from mvrecon.operators.stacked import Stacked
from mvrecon.training.trained_method import TrainedMethod

#: Volumes of the grid's size that a reconstruction holds at least, in float32.
MIN_HELD_VOLUMES = 3
#: Pixels by which a detector's offset may differ from the one by the views' file, for rounding.
MAX_OFFSET_PX = 0.01
#: Time between measurements of which neither is corrected for decay; relative difference of the
#: widths of an energy window.
MAX_APART, MAX_WIDTH_DIFFERENCE = timedelta(minutes=1), 0.01
#: Unit of a volume whose views are line integrals, and of one that emits, where no file tells it.
ATTENUATION, EMISSION = "1/mm", "activity"


@dataclass(frozen=True, eq=False)
class ViewsInMemory:
    """Views in memory instead of `MeasuredViews`, with the mask of measured pixels."""

    views: Float[Tensor, "m v u"]
    mask: Bool[Tensor, "m v u"]

    def read(self, first: int, last: int) -> Corrected:
        """Views `first` to `last - 1`."""
        return Corrected(self.views[first:last], self.mask[first:last])

    def whole(self) -> Corrected:
        """All views."""
        return Corrected(self.views, self.mask)

    def divided_by(self, gains: Float[Tensor, " m"]) -> "ViewsInMemory":
        """Each view divided by its gain."""
        return replace(self, views=self.views / gains[:, None, None])

    def warn_of_values(self, odd: Counter[str]) -> None:
        """No warning: reading has already warned."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Measured views with their geometry.

    Args:
        measured: views, read from disk on access.
        cameras: cameras of the views, one for each.
        grid: the voxels to reconstruct.
        projector: name and options of the operator.
        unit: unit of the volume.
        counts: whether the views are counts of emission.
        scatter: scatter expected in these counts, in the views' unit; None: none.
        dose: counts per unit of the views, which were divided by it.
        factors: factor of each pixel, such as its uniformity; None: one.
        rig: the cameras of all views on disk, before choice, crop and binning; None: unknown.
        parts: scans whose views these are, one after the other, each with its projector, see
            `joined`; empty: these are views by `projector`.
    """

    measured: MeasuredViews | ViewsInMemory
    cameras: Cameras
    grid: Grid
    projector: ProjectorPart
    unit: str = ATTENUATION
    counts: bool = False
    scatter: Float[Tensor, "1 1 m v u"] | None = None
    dose: float = 1.0
    factors: Float[Tensor, "m v u"] | None = None
    rig: Cameras | None = None
    parts: tuple["Scan", ...] = ()

    def on(self, grid: Grid, cameras: Cameras) -> Projector:
        """The projector on any grid by any cameras, without the pixels' factors."""
        return PROJECTORS.from_config(self.projector, grid=grid, cameras=cameras)

    def operator(self, views: slice = slice(None)) -> Projector:
        """The operator of all views, or of consecutive ones, with the pixels' factors."""
        if self.parts:
            A: Any = Stacked([replace(part, factors=None).operator() for part in self.parts])
            A = A.subset(ViewSelection(A.range_shape, range(len(self.cameras))[views]))
        else:
            A = self.on(self.grid, self.cameras[views])
        return A if self.factors is None else Scaled(A, pixels=self.factors[views])

    def posed(self, device: str) -> tuple[LinearOperator, Float[Tensor, "1 1 m v u"]]:
        """Operator and views without pixels that were not measured or, with a warning, hold counts
        and see no voxel: their rows are zero.
        """
        whole, A = self.measured.whole(), self.operator().to(device)
        views, mask = whole.views[None, None].to(device), whole.mask.to(device)
        if self.unit != ATTENUATION:
            dark = (A(views.new_ones(1, 1, *A.domain_shape)) <= 0)[0, 0]
            if lost := views[0, 0][dark & mask].sum().item():
                dead = self.factors is not None and not self.factors.all()
                lost, total = lost * self.dose, views.sum().item() * self.dose
                warnings.warn(
                    f"Left out {lost:g} of {total:g} counts, in pixels that see no voxel"
                    + " or are dead in the flood" * dead,
                    stacklevel=2,
                )
                mask = mask & ~dark
        if mask.all():
            return A, views
        return Scaled(A, pixels=mask.to(views)), views * mask


@dataclass(frozen=True)
class GridOfScan:
    """The grid of a measured scan; without any option that of a trained network's training, or what
    all views see, of a half fan what they measure together.

    Args:
        size: number of voxels, one number or (x, y, z).
        spacing: voxel size in mm, one number or (x, y, z).
        centre: centre of the grid in world mm.
        like: a volume file: reconstructs on its voxels, and writes them in its order of axes.
        seen_by: share of the views, such as 0.5: reconstructs what so many of them see.

    Raises:
        ValueError: options that contradict each other.
    """

    size: PositiveInt | Triple[PositiveInt] | None = None
    spacing: PositiveFloat | Triple[PositiveFloat] | None = None
    centre: Triple[float] = (0.0, 0.0, 0.0)
    like: str | Path | None = None
    seen_by: PositiveFloat | None = None

    def __post_init__(self) -> None:
        given = not (self.size is self.spacing is None)
        if self.seen_by is not None and (given or self.like is not None):
            raise ValueError(
                f"Expected grid.seen_by={self.seen_by} alone, which chooses the grid, or grid.size "
                f"and grid.spacing, or grid.like; got both"
            )
        if self.like is not None and given:
            raise ValueError("Expected grid.like, or grid.size and grid.spacing; got both")
        if any(self.centre) and self.size is None:
            raise ValueError(
                f"Expected grid.size and grid.spacing with grid.centre={self.centre}, got neither"
            )
        if given and (self.size is None or self.spacing is None):
            raise ValueError(
                f"Expected grid.size (voxels) and grid.spacing (mm), got {self.size} and "
                f"{self.spacing}"
            )

    def voxels(self, cameras: Cameras) -> Grid:
        """The grid for a rig."""
        if self.like is not None:
            return open_volume(self.like)[1]
        if self.size is not None and self.spacing is not None:
            return Grid.centred(size=self.size, spacing=self.spacing, centre=self.centre)
        if self.seen_by is None:
            return auto_grid(full_fan(cameras))
        return auto_grid(cameras, seen_by=self.seen_by)


def grid_of(options: GridOfScan, method: nn.Module) -> Callable[[Cameras], Grid]:
    """f(cameras) -> the grid that a method reconstructs with these options."""
    undecided = options.size is options.like is options.seen_by is None
    if isinstance(method, TrainedMethod) and undecided:
        trained = method.loaded().module.projector.grid
        return lambda _: trained
    return options.voxels


def open_scan(
    views: Measured,
    camera: CameraPart,
    grid: Callable[[Cameras], Grid],
    projector: ProjectorPart,
    scatter: ScatterPart | None = None,
    factors: FactorsPart | None = None,
) -> Scan:
    """Open a scan.

    Args:
        views: files and corrections of the views; rows are reversed if the camera's file counts
            them upwards (`flip_rows`).
        camera: name and options of the rig; options that are not set are those that the files of
            the views state, see `stated_rig.completed`.
        grid: f(cameras) -> the voxels to reconstruct, see `grid_of`.
        projector: name and options of the projector; drr of parallel beams is radon.
        scatter: name and options of the scatter's estimate, whose files are read with the options
            of the views; None: no scatter.
        factors: name and options of the factors of counts; None: one.

    Warns:
        UserWarning: counts that `mvrecon-simulate` attenuated, and a projector without `mu`.

    Raises:
        ValueError: another number of cameras than of views, views of another kind than the
            projector's, a detector that contradicts spacing or origin of the views' file, a rig
            that does not see the grid, a grid that does not fit into memory; what the parts raise.
    """
    measured = MeasuredViews(replace(views, flip_rows=views.flip_rows or flips_rows(camera)))
    known = _detector(measured)
    camera = completed(camera, known, measured)
    _check_offset(camera, known, measured)
    rig = CAMERAS.from_config(camera)
    cameras = measured.cameras(rig)
    if cameras.parallel and projector["name"] == "drr":
        projector = {**projector, "name": "radon"}
    voxels = grid(cameras)
    seeing = int(check_rig_sees(cameras, voxels).nonzero()[0, 0])
    check_memory(
        4 * MIN_HELD_VOLUMES * math.prod(voxels.shape), f"A reconstruction of {voxels.shape} voxels"
    )
    scan = Scan(measured, cameras, voxels, projector, rig=rig)
    unit = measured.stack.unit
    A = of_one_view(scan, seeing)
    if unit is not None:
        check_unit(unit, projector["name"], A)
    stated = measured.kind == "counts" or (unit or "").endswith(f" of {EMISSION}")
    if A.emission or stated and not sees_integrals(A):
        scan = replace(scan, measured=measured.as_counts(), unit=EMISSION, counts=True)
    elif measured.kind == "counts":
        raise Refused(
            f"{measured.options.path}: expected a projector of emission for views of counts, got "
            f"{projector['name']!r}, which makes line integrals"
        )
    if measured.stack.attenuated and projector.get("mu") is None:
        _warn_of_missing_mu(measured)
    if scatter is not None:
        SCATTER.check(scatter)
        counts = _counts(scan, "scatter")
        whole = counts.whole().views[None, None]
        expected = SCATTER.from_config(scatter, whole, partial(_read, counts), cameras)
        scan = replace(scan, scatter=expected)
    absolute = None
    if factors is not None:
        FACTORS.check(factors)
        counts = _counts(scan, "factors")
        weights, absolute = FACTORS.from_config(factors, counts, partial(_read, counts), cameras)
        scan = replace(scan, factors=weights, unit=absolute or scan.unit)
    if absolute is None and (dose := measured.stack.dose) is not None:
        scaled = scan.measured.divided_by(torch.full((measured.n_views,), dose))
        background = None if scan.scatter is None else scan.scatter / dose
        scan = replace(scan, measured=scaled, scatter=background, dose=dose)
    if absolute or unit is None:
        return scan
    return replace(scan, unit=unit.removesuffix(" * mm").rpartition(" of ")[2])


def _warn_of_missing_mu(views: MeasuredViews) -> None:
    """Warn of attenuated counts without an attenuation map."""
    path, name = Path(views.options.path), (views.stack.unit or "").partition(" of ")[0]
    mu = path.with_name(MU_FILE)
    value = mu if mu.is_file() else "<that of the simulation>"
    warnings.warn(
        f"{views.options.path}: expected projector={name} projector.mu={value} for attenuated "
        f"counts, got no projector.mu; without it the activity is too low",
        stacklevel=3,
    )


def _read(
    views: MeasuredViews,
    path: str | Path,
    relative: bool = False,
    widths_kev: tuple[float | None, float | None] | None = None,
) -> Float[Tensor, "1 1 m v u"]:
    """The counts of a file of further views of the same detectors, in the duration of the views.

    Args:
        views: views of the scan.
        path: path of the file.
        relative: return the values as they are, whatever their dose and duration.
        widths_kev: widths of the file's energy window and of the scan's, each None if unknown;
            None: of no other window.

    Raises:
        Refused: other sizes, an unknown dose, another width than a file states, or the window of
            the scan itself.

    Warns:
        UserWarning: a duration of one file alone, measurements at different times, or a window with
            numbers that are not whole.
    """
    options = replace(views.options, path=path, kind="counts")
    if Path(path).suffix != Path(options.path).suffix:
        options = replace(options, dataset=None, angles=None, image_key=None)
    other = MeasuredViews(options)
    sizes = [(one.stack.n_views, *one.stack.shape) for one in (views, other)]
    if sizes[0] != sizes[1]:
        raise Refused(
            f"{path}: expected views [m v u] of the measured counts' sizes {sizes[0]}, got "
            f"{sizes[1]}"
        )
    whole = other.whole()
    counts = whole.views[None, None]
    if relative:
        return counts
    _check_dose(other, "scatter")
    if widths_kev is not None:
        _check_window(views, other, whole, widths_kev)
    own, others = views.stack, other.stack
    apart = abs(own.began - others.began) if own.began and others.began else timedelta(0)
    if apart > MAX_APART:
        warnings.warn(
            f"{path}: was measured {apart} h apart from {views.options.path}; its counts are not "
            f"corrected for the decay between them",
            stacklevel=2,
        )
    for mine, its in ((own.duration_s, others.duration_s), (own.total_s, others.total_s)):
        if mine is not None and its is not None:
            return counts * (mine / its)
    times = [stack.duration_s or stack.total_s for stack in (own, others)]
    if any(times):
        stated = " and ".join("unknown" if time is None else f"{time:g} s" for time in times)
        warnings.warn(
            f"{path}: its counts are taken to be of the duration of {views.options.path}, as "
            f"they state {stated}",
            stacklevel=2,
        )
    return counts


def _check_window(
    views: MeasuredViews,
    other: MeasuredViews,
    counts: Corrected,
    widths_kev: tuple[float | None, float | None],
) -> None:
    """Check that counts are those of another energy window than the views'; see `_read`."""
    own, window, values = views.stack.window_kev, other.stack.window_kev, counts.views
    if (own and own == window) or (values.any() and torch.equal(values, views.whole().views)):
        raise Refused(
            f"{other.options.path}: expected the counts of another energy window for scatter, got "
            f"those of the views; DICOM NM names its windows, as in tomo.dcm:/window1"
        )
    for one, width in ((other, widths_kev[0]), (views, widths_kev[1])):
        low, high = one.stack.window_kev or (0.0, 0.0)
        if high > low and width and abs(width / (high - low) - 1) > MAX_WIDTH_DIFFERENCE:
            raise Refused(
                f"{one.options.path}: expected widths_kev with the {high - low:g} keV of its "
                f"energy window, got {width:g}"
            )
    if ((values != values.round()) & counts.mask).any():
        warnings.warn(
            f"{other.options.path}: expected whole numbers as the counts of an energy window, got "
            f"others; they must be smoothed alone, not scaled",
            stacklevel=3,
        )


def _counts(scan: Scan, purpose: str) -> MeasuredViews:
    """The views of a scan of counts with their dose."""
    if not isinstance(scan.measured, MeasuredViews) or not scan.counts:
        raise Refused(
            f"expected counts and a projector of emission for {purpose}, got line integrals"
        )
    _check_dose(scan.measured, purpose)
    return scan.measured


def _check_dose(views: MeasuredViews, purpose: str) -> None:
    """Refuse views in an activity's unit, as of another version or without `acquisition.counts`."""
    if views.stack.dose is None and " of " in (views.stack.unit or ""):
        raise Refused(
            f"{views.options.path}: expected counts for {purpose}, got views in the unit "
            f"{views.stack.unit!r} of an unknown dose; mvrecon-simulate with acquisition.counts "
            f"writes counts with their dose"
        )


def check_unit(unit: str, name: str, A: Projector) -> None:
    """Check that the views have the projector's unit: line integrals or not.

    Args:
        unit: unit in the views' file: "... * mm" of line integrals, "<projector> of ..." of others.
        name: name of the projector.
        A: the projector.

    Raises:
        Refused: line integrals for a projector of counts or of weighted integrals, or counts for
            one of line integrals.
    """
    maker, _, quantity = unit.partition(" of ")
    weighted = A.pixel_integral() is not None and not sees_integrals(A)
    if unit.endswith("* mm") and (A.emission or weighted):
        raise Refused(
            f"expected views in the unit of the projector {name!r}, got line integrals in {unit}; "
            f"projector=drr is for those"
        )
    if quantity and sees_integrals(A):
        raise Refused(
            f"expected line integrals for the projector {name!r}, got views in the unit {unit!r}; "
            f"the projector that made them is {maker!r}"
        )


def of_one_view(scan: Scan, view: int = 0) -> Projector:
    """The operator of a view on a coarse grid, which tells what a scan's pixels are."""
    return scan.on(coarse(scan.grid, 2), scan.cameras[view : view + 1])


def _detector(measured: MeasuredViews) -> dict[str, tuple]:
    """Options of `Detector` that the views on disk state: `pixels`, and `pixel_mm` and `offset_mm`
    where their file gives a spacing and an origin.
    """
    affine, (rows, columns) = measured.stack.affine, measured.stack.shape
    if affine is None:
        pitch = measured.stack.pixel_mm
        return {"pixels": (rows, columns), **({"pixel_mm": pitch} if pitch else {})}
    spacing = np.linalg.norm(affine[:3, :2], axis=0).tolist()
    known = detector_of_image((columns, rows), spacing, affine[:2, 3].tolist())
    (v, u), (rows, columns) = known["offset_mm"], measured.flips
    offset = (v if rows else -v, -u if columns else u)
    return {**known, "offset_mm": offset}


def _check_offset(camera: CameraPart, known: Mapping[str, tuple], views: MeasuredViews) -> None:
    """Refuse a detector's offset that contradicts the origin of the views' file."""
    detector, affine = camera.get("detector"), views.stack.affine
    given = detector.get("offset_mm") if isinstance(detector, Mapping) else None
    if given is None or affine is None or not affine[:2, 3].any():  # 0: where none was set
        return
    expected, got = Detector.of(known), Detector.of({**known, "offset_mm": given}).offset_mm
    off = np.abs(np.subtract(got, expected.offset_mm))
    if (off > MAX_OFFSET_PX * np.array(expected.pixel_mm)).any():
        down, right = expected.offset_mm
        raise Refused(
            f"{views.options.path}: expected the detector's offset_mm [{down:g}, {right:g}] (v, u) "
            f"by the file's origin, got [{got[0]:g}, {got[1]:g}]; where the camera's own file has "
            f"the offsets, write the views with their origin at 0"
        )
