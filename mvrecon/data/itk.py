"""MHA, MHD and NRRD images through SimpleITK, the extra `io`.

Convention: ITK's world is LPS (x to the patient's left, y to the back), mvrecon's is RAS as in
NIfTI: x and y change signs.
"""

import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files import checks
from mvrecon.core.files.atomic import written_whole
from mvrecon.data.itk_headers import HEADER, check_even, check_length, meta_header
from mvrecon.data.nrrd_header import nrrd_header
from mvrecon.data.resample import Slabs, oriented, planes, right_angled, storable
from mvrecon.geometry.grid import Grid

IO = {".mha": "MetaImageIO", ".mhd": "MetaImageIO", ".nrrd": "NrrdImageIO"}
#: From ITK's world (LPS) to RAS.
RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
#: SimpleITK's names of pixel types, and numpy's.
TYPES = {
    **{f"{bits}-bit signed integer": f"i{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"{bits}-bit unsigned integer": f"u{bits // 8}" for bits in (8, 16, 32, 64)},
    **{"32-bit float": "f4", "64-bit float": "f8"},
}


class ItkImage(NamedTuple):
    """An image with a checked header: pixels along (x, y, z), their type, the affine from index to
    ITK's world in mm, the number of axes in the file, of which those beyond three have one pixel,
    and the unit that it states of the values, "" of none.
    """

    path: Path
    size: tuple[int, int, int]
    dtype: np.dtype
    affine: np.ndarray
    axes: int
    unit: str

    def read(self, first: int, last: int) -> np.ndarray:
        """Read the planes `first` to `last - 1` along z, as [z y x]."""
        reader = _reader(self.path)
        rest = [0] * (self.axes - 3)
        reader.SetExtractIndex([0, 0, first, *rest][: self.axes])
        reader.SetExtractSize([*self.size[:2], last - first, *rest][: self.axes])
        with checks.file_errors(self.path, f"planes {first} to {last - 1} cannot be read"):
            itk = checks.io_library("SimpleITK", self.path)
            values = itk.GetArrayFromImage(reader.Execute())
        return values.reshape(last - first, *self.size[1::-1])


def itk_image(path: Path, views: bool = False) -> ItkImage:
    """Read the header of an image of three axes, checked against the file's size.

    Args:
        path: path of the file.
        views: accept an image of one plane, and a third axis without lengths.

    Raises:
        ImportError: SimpleITK is not installed.
        FileNotFoundError: nothing is there.
        Refused: damaged, cut short, not three axes (further axes of one pixel are dropped), several
        values per voxel, data in a file outside its folder, or an unknown unit of length.
    """
    checks.check_file(path, ", ".join(IO))
    with path.open("rb") as file:
        text = file.read(HEADER).decode("latin-1")
    nrrd = IO[path.suffix.lower()] == "NrrdImageIO"
    header = nrrd_header(path, text, views) if nrrd else meta_header(path, text)
    reader = _reader(path)
    with checks.file_errors(path, "cannot be read"):
        reader.ReadImageInformation()
        itk, size = checks.io_library("SimpleITK", path), reader.GetSize()
        kind = itk.GetPixelIDValueAsString(reader.GetPixelID())
        scalar = kind.removeprefix("vector of ") if reader.GetNumberOfComponents() == 1 else kind
        direction = np.reshape(reader.GetDirection(), (len(size), len(size)))
        mixed = direction[3:, :3].any() or direction[:3, 3:].any()
        if len(size) < 3 - views or {*size[3:]} - {1} or mixed or scalar not in TYPES:
            raise checks.Refused(
                f"{path}: expected three axes and one number per voxel, got {size} of {kind}"
            )
        size, dtype = (*size, 1)[:3], np.dtype(TYPES[scalar])
        offset, packed = 0 if header.data == path else header.first, header.encoding != "raw"
        checks.check_declared(path, size, dtype.itemsize, header.data, offset, packed)
        check_length(path, header, math.prod(size) * dtype.itemsize, dtype.itemsize)
        affine = np.eye(4)
        n = min(3, len(direction))
        affine[:n, :n] = direction[:n, :n] * reader.GetSpacing()[:n]
        affine[:n, 3] = reader.GetOrigin()[:n]
        affine[:3] *= header.mm
        check_even(path, header, float(np.linalg.norm(affine[:3, 2])))
    return ItkImage(path, size, dtype, affine, len(direction), header.unit)


def open_itk(path: str | Path) -> tuple[Slabs, Grid]:
    """Open an image: values as stored, and the grid in world mm (RAS).

    Axes are permuted and reversed (without moving values) until x, y, z run roughly to the
    patient's right, front and head.

    Raises:
        ImportError, FileNotFoundError, Refused: see `itk_image`.
    """
    image = itk_image(Path(path).expanduser())
    step = planes(image.size[0] * image.size[1])

    def passes():
        for first in range(0, image.size[2], step):
            yield first, image.read(first, min(first + step, image.size[2])).T

    return oriented(image.path, image.size, RAS @ image.affine, passes)


def save_itk(
    path: str | Path,
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    stored: np.ndarray | None = None,
) -> None:
    """Write a volume atomically as MHA or NRRD, float32, with the position of its voxels in ITK's
    world (LPS), in the order of axes of an affine `stored`, see `mvrecon.data.resample.storable`.

    Raises:
        ImportError: SimpleITK is not installed.
        ValueError: a grid whose axes are not at right angles, which the formats do not support; see
            `mvrecon.data.resample.storable`.
    """
    path, (values, affine) = Path(path), storable(path, volume, grid, stored)
    if not right_angled(grid):
        raise ValueError(
            f"{path}: expected voxel axes at right angles, got the affine {grid.affine.tolist()}; "
            f"NIfTI keeps it"
        )
    affine = RAS @ affine
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    itk = checks.io_library("SimpleITK", path)
    image = itk.GetImageFromArray(values)
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    image.SetDirection((affine[:3, :3] / spacing).flatten().tolist())
    with written_whole(path) as part:
        whole = part.with_name(part.name + path.suffix.lower())  # ITK goes by the ending
        try:
            itk.WriteImage(image, str(whole))
            os.replace(whole, part)
        finally:
            whole.unlink(missing_ok=True)


def _reader(path: Path) -> Any:
    reader = checks.io_library("SimpleITK", path).ImageFileReader()
    reader.SetImageIO(IO[path.suffix.lower()])
    reader.SetFileName(str(path))
    return reader
