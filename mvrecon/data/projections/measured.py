"""Options of measured views: their files, and how grey values become line integrals."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Kind = Literal["integrals", "intensities"]
Field = str | float | None


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Options of measured views, which `MeasuredViews.of` opens.

    Args:
        path: a folder of TIFF, PNG or DICOM images, or a file: views.h5, TIFF, .npy, .mha, .mhd,
            .nrrd; see `open_projections`.
        kind: of the stored values: "integrals" (or counts), which are used as they are, or
            "intensities" (grey values), which become -ln of the transmission. None: integrals of
            views.h5, intensities of integer pixels; other floats must say.
        dark: grey values without a beam: a number, or a path to images that are averaged. None: the
            folder's own, whose names begin with dark, or else 0.
        flat: grey values without an object, in the same way. None: the folder's own, whose names
            begin with flat.
        floor: transmission; less counts as this much, so that no line integral exceeds -ln floor.
        dead: pixels whose flat - dark is at most this part of its median are dead: filled from
            their neighbours, and out of the mask.
        saturation: grey value from which a pixel is saturated: its line integral is an upper bound,
            and it is out of the mask. None: the largest of the integer type, never for floats.
        rows: of the detector that are kept, [first, behind the last]; None: all.
        columns: of the detector that are kept, in the same way.
        binning: pixels that are joined into one, one number or (rows, columns): the mean of their
            transmissions, as a larger pixel measures; of integrals where these are stored.
        flip_rows: reverse the rows of every view, before anything else: for a geometry file whose
            rows run the other way (its own option `flip_rows`).
        flip_columns: reverse the columns of every view: for images that are mirrored, as where they
            show the detector from behind.
        every: take the first view and every n-th after it.
        pattern: of the names of the images in a folder, such as "scan_*.tif"; None: all.
        gaps: allow names whose numbers are not in equal steps.

    Raises:
        ValueError: an unknown kind, or numbers out of range.
    """

    path: str
    kind: Kind | None = None
    dark: Field = None
    flat: Field = None
    floor: float = 1e-4
    dead: float = 0.05
    saturation: float | None = None
    rows: Sequence[int] | None = None
    columns: Sequence[int] | None = None
    binning: int | Sequence[int] = 1
    flip_rows: bool = False
    flip_columns: bool = False
    every: int = 1
    pattern: str | None = None
    gaps: bool = False

    def __post_init__(self) -> None:
        if self.kind is not None and self.kind not in get_args(Kind):
            raise ValueError(f"Expected the kind integrals or intensities, got {self.kind!r}")
        if not (0 < self.floor < 1 and 0 <= self.dead < 1 and self.every >= 1):
            raise ValueError(
                "Expected a floor between 0 and 1, dead from 0 to below 1, every from 1 on, got "
                f"floor {self.floor}, dead {self.dead}, every {self.every}"
            )
        if self.saturation is not None and not self.saturation > 0:
            raise ValueError(f"Expected a positive saturation, got {self.saturation}")
