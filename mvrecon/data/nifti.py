"""NIfTI volumes. Needs nibabel, the extra `io`."""

import gzip
import logging
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files import checks
from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.keys import Key, check_keys
from mvrecon.data.resample import Planes, Slabs, oriented, planes, right_angled, storable
from mvrecon.geometry.grid import Grid

EXPECTED = "a NIfTI volume of three axes (.nii or .nii.gz)"
ENDING = re.compile(r"\.nii(\.gz)?$", re.IGNORECASE)
#: Millimetres in a NIfTI header's units.
MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}
#: Header size, its first field, by NIfTI's version.
HEADERS = {348: "Nifti1", 540: "Nifti2"}
#: NIfTI's code of a scanner's world; 0: none.
SCANNER = 1
#: Fields of a header; nibabel reads them.
KEYS = (
    *(Key(name, "applied") for name in ("dim", "datatype", "vox_offset")),
    Key("scl_slope", "applied"),
    Key("scl_inter", "applied"),
    Key("xyzt_units", "applied", "of length; unknown is mm"),
    Key("sform", "applied", "where sform_code is not 0"),
    Key(
        "qform",
        "applied",
        "where sform_code is 0; else compared with the sform: refused if both have one code, and "
        "a warning if they have several",
    ),
    Key(
        "pixdim",
        "applied",
        "in the qform, or alone where both codes are 0; else compared with the sform (a warning)",
    ),
    Key("magic", "refused", "header and values in one file", ("n+1", "n+2")),
    Key("cal_min, cal_max", "ignored", "display alone"),
    Key("intent_code, slice_code, toffset", "ignored", "not of values or places"),
)
#: Largest distance of a voxel's place by sform and by qform, in voxels.
APART = 0.1
#: Voxels along an axis that the header's 16-bit integers count.
MOST = 2**15 - 1
#: Share of a voxel that single precision may move it.
MOVED = 1e-3
SILENT = logging.Logger("nibabel's remarks", logging.CRITICAL)


def open_nifti(path: str | Path) -> tuple[Slabs, Grid]:
    """Open a NIfTI volume: values with slope and intercept applied, and the grid in world mm.

    Axes are permuted and reversed (without moving values) until x, y, z run roughly to the
    patient's right, front and head; the grid's affine keeps any obliqueness. Header extensions are
    ignored. Compressed files are read to their end, with the checksum; a plain .nii has none, so
    damaged values go undetected.

    Raises:
        ImportError: nibabel is not installed.
        FileNotFoundError: nothing is there.
        ValueError: not NIfTI, cut short, damaged, not three axes (further axes of one voxel are
            dropped), larger than the file can hold, an invalid affine, or sform and qform of one
            code that differ. Damage behind the header is raised by the passes of the slabs.

    Warns:
        UserWarning: sform and qform of two codes differ, or sform and pixdim.
    """
    path = Path(path)
    checks.check_file(path, EXPECTED)
    with checks.file_errors(path, "cannot be read", f"is it cut short? Expected {EXPECTED}"):
        header = _header(path)
        declared, dtype = header.get_data_shape(), header.get_data_dtype()
        shape, others = tuple(map(int, declared[:3])), set(declared[3:])
        if len(shape) != 3 or min(shape) < 1 or others - {1} or dtype.kind not in "iuf":
            raise checks.Refused(f"{path}: has {dtype} of shape {declared}; expected {EXPECTED}")
        offset = int(header["vox_offset"])
        checks.check_declared(path, shape, dtype.itemsize, path, offset, _packed(path), working=8)
        affine = header.get_best_affine()
        _check_forms(path, header, shape)
        affine[:3] *= MILLIMETRES[header.get_xyzt_units()[0]]
        slope, intercept = header.get_slope_inter()
        scale = (1.0, 0.0) if slope is None else (slope, intercept)
        stored = Stored(shape, dtype, offset, *scale)
        return oriented(path, shape, affine, lambda: _passes(path, stored))


