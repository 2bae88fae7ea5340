"""MHA, MHD and NRRD images through SimpleITK, the extra `io`.

Convention: ITK's world is LPS (x to the patient's left, y to the back), mvrecon's is RAS as in
NIfTI: x and y change signs.
"""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files import checks
from mvrecon.core.files.atomic import written_whole
from mvrecon.data.resample import Slabs, oriented, planes, right_angled, storable
from mvrecon.geometry.grid import Grid

IO = {".mha": "MetaImageIO", ".mhd": "MetaImageIO", ".nrrd": "NrrdImageIO"}
#: Maximum bytes of a header.
HEADER = 2**16
#: Maximum characters of a line of an NRRD header, except comments and key/value pairs: ITK
#: overflows a buffer at 1000, which ends the process (SimpleITK 2.5.7; 500 are safe).
LINE = 500
#: Millimetres in the units of length of an NRRD header, which ITK ignores; "" is NRRD's unknown
#: unit.
MILLIMETRES = {"": 1.0, "nm": 1e-6, "um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3}
#: From ITK's world (LPS) to RAS.
RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
#: SimpleITK's names of pixel types, and numpy's.
TYPES = {
    **{f"{bits}-bit signed integer": f"i{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"{bits}-bit unsigned integer": f"u{bits // 8}" for bits in (8, 16, 32, 64)},
    **{"32-bit float": "f4", "64-bit float": "f8"},
}


class ItkImage(NamedTuple):
    """An image with a checked header: pixels along (x, y, z), their type, and the affine from index
    to ITK's world in mm.
    """

    path: Path
    size: tuple[int, int, int]
    dtype: np.dtype
    affine: np.ndarray

    def read(self, first: int, last: int) -> np.ndarray:
        """Read the planes `first` to `last - 1` along z, as [z y x]."""
        reader = _reader(self.path)
        reader.SetExtractIndex([0, 0, first])
        reader.SetExtractSize([*self.size[:2], last - first])
        with checks.file_errors(self.path, f"planes {first} to {last - 1} cannot be read"):
            return checks.io_library("SimpleITK", self.path).GetArrayFromImage(reader.Execute())


def itk_image(path: Path) -> ItkImage:
    """Read the header of an image of three axes, checked against the file's size.

    Raises:
        ImportError: SimpleITK is not installed.
        FileNotFoundError: nothing is there.
        Refused: damaged, cut short, not three axes, several values a voxel, data in a file that is
        not beside it, or an unknown unit of length.
    """
    checks.check_file(path, ", ".join(IO))
    data, packed, mm = _data_file(path)
    reader = _reader(path)
    with checks.file_errors(path, "cannot be read"):
        reader.ReadImageInformation()
        itk, size = checks.io_library("SimpleITK", path), reader.GetSize()
        kind = itk.GetPixelIDValueAsString(reader.GetPixelID())
        if len(size) != 3 or kind not in TYPES:
            raise checks.Refused(
                f"{path}: expected three axes and one number a voxel, got {size} of {kind}"
            )
        dtype = np.dtype(TYPES[kind])
        checks.check_declared(path, size, dtype.itemsize, data, packed=packed)
        affine = np.eye(4)
        direction = np.array(reader.GetDirection()).reshape(3, 3)
        affine[:3, :3], affine[:3, 3] = direction * reader.GetSpacing(), reader.GetOrigin()
        affine[:3] *= mm
    return ItkImage(path, size, dtype, affine)


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


def save_itk(path: str | Path, volume: Float[Tensor, "d h w"], grid: Grid) -> None:
    """Write a volume atomically as MHA or NRRD, float32, with the position of its voxels in ITK's
    world (LPS).

    Raises:
        ImportError: SimpleITK is not installed.
        ValueError: a grid whose axes are not at right angles, which the formats do not support; see
            `mvrecon.data.resample.storable`.
    """
    path, values = Path(path), storable(path, volume, grid)
    if not right_angled(grid):
        raise ValueError(
            f"{path}: expected voxel axes at right angles, got the affine {grid.affine.tolist()}; "
            f"NIfTI keeps it"
        )
    affine = RAS @ grid.affine.numpy()
    itk = checks.io_library("SimpleITK", path)
    image = itk.GetImageFromArray(values)
    image.SetSpacing(grid.spacing)
    image.SetOrigin(affine[:3, 3].tolist())
    image.SetDirection((affine[:3, :3] / grid.spacing).flatten().tolist())
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


def _data_file(path: Path) -> tuple[Path, bool, float]:
    """The file of the values, which must be beside the header, whether it is compressed, and the
    header's unit of length in mm.
    """
    with path.open("rb") as file:
        text = file.read(HEADER).decode("latin-1")
    if IO[path.suffix.lower()] == "NrrdImageIO":
        entries = _entries(_nrrd_lines(path, text), ":")
        if {"data file", "datafile"} & set(entries):
            raise checks.Refused(f"{path}: expected NRRD with its values in the same file")
        return path, entries.get("encoding") not in ("raw",), _millimetres(path, entries)
    entries = _entries(text.splitlines(), "=")
    name = entries.get("elementdatafile")
    if name is None:
        raise checks.Refused(f"{path}: expected a MetaImage header with ElementDataFile, got none")
    data = path if name == "LOCAL" else path.with_name(checks.plain_name(name, path))
    if not data.is_file():
        raise FileNotFoundError(
            f"{path}: its values should be in {checks.shown(name)}, which is missing"
        )
    return data, entries.get("compresseddata", "").lower() == "true", 1.0


def _millimetres(path: Path, entries: Mapping[str, str]) -> float:
    """Unit of length of an NRRD header in mm."""
    texts = (entries.get(field, "") for field in ("units", "space units"))
    named = {unit for text in texts for unit in re.findall(r'"([^"]*)"', text)} or {""}
    if len(named) > 1 or not named <= MILLIMETRES.keys():
        raise checks.Refused(
            f"{path}: expected one unit of length for all axes, of "
            f"{', '.join(filter(None, MILLIMETRES))}, got {checks.shown(sorted(named))}"
        )
    return MILLIMETRES[named.pop()]


def _nrrd_lines(path: Path, text: str) -> list[str]:
    """The lines of an NRRD header up to an empty one, as ITK's C reader splits them: Python's
    `splitlines` also splits at other characters.
    """
    lines = [line.removesuffix("\r") for line in text.split("\n")]
    if not lines[0].startswith("NRRD") or "" not in lines:
        raise checks.Refused(f"{path}: expected an NRRD header of at most {HEADER} bytes")
    header = lines[: lines.index("")]
    for line in header:
        free = line.startswith("#") or (":=" in line and ": " not in line)
        if len(line) > LINE and not free:
            raise checks.Refused(
                f"{path}: expected lines of at most {LINE} characters in its header, got "
                f"{checks.shown(line)}"
            )
    return header


def _entries(lines: Sequence[str], sign: str) -> dict[str, str]:
    entries: dict[str, str] = {}
    for line in lines:
        key, between, value = line.partition(sign)
        if between:
            entries.setdefault(key.strip().lower(), value.strip())
        if key.strip().lower() == "elementdatafile":
            break  # values follow
    return entries
