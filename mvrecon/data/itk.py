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
from mvrecon.core.files.keys import Key, check_keys
from mvrecon.data.resample import Slabs, oriented, planes, right_angled, storable
from mvrecon.geometry.grid import Grid

IO = {".mha": "MetaImageIO", ".mhd": "MetaImageIO", ".nrrd": "NrrdImageIO"}
#: Maximum bytes of a header.
HEADER = 2**16
#: Maximum characters of a line of an NRRD header, except comments and key/value pairs: ITK
#: overflows a buffer at 1000, which ends the process (SimpleITK 2.5.7; 500 are safe).
LINE = 500
#: Millimetres in the units of length of a header, which ITK ignores; "" is NRRD's unknown unit, "?"
#: MetaImage's.
MILLIMETRES = {"": 1.0, "?": 1.0, "nm": 1e-6, "um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3}
#: Keys of MetaImage (.mha, .mhd), all applied by ITK but where noted.
META_KEYS = (
    *(Key(name, "applied") for name in ("DimSize", "ElementType", "ElementSpacing")),
    Key("ElementSize", "applied", "where there is no ElementSpacing"),
    Key("Offset", "applied", "of the first voxel's centre"),
    Key("Position, Origin", "compared", "other names of Offset"),
    Key("TransformMatrix", "applied"),
    Key("Rotation, Orientation", "compared", "other names of TransformMatrix"),
    Key("BinaryDataByteOrderMSB", "applied"),
    Key("ElementByteOrderMSB", "compared", "another name of BinaryDataByteOrderMSB"),
    Key("CompressedData", "applied"),
    Key("DistanceUnits", "applied", "by mvrecon, to mm"),
    Key("HeaderSize", "applied", "of a file with values alone, as bytes before them"),
    Key("ElementToIntensityFunctionSlope", "refused", "store the values it gives", (1,)),
    Key("ElementToIntensityFunctionOffset", "refused", "store the values it gives", (0,)),
    Key("ElementNumberOfChannels", "refused", "one number a voxel", (1,)),
    Key("ElementDataFile", "applied", "LOCAL, or one file beside the header"),
    Key("CenterOfRotation", "ignored", "of transforms, not of voxels"),
    Key("AnatomicalOrientation", "ignored", "TransformMatrix decides"),
    Key("ElementMin, ElementMax, Modality", "ignored", "statistics and origin"),
)
#: Keys of NRRD, all applied by ITK but where noted.
NRRD_KEYS = (
    *(Key(name, "applied") for name in ("type", "sizes", "endian", "encoding")),
    Key("byte skip", "applied"),
    Key("line skip", "applied"),
    Key("space directions", "applied"),
    Key("space origin", "applied"),
    Key("spacings", "applied", "where there are no space directions"),
    Key(
        "space",
        "refused",
        "ITK takes other spaces for left-posterior-superior",
        (
            *("left-posterior-superior", "right-anterior-superior", "left-anterior-superior"),
            *("LPS", "RAS", "LAS", "3D-right-handed", "3DR"),
        ),
    ),
    Key("space units", "applied", "by mvrecon, to mm"),
    Key("units", "applied", "by mvrecon, to mm"),
    Key("axis mins", "refused", "space origin has the position", ("nan nan nan",)),
    Key("axis maxs", "refused", "space directions have the voxel size", ("nan nan nan",)),
    Key("old min", "refused", "store the values before they were quantized", ("nan",)),
    Key("old max", "refused", "store the values before they were quantized", ("nan",)),
    Key("data file", "refused", "its values in the same file"),
    Key("measurement frame", "ignored", "of vectors"),
    Key("min, max, thicknesses, centerings", "ignored", "statistics, and extent of a voxel"),
)
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
    data, packed, mm, offset = _data_file(path)
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
        checks.check_declared(path, size, dtype.itemsize, data, offset, packed)
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


def _data_file(path: Path) -> tuple[Path, bool, float, int]:
    """The file of the values, which must be beside the header, whether it is compressed, the
    header's unit of length in mm, and the bytes before the values.
    """
    with path.open("rb") as file:
        text = file.read(HEADER).decode("latin-1")
    if IO[path.suffix.lower()] == "NrrdImageIO":
        entries = _entries(_nrrd_lines(path, text), ":")
        check_keys(path, NRRD_KEYS, lambda k: entries.get(k, entries.get(k.replace(" ", ""))))
        return path, entries.get("encoding") not in ("raw",), _millimetres(path, entries), 0
    entries = _entries(text.splitlines(), "=")
    name = entries.get("elementdatafile")
    if name is None:
        raise checks.Refused(f"{path}: expected a MetaImage header with ElementDataFile, got none")
    check_keys(path, META_KEYS, lambda key: entries.get(key.lower()))
    _check_repeated(path, entries)
    data = path if name == "LOCAL" else path.with_name(checks.plain_name(name, path))
    if not data.is_file():
        raise FileNotFoundError(
            f"{path}: its values should be in {checks.shown(name)}, which is missing"
        )
    with checks.file_errors(path, "has a HeaderSize of no number"):
        skipped = int(entries.get("headersize", 0))
    if skipped < -1 or (skipped > 0 and name == "LOCAL"):
        raise checks.Refused(
            f"{path}: expected a HeaderSize of a file with values alone, got {skipped} for {name}"
        )
    packed = entries.get("compresseddata", "").lower() == "true"
    return data, packed, _millimetres(path, entries), max(0, skipped)


def _check_repeated(path: Path, entries: Mapping[str, str]) -> None:
    """Raise for a MetaImage header that states one thing by several names in several ways."""
    for names in (
        ("Offset", "Position", "Origin"),
        ("TransformMatrix", "Rotation", "Orientation"),
        ("BinaryDataByteOrderMSB", "ElementByteOrderMSB"),
    ):
        stated = {n: " ".join(entries[n.lower()].split()) for n in names if n.lower() in entries}
        if len({text.lower() for text in stated.values()}) > 1:
            raise checks.Refused(
                f"{path}: expected one value of {' and '.join(stated)}, which state the same, got "
                f"{checks.shown(list(stated.values()))}"
            )


def _millimetres(path: Path, entries: Mapping[str, str]) -> float:
    """Unit of length of a header in mm."""
    texts = (entries.get(field, "") for field in ("units", "space units"))
    named = {unit for text in texts for unit in re.findall(r'"([^"]*)"', text)}
    named = named or {entries.get("distanceunits", "")}
    if len(named) > 1 or not named <= MILLIMETRES.keys():
        raise checks.Refused(
            f"{path}: expected one unit of length for all axes, of "
            f"{', '.join(filter(str.isalpha, MILLIMETRES))}, got {checks.shown(sorted(named))}"
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
