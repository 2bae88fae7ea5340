"""Options of measured views on disk and of their correction."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from mvrecon.core.quantities import InsideOrFile, InsideOrPath
from mvrecon.data.projections.exposures import EXPOSURE_WORDS
from mvrecon.data.projections.opening import Layout
from mvrecon.data.projections.rings import Rings

Kind = Literal["integrals", "counts", "intensities"]


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Options of `MeasuredViews`.

    Args:
        path: a folder of TIFF, PNG, DICOM or RTK's images, or a file: HDF5 (NeXus, Data Exchange,
            views.h5), Nikon's .xtekct, TIFF, .npy, .mha, .mhd, .nrrd; see `open_projections`.
        kind: kind of the stored values: "integrals", used unchanged, "counts" of emission, which
            differ in how pixels are joined (`binning`), or "intensities" (grey values), converted
            to -ln of the transmission. None: as views.h5 states, counts for Interfile and DICOM NM,
            intensities for integer pixels; required for other floats.
        dark: grey values without a beam: a number, or images that are averaged: the name of a data
            set in the views' HDF5 file, or else a path. None: the folder's images whose names begin
            with dark, or else 0.
        flat: grey values without an object, as `dark`. None: the folder's images whose names begin
            with flat.
        exposure: exposure of each view on disk relative to that of the flat field (exposure time,
            or its product with the tube's current): grey values above the dark field are divided by
            it. The name of a data set in the views' HDF5 file, or <file>:<name> in another; a
            .npy, text with one number per line, a table with a column such as exposure, or
            <file>:<column>; or a name by which views and flat field state theirs, or several joined
            by `*`: count_time or control/data of NeXus, ExposureTime, ExposureInuAs and the like of
            DICOM; raises if others that they state contradict it. None: all alike, with a warning
            where they state several.
        floor: transmissions are clamped to at least this, line integrals to at most -ln floor.
        dead: pixels whose flat - dark is at most this part of its median are dead: filled from
            their neighbours, and not in the mask.
        bad_pixels: mask of pixels that measure wrongly, 0 good and 1 bad: an image or a .npy of the
            views' size on disk. They are filled and not in the mask, as dead ones; so are those
            that the files mark as bad.
        find_bad_pixels: also find dead, hot and stuck pixels by the views themselves, and single
            bright ones (zingers) in each view, of grey values and of other programs' integrals.
        rings: remove the rings of pixels that measure unequally, which reads all views first:
            "gains" subtracts one number from each pixel's line integrals, "sorting" (by algotom)
            compares sorted columns of the sinogram; see `without_rings`. None: they stay.
        ring_width: widest ring in pixels.
        saturation: grey value from which a pixel is saturated: its line integral is an upper bound,
            and it is not in the mask. None: the largest of the bits that a file states, or of its
            integer type; none for floats.
        rows: region of the detector, [first, one past the last]; None: all.
        columns: columns of the detector's region, [first, one past the last]; None: all.
        linearise: coefficients c1, c2, ... of the polynomial c1 p + c2 p^2 + ... of the line
            integrals p that corrects beam hardening. In apps, "fit" fits it to the views, which
            must be those of a uniform object; see `fit_linearisation`.
        binning: pixels that form one, one number or (rows, columns): the mean of their
            transmissions, as a larger pixel measures; for stored integrals, of these; of counts
            the sum.
        flip_rows: reverse the rows of every view first: for a geometry file whose rows run the
            other way (its own option `flip_rows`).
        flip_columns: reverse the columns of every view: for mirrored images, such as of the
            detector's back. Those of Nikon's .xtekct are reversed without it.
        every: use the first view and every n-th after it.
        pattern: pattern of the images' names in a folder, such as "scan_*.tif"; None: all.
        gaps: allow names whose numbers have unequal steps.
        layout: "projections", or "sinogram": the images are those of slices, from the uppermost
            down, with the angles as rows. None: projections, but of a single image the layout must
            be given.
        dataset: name of the frames [m v u] in an HDF5 file; None: those of NXtomo or Data Exchange.
            In DICOM NM, with mvrecon-spect, window2, frame3 or window2/frame3.
        angles: name of the angles in an HDF5 file, or <file>:<name> in another file; None: those of
            NXtomo or Data Exchange.
        image_key: name of the frames' keys in an HDF5 file, or <file>:<name> in another: 0 views, 1
            flat and 2 dark fields; None: that beside the frames, if any.

    Raises:
        ValueError: an unknown kind or layout, or numbers out of range.
    """

    path: str | Path
    kind: Kind | None = None
    dark: float | InsideOrPath | None = None
    flat: float | InsideOrPath | None = None
    exposure: Annotated[InsideOrFile, EXPOSURE_WORDS] | None = None
    floor: float = 1e-4
    dead: float = 0.05
    bad_pixels: str | Path | None = None
    find_bad_pixels: bool = True
    rings: Rings | None = None
    ring_width: int = 2
    saturation: float | None = None
    rows: Sequence[int] | None = None
    columns: Sequence[int] | None = None
    linearise: Sequence[float] | Literal["fit"] | None = None
    binning: int | Sequence[int] = 1
    flip_rows: bool = False
    flip_columns: bool = False
    every: int = 1
    pattern: str | None = None
    gaps: bool = False
    layout: Layout | None = None
    dataset: str | None = None
    angles: InsideOrFile | None = None
    image_key: InsideOrFile | None = None

    def __post_init__(self) -> None:
        if self.kind is not None and self.kind not in get_args(Kind):
            raise ValueError(f"Expected a kind of {', '.join(get_args(Kind))}, got {self.kind!r}")
        if self.layout is not None and self.layout not in get_args(Layout):
            raise ValueError(
                f"Expected a layout of {', '.join(get_args(Layout))}, got {self.layout!r}"
            )
        if not (0 < self.floor < 1 and 0 <= self.dead < 1 and self.every >= 1):
            raise ValueError(
                "Expected a floor between 0 and 1, dead from 0 to below 1, every from 1 on, got "
                f"floor {self.floor}, dead {self.dead}, every {self.every}"
            )
        if self.rings not in (None, *get_args(Rings)) or self.ring_width < 1:
            raise ValueError(
                f"Expected rings of {', '.join(get_args(Rings))} or null and a ring_width of at "
                f"least 1, got {self.rings!r} and {self.ring_width}"
            )
        if self.saturation is not None and not self.saturation > 0:
            raise ValueError(f"Expected a positive saturation, got {self.saturation}")

    @property
    def used(self) -> set[str]:
        """Names, without their groups, of the data sets that options may name in an HDF5 file."""
        fields = (self.dark, self.flat, self.exposure, self.bad_pixels)
        given = (self.dataset, self.angles, self.image_key, *fields)
        return {str(name).rpartition("/")[2] for name in given}
