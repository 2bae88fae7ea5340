"""Stacks of projections on disk, read view by view, and the region of the detector for views and
cameras alike.
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, file_errors, shown
from mvrecon.core.machine import check_memory
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.turning import MAX_ANGLE, apart, turned

#: Maximum number of views of a stack.
VIEWS = 2**16
#: Relative difference of pixel sizes between a file and the cameras due to rounding.
MAX_PITCH_DIFFERENCE = 1e-3
#: Distances of the source from the detector, in mm, that files state; and their relative difference
#: from the cameras' that is not warned of.
DISTANCES, MAX_DISTANCE_DIFFERENCE = ("DistanceSourceToDetector", "RTImageSID"), 0.01
#: Cosine from which the columns of all cameras are taken as parallel to the axis of their turn.
ALONG = 0.99
#: Name of the attenuation map of simulated counts, beside their views.h5.
MU_FILE = "mu.nii.gz"
#: Pixels per read when iterating over a whole stack, 64 MiB in float32.
READ_PIXELS = 2**24
#: Parts of an image, down and across, whose means tell images apart.
PARTS = (4, 4)
#: A place in a set of files: the number of the image, and of the plane along C, Z and T.
PlaceInSet = tuple[int, ...]


class Header(NamedTuple):
    """Properties of an image file.

    Args:
        shape: rows and columns.
        dtype: type of the pixels.
        pages: number of images.
        tops: largest grey values of the pages; None of floats.
        pixel_mm: pixel size (v, u) in mm, if stated.
        alike: attributes that all views must have in common.
        stated: attributes on which grey values or places depend, by name a text for each page.
        linear: whether values are stated to be in proportion to intensity.
        excluded: where negative values mark bad pixels, the number of these that the file states.
        places: for a set of files, the places of the pages of each, by the file's path.
        own: those of the pages of this file.
        unknown: keys that the reader does not know, and that may change what it reads.
        angles: angles in degrees by which the pages' cameras are turned, if stated.
        units: units that the file states for the pixels.
    """

    shape: tuple[int, int]
    dtype: np.dtype
    pages: int
    tops: frozenset[float | None]
    pixel_mm: tuple[float, float] | None = None
    alike: tuple[Any, ...] = ()
    stated: Mapping[str, Sequence[str]] = {}
    linear: bool = False
    excluded: int | None = None
    places: Mapping[str, Sequence[PlaceInSet]] = {}
    own: Sequence[PlaceInSet] = ()
    unknown: Sequence[str] = ()
    angles: Sequence[float] = ()
    units: str = ""

    @property
    def words(self) -> str:
        """Size and type, for messages."""
        return f"{self.shape[0]} x {self.shape[1]} pixels of {self.dtype}"


class ProjectionStack(ABC):
    """Projections of one size on disk, in grey values or line integrals as they are stored.

    Args:
        path: path of the file or folder, for messages.
        names: names of the views, in their order.
        shape: rows and columns of a view.
        dtype: type of the pixels as they are stored.

    Raises:
        Refused: no view or too many, or pixels that are neither numbers nor truth values.
    """

    #: Kind of the pixels if the format defines it.
    kind: Literal["integrals", "counts", "intensities"] | None = None
    #: Unit of the pixels, of counts divided by their dose, if stored in the file, as
    #: `mvrecon-simulate` does.
    unit: str | None = None
    #: Expected counts per this unit, by which counts are divided; None: none is known.
    dose: float | None = None
    #: Whether the unit is that of one count: another activity in each measurement.
    own_unit: bool = False
    #: Duration of the measurement in s, if stored.
    duration_s: float | None = None
    #: Duration of all views together in s, if stored instead.
    total_s: float | None = None
    #: When the measurement began, if stored.
    began: datetime | None = None
    #: Limits of the energy window in keV, if stored.
    window_kev: tuple[float, float] | None = None
    #: Start of each view in s since that of the measurement, if stored.
    starts_s: Sequence[float] | None = None
    #: Whether they are attenuated counts, as `mvrecon-simulate` states in the file.
    attenuated: bool = False
    #: Size of a pixel (v, u) in mm, if stored.
    pixel_mm: tuple[float, float] | None = None
    #: From a pixel's index (u, v, view) to the file's (x, y, z) in mm, if stored.
    affine: np.ndarray | None = None
    #: Whether views, and fields beside them, are stored as seen from the detector's back.
    mirrored: bool = False
    #: The HDF5 file of the scan, in which options may name further data sets.
    scan: Path | None = None
    #: Whether each frame of the file is a view; None: the files have views alone.
    kept: np.ndarray | None = None
    #: Where negative values mark pixels that a view could not measure: the number of those that the
    #: files state for all views.
    excluded: int | None = None
    #: Flat and dark fields that the file itself has, by "flat" and "dark".
    fields: Mapping[str, "ProjectionStack | float"] = {}
    #: Exposure, beam and places that the files state, by name: a text for each view, "" of none.
    stated: Mapping[str, Sequence[str]] = {}
    #: What the files state of the detector, by name, which fields have in common with their views.
    detector: Mapping[str, Any] = {}
    #: Units that a file of another program states for the pixels; they must suit their kind.
    units: str = ""
    #: Keys of the files that their reader does not know, and that may change values or geometry.
    unknown: Sequence[str] = ()
    #: Angles in degrees by which the files say that the cameras are turned, in either direction.
    angles: Sequence[float] = ()
    #: Name and options of the camera that the file states, those of the detector without pixels;
    #: the name is None where it states no beam.
    rig: Mapping[str, Any] | None = None

    def __init__(
        self,
        path: str | Path,
        names: Sequence[str],
        shape: tuple[int, int],
        dtype: np.dtype,
    ):
        self.path, self.names, self.dtype = Path(path), tuple(names), np.dtype(dtype)
        self.shape = (int(shape[0]), int(shape[1]))
        if not 0 < len(self.names) <= VIEWS or min(self.shape) < 1:
            got = f"{len(self.names)} views of {self.shape[0]} x {self.shape[1]} pixels"
            raise Refused(f"{path}: expected 1 to {VIEWS} views with pixels, got {got}")
        if self.dtype.kind not in "biuf":
            raise Refused(f"{path}: expected pixels that are integers or floats, got {self.dtype}")

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.names)

    @property
    def top(self) -> float | None:
        """Greatest grey value of the pixels' integer type; none for floats."""
        return None if self.dtype.kind == "f" else float(np.iinfo(self.dtype).max)

    @property
    def marked(self) -> Bool[Tensor, "v u"] | None:
        """Pixels that the files mark as bad in all views, those that are negative in the first;
        None of files without such marks.

        Warns:
            UserWarning: the files state more.
        """
        if self.excluded is None:
            return None
        marked = self.read(0, 1)[0] < 0
        if marked.sum() < self.excluded:
            warnings.warn(
                f"{self.path}: expected as many negative pixels as N_excluded_pixels states, "
                f"{self.excluded}, got {int(marked.sum())}; give the others as views.bad_pixels",
                stacklevel=2,
            )
        return marked

    def exposure(self, *names: str) -> Float[np.ndarray, " m"] | None:
        """The product of what files state of each view by names; None unless all are numbers."""
        texts = [self.stated.get(name, [""]) for name in names]
        try:
            return np.prod([[float(text) for text in one] for one in texts], axis=0)
        except ValueError:
            return None

    def check_rig(self, cameras: Cameras) -> None:
        """Compare cameras, one for each view, with what the file states of them.

        Raises:
            Refused: pixels of another size, or what a format adds.

        Warns:
            UserWarning: cameras that turn about the rows' common normal by other angles, or at
                another distance from the detector.
        """
        self._check_turn(cameras)
        self._check_distance(cameras)
        if self.pixel_mm is None:
            return
        down, right = self.pixel_mm
        sizes = torch.stack([cameras.v.norm(dim=-1), cameras.u.norm(dim=-1)], dim=-1)
        off = (sizes / sizes.new_tensor([down, right]) - 1).abs().amax(dim=-1)
        if off.max() > MAX_PITCH_DIFFERENCE:
            got = " x ".join(f"{size:g}" for size in sizes[off.argmax()].tolist())
            raise Refused(
                f"{self.path}: expected cameras with the file's pixels of {down:g} x {right:g} mm "
                f"(v, u), got {got} mm"
            )

    def _check_turn(self, cameras: Cameras) -> None:
        stated = cameras.v.new_tensor(self.angles)
        if len(stated) != self.n_views or apart(stated, stated[0]).max() <= MAX_ANGLE:
            return  # none, or an object that turns before a camera at rest
        upright = cameras.v.sum(dim=0)
        if upright.norm() < ALONG * cameras.v.norm(dim=-1).sum():
            return
        got, turn = turned(cameras, upright), stated - stated[0]
        off = torch.stack([apart(got, turn), apart(got, -turn)])
        off = off[off.amax(dim=1).argmin()]
        if off.max() > MAX_ANGLE:
            k = int(off.argmax())
            wanted, found = (apart(one[k], turn[0]) for one in (turn, got))
            warnings.warn(
                f"{self.path}: states that its cameras turn by {wanted:.1f} degrees from "
                f"{self.names[0]} to {self.names[k]}, got cameras that turn by {found:.1f}",
                stacklevel=2,
            )

    def _check_distance(self, cameras: Cameras) -> None:
        for name in DISTANCES:
            if cameras.parallel or (stated := self.exposure(name)) is None or not stated.all():
                continue
            normal = F.normalize(torch.linalg.cross(cameras.u, cameras.v), dim=-1)
            got = ((cameras.origin - cameras.source) * normal).sum(dim=-1).abs().cpu().numpy()
            k = int(np.abs(got / stated - 1).argmax())
            if abs(got[k] / stated[k] - 1) > MAX_DISTANCE_DIFFERENCE:
                warnings.warn(
                    f"{self.path}: states a {name} of {stated[k]:g} mm for {self.names[k]}, got a "
                    f"camera with {got[k]:g} mm from its source to the detector",
                    stacklevel=2,
                )

    @abstractmethod
    def _block(self, first: int, last: int) -> np.ndarray:
        """Read the views `first` to `last - 1` [m v u] as stored."""

    def read(self, first: int, last: int) -> Float[Tensor, "m v u"]:
        """Read the views `first` to `last - 1`, float32, in the stored unit.

        Raises:
            IndexError: views out of range.
            Refused: they cannot be read, or have non-finite values.
        """
        if not 0 <= first < last <= self.n_views:
            raise IndexError(
                f"{self.path}: expected views within 0 to {self.n_views}, got {first} to {last}"
            )
        rows, columns = self.shape
        check_memory(8 * (last - first) * rows * columns, f"{last - first} views of {self.path}")
        with file_errors(self.path, f"views {first} to {last - 1} cannot be read"):
            values = torch.from_numpy(self._block(first, last).astype(np.float32))
            if tuple(values.shape) != (last - first, rows, columns):
                raise Refused(
                    f"{self.path}: expected views {first} to {last - 1} of {rows} x {columns} "
                    f"pixels, got {tuple(values.shape)}"
                )
        if self.dtype.kind == "f" and (bad := (~values.isfinite()).sum(dim=(1, 2))).any():
            view = int(bad.argmax())
            raise Refused(
                f"{self.path}: expected finite pixels, got {int(bad[view])} that are NaN or "
                f"infinite in view {first + view} ({self.names[first + view]})"
            )
        return values

    def chunks(self, pixels: int = READ_PIXELS) -> Iterator[Float[Tensor, "m v u"]]:
        """All views in order, in chunks of a number of pixels (at least one view)."""
        step = max(1, pixels // (self.shape[0] * self.shape[1]))
        for first in range(0, self.n_views, step):
            yield self.read(first, min(first + step, self.n_views))

    def mean(self) -> tuple[Float[Tensor, "v u"], Float[Tensor, "m i j"]]:
        """Mean of all views, float32, in the stored unit, and the means of `PARTS` of each; memory
        of a few views.
        """
        total, parts = torch.zeros(self.shape, dtype=torch.float64), []
        for block in self.chunks():
            total += block.sum(dim=0, dtype=torch.float64)
            parts.append(F.adaptive_avg_pool2d(block, PARTS))
        return (total / self.n_views).float(), torch.cat(parts)


def binned(
    values: Float[Tensor, "m v u"], binning: tuple[int, int], counts: bool = False
) -> Float[Tensor, "m i j"]:
    """Join (rows, columns) of pixels into one: their mean, or of counts their sum, which a larger
    pixel counts and which is a Poisson number again.
    """
    if binning == (1, 1):
        return values
    return F.avg_pool2d(values[:, None], binning, divisor_override=1 if counts else None)[:, 0]


class Region:
    """A region of a detector, optionally binned.

    Args:
        detector: rows and columns of the whole detector.
        rows: first row, and one past the last; None: all.
        columns: first column, and one past the last; None: all.
        binning: rows and columns that form one pixel, one number or two.

    Raises:
        ValueError: rows or columns outside of the detector, or a binning that does not divide the
            region.
    """

    def __init__(
        self,
        detector: tuple[int, int],
        rows: Sequence[int] | None = None,
        columns: Sequence[int] | None = None,
        binning: int | Sequence[int] = 1,
    ):
        pair = (binning, binning) if isinstance(binning, int) else tuple(binning)
        kept = [
            (0, count) if ends is None else tuple(ends)
            for ends, count in zip((rows, columns), detector, strict=True)
        ]
        for name, part, count in zip(("rows", "columns"), kept, detector, strict=True):
            whole = len(part) == 2 and all(type(n) is int for n in part)
            if not (whole and 0 <= part[0] < part[1] <= count):
                raise ValueError(
                    f"Expected {name} as [first, behind the last] within 0 to {count}, got "
                    f"{shown(list(part))}"
                )
        sizes = [last - first for first, last in kept]
        if len(pair) != 2 or any(type(n) is not int or n < 1 for n in pair):
            raise ValueError(f"Expected a binning of one or two positive integers, got {binning!r}")
        if any(size % n for size, n in zip(sizes, pair, strict=True)):
            raise ValueError(
                f"Expected a binning that divides the {sizes[0]} rows and {sizes[1]} columns, got "
                f"{pair}; rows=[first, last] and columns=[first, last] leave some out"
            )
        self.detector, self.binning = detector, (pair[0], pair[1])
        self.rows, self.columns = ((first, last) for first, last in kept)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a view of the region."""
        (top, bottom), (left, right) = self.rows, self.columns
        return (bottom - top) // self.binning[0], (right - left) // self.binning[1]

    def cropped(self, values: Tensor) -> Tensor:
        """Crop pixels [... v u] to the region."""
        return values[..., slice(*self.rows), slice(*self.columns)]

    def binned(
        self, values: Float[Tensor, "m v u"], counts: bool = False
    ) -> Float[Tensor, "m i j"]:
        """Join cropped pixels; see `binned`."""
        return binned(values, self.binning, counts)

    def all_binned(self, mask: Bool[Tensor, "m v u"]) -> Bool[Tensor, "m i j"]:
        """Whether all pixels of a bin are true, for a cropped mask."""
        if self.binning == (1, 1):
            return mask
        return ~F.max_pool2d((~mask)[:, None].to(torch.float32), self.binning)[:, 0].bool()

    def seen_by(self, cameras: Cameras) -> Cameras:
        """Convert cameras of the whole detector to cameras of this region; a bin is centred on its
        pixels.

        Raises:
            ValueError: cameras of another detector.
        """
        if cameras.shape != self.detector:
            raise ValueError(
                f"Expected cameras with the {self.detector} pixels (rows, columns) of the views on "
                f"disk, before crop and binning, got {cameras.shape}; camera.detector.pixels=null "
                f"takes those of the views"
            )
        return cameras.cropped(self.rows, self.columns).binned(self.binning)