class Stored(NamedTuple):
    """Layout of values in a file for nibabel: voxels along i, j, k, type, first byte, slope and
    intercept.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    offset: int
    slope: float
    intercept: float


def _check_forms(path: Path, header: Any, shape: tuple[int, ...]) -> None:
    """Compare the sform with the qform, by the places of the corners, or with pixdim alone."""
    codes, sizes = (int(header["sform_code"]), int(header["qform_code"])), header.get_zooms()[:3]
    if codes[0] == 0:
        return
    sform = header.get_sform()
    if codes[1]:
        corners = np.array([[*index, 1] for index in np.ndindex(2, 2, 2)])
        corners = corners * [*np.array(shape) - 1, 1]
        off = np.linalg.norm(corners @ (sform - header.get_qform())[:3].T, axis=1).max()
        off, what = off / min(sizes), f"qform (code {codes[1]})"
    else:
        spacing = np.linalg.norm(sform[:3, :3], axis=0)
        off, what = (np.abs(spacing / sizes - 1) * shape).max(), "pixdim"
    if off > APART:
        message = (
            f"{path}: expected a {what} that agrees with the sform (code {codes[0]}), got corners "
            f"that differ by {off:.3g} voxels"
        )
        if codes[0] == codes[1]:
            raise checks.Refused(f"{message}; remove one: image.set_qform(None, 0)")
        warnings.warn(f"{message}; the sform decides", stacklevel=2)


def _passes(path: Path, stored: Stored) -> Iterator[Planes]:
    """One pass over a file, whose last axis varies slowest: planes of equal index along it."""
    from nibabel.arrayproxy import ArrayProxy

    i, j, k = stored.shape
    step = planes(i * j)
    with (
        checks.file_errors(path, "cannot be read", f"is it cut short? Expected {EXPECTED}"),
        _opened(path) as file,
    ):
        for first in range(0, k, step):
            count, place = (
                min(step, k - first),
                stored.offset + first * i * j * stored.dtype.itemsize,
            )
            part = ArrayProxy(file, stored._replace(shape=(i, j, count), offset=place), mmap=False)
            yield first, np.asanyarray(part, dtype="float32")
        rest = 0  # compressed files have their checksum at the end
        while isinstance(file, gzip.GzipFile) and (block := file.read(2**20)):
            if (rest := rest + len(block)) > checks.TEXT:
                raise checks.Refused(
                    f"{path}: has over {checks.TEXT} bytes behind the volume it declares; "
                    f"expected {EXPECTED}"
                )


def _opened(path: Path) -> IO[bytes]:
    return gzip.open(path) if _packed(path) else path.open("rb")  # type: ignore[return-value]


def _packed(path: Path) -> bool:
    return path.suffix.lower() == ".gz"


def save_nifti(path: str | Path, volume: Float[Tensor, "d h w"], grid: Grid) -> None:
    """Write a volume as NIfTI, float32, in mm, x first: the grid's affine becomes the sform and, if
    the voxel axes are at right angles, the qform.

    Compressed if the name ends in .gz (deterministically), and replaced atomically.

    Raises:
        ImportError: nibabel is not installed.
        ValueError: a grid so far from the origin that the header's single precision would move its
            voxels, or with more of them along an axis than the header counts; see
            `mvrecon.data.resample.storable`.
    """
    nibabel = checks.io_library("nibabel", path)
    values = np.ascontiguousarray(storable(path, volume, grid).transpose(2, 1, 0))
    rounded = grid.affine.float().double()
    corners = grid.to_index(grid.corners())
    off = corners @ (rounded - grid.affine)[:3, :3].T + (rounded - grid.affine)[:3, 3]
    if (moved := (torch.linalg.inv(grid.affine[:3, :3]) @ off.T).abs().max().item()) > MOVED:
        raise ValueError(
            f"{path}: expected a grid whose affine NIfTI can hold in single precision, got one "
            f"whose voxels would move by up to {moved:.2g} of a voxel, centred about "
            f"{grid.centre.tolist()} mm; .mha and .nrrd keep it"
        )
    if max(grid.size) > MOST:
        raise ValueError(
            f"{path}: expected at most {MOST} voxels along an axis in NIfTI, got {grid.size}; .mha "
            f"and .nrrd keep them"
        )
    image = nibabel.Nifti1Image(values, grid.affine.numpy())
    image.header.set_xyzt_units("mm")
    image.set_sform(grid.affine.numpy(), SCANNER)
    image.set_qform(grid.affine.numpy(), SCANNER if right_angled(grid) else 0)
    raw = image.to_bytes()
    packed = gzip.compress(raw, 1, mtime=0) if _packed(Path(path)) else raw
    with written_whole(path) as part:
        part.write_bytes(packed)


def _header(path: Path) -> Any:
    """Read the header only: nibabel's own way would invoke parsers of extensions and
    other formats.
    """
    with _opened(path) as file:
        raw = file.read(max(HEADERS))
    sizes = [int.from_bytes(raw[:4], order) for order in ("little", "big")]
    size = next((size for size in sizes if size in HEADERS), None)
    if size is None or not ENDING.search(path.name):
        raise checks.Refused(
            f"{path}: cannot be read: it does not begin as a NIfTI file does; expected {EXPECTED}"
        )
    header = getattr(checks.io_library("nibabel", path), f"{HEADERS[size]}Header")(
        raw[:size], check=False
    )
    check_keys(path, KEYS, {"magic": header["magic"].item().decode("latin-1")}.get)
    header.check_fix(
        logger=SILENT, error_level=35
    )  # from a negative voxel size on; nibabel's other repairs are harmless
    return header
