"""NIfTI volumes. Needs nibabel, the extra `io`."""

import gzip
import logging
import math
import re
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files import checks
from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.keys import SEARCHED, Key, check_keys, has_effect, warn_of_unknown
from mvrecon.data.resample import Planes, Slabs, oriented, planes, right_angled, storable
from mvrecon.geometry.grid import Grid

EXPECTED = "a NIfTI volume of three axes (.nii or .nii.gz)"
#: Millimetres in a NIfTI header's units of length, by their codes: unknown, m, mm, um.
MILLIMETRES = {0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3}
#: Bits of xyzt_units: of length, and of length and time.
LENGTH_BITS, UNIT_BITS = 0b111, 0b111111
#: Largest code of a form: a template's world.
MAX_FORM_CODE = 5
#: Header size, its first field, by NIfTI's version.
HEADER_SIZES = {348: "Nifti1", 540: "Nifti2"}
#: NIfTI's code of a scanner's world; 0: none.
SCANNER_CODE = 1
#: Fields of a header; nibabel reads them.
KEYS = (
    Key("dim", "applied", "three axes; further ones of one voxel, or 0, are dropped"),
    Key("datatype", "applied"),
    Key("bitpix", "compared", "with datatype"),
    Key("vox_offset", "applied", "behind the header; bytes behind the values are reported"),
    Key("scl_slope", "applied", "none if 0 or nan"),
    Key("scl_inter", "applied", "where there is a slope"),
    Key("xyzt_units", "applied", "of length; unknown is mm"),
    Key("sform_code, qform_code", "applied", "0 to 5; a warning where both are 0"),
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
        "in the qform (the first as its hand), or alone where both codes are 0; else compared with "
        "the sform (a warning)",
    ),
    Key("magic", "refused", "header and values in one file", ("n+1", "n+2")),
    Key("cal_min, cal_max", "ignored", "display alone"),
    Key("intent_code, dim_info, slice_code, toffset", "ignored", "not of values or places"),
    Key(
        "descrip, intent_name, aux_file, header extensions",
        "ignored",
        "a warning of texts such as slope=2 or 1/cm, and of extensions of unknown codes",
    ),
)
#: Fields of text, the code of an extension that is a comment, and its characters that are read.
TEXTS, COMMENT_CODE, COMMENT = ("descrip", "intent_name", "aux_file"), 6, 2**12
#: Between the name and the value of a statement in a text, and a unit in it.
BETWEEN = re.compile(r"[=:]|\s(?=[-+]?\.?\d)")
INVERSE_CM = re.compile(r"/ ?cm\b|\bcm ?\^? ?-1\b", re.IGNORECASE)
#: Largest distance of a voxel's place by sform and by qform, in voxels.
MAX_FORM_DISTANCE = 0.1
#: Voxels along an axis that the header's 16-bit integers count.
MAX_AXIS_VOXELS = 2**15 - 1
#: Share of a voxel that single precision may move it.
MAX_ROUNDING_SHARE = 1e-3
SILENT_LOGGER = logging.Logger("nibabel's remarks", logging.CRITICAL)


def open_nifti(path: str | Path) -> tuple[Slabs, Grid]:
    """Open a NIfTI volume: values with slope and intercept applied, and the grid in world mm.

    Axes are permuted and reversed (without moving values) until x, y, z run roughly to the
    patient's right, front and head; the grid's affine keeps any obliqueness. Compressed files are
    read to their end, with the checksum; a plain .nii has none, so damaged values go undetected.

    Raises:
        ImportError: nibabel is not installed.
        FileNotFoundError: nothing is there.
        ValueError: not NIfTI, cut short, damaged, not three axes (further axes of one voxel are
            dropped), larger than the file can hold, an invalid affine, or sform and qform of one
            code that differ. Damage behind the header is raised by the passes of the slabs.

    Warns:
        UserWarning: sform and qform of two codes differ, or sform and pixdim; neither form is
            stated; the file holds more than the volume it declares; or a text or an extension of
            the header may state a factor or a unit.
    """
    path = Path(path)
    checks.check_file(path, EXPECTED)
    with checks.file_errors(path, "cannot be read", f"is it cut short? Expected {EXPECTED}"):
        header = _header(path)
        declared, dtype = header.get_data_shape(), header.get_data_dtype()
        shape, others = tuple(map(int, declared[:3])), set(declared[3:])
        if len(shape) != 3 or min(shape) < 1 or others - {0, 1} or dtype.kind not in "iuf":
            raise checks.Refused(f"{path}: has {dtype} of shape {declared}; expected {EXPECTED}")
        offset = int(header["vox_offset"])
        checks.check_declared(path, shape, dtype.itemsize, path, offset, _packed(path), working=8)
        rest = path.stat().st_size - offset - math.prod(shape) * dtype.itemsize
        if rest and not _packed(path):
            warnings.warn(
                f"{path}: has {rest} bytes behind the volume it declares; are dim, datatype and "
                f"vox_offset right?",
                stacklevel=2,
            )
        warn_of_unknown(path, _texts(path, header))
        affine = header.get_best_affine()
        _check_forms(path, header, shape)
        affine[:3] *= MILLIMETRES[int(header["xyzt_units"]) & LENGTH_BITS]
        slope, intercept = header.get_slope_inter()
        scale = (1.0, 0.0) if slope is None else (slope, intercept)
        return oriented(path, shape, affine, lambda: _passes(path, shape, dtype, offset, *scale))


def _check_forms(path: Path, header: Any, shape: tuple[int, ...]) -> None:
    """Compare the sform with the qform, by the places of the corners, or with pixdim alone."""
    codes, sizes = (int(header["sform_code"]), int(header["qform_code"])), header.get_zooms()[:3]
    if codes[0] == 0:
        if codes[1] == 0:
            warnings.warn(
                f"{path}: has neither sform nor qform; its x is taken to run to the patient's left "
                f"and its centre to be at 0, as in nibabel",
                stacklevel=2,
            )
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
    if not off <= MAX_FORM_DISTANCE:
        message = (
            f"{path}: expected a {what} that agrees with the sform (code {codes[0]}), got corners "
            f"that differ by {off:.3g} voxels"
        )
        if codes[0] == codes[1]:
            raise checks.Refused(f"{message}; remove one: image.set_qform(None, 0)")
        warnings.warn(f"{message}; the sform decides", stacklevel=2)


def _passes(
    path: Path, shape: tuple[int, ...], dtype: np.dtype, offset: int, slope: float, intercept: float
) -> Iterator[Planes]:
    """One pass over a file, whose last axis varies slowest: planes of equal index along it."""
    from nibabel.arrayproxy import ArrayProxy

    i, j, k = shape
    step = planes(i * j)
    with (
        checks.file_errors(path, "cannot be read", f"is it cut short? Expected {EXPECTED}"),
        _opened(path) as file,
    ):
        for first in range(0, k, step):
            part, place = (i, j, min(step, k - first)), offset + first * i * j * dtype.itemsize
            values = ArrayProxy(file, (part, dtype, place, slope, intercept), mmap=False)
            yield first, np.asanyarray(values, dtype="float32")
        rest = 0  # compressed files have their checksum at the end
        while isinstance(file, gzip.GzipFile) and (block := file.read(2**20)):
            if (rest := rest + len(block)) > checks.MAX_TEXT_BYTES:
                raise checks.Refused(
                    f"{path}: has over {checks.MAX_TEXT_BYTES} bytes behind the volume it "
                    f"declares; expected {EXPECTED}"
                )


def _opened(path: Path) -> IO[bytes]:
    return gzip.open(path) if _packed(path) else path.open("rb")  # type: ignore[return-value]


def _packed(path: Path) -> bool:
    return path.suffix.lower() == ".gz"


def save_nifti(
    path: str | Path,
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    stored: np.ndarray | None = None,
) -> None:
    """Write a volume as NIfTI, float32, in mm, x first: the grid's affine, or `stored` with another
    order of axes, see `mvrecon.data.resample.storable`, becomes the sform and, if the voxel axes
    are at right angles, the qform.

    Compressed if the name ends in .gz (deterministically), and replaced atomically.

    Raises:
        ImportError: nibabel is not installed.
        ValueError: a grid so far from the origin that the header's single precision would move its
            voxels, or with more of them along an axis than the header counts; see
            `mvrecon.data.resample.storable`.
    """
    nibabel = checks.io_library("nibabel", path)
    values, affine = storable(path, volume, grid, stored)
    rounded = grid.affine.float().double()
    corners = grid.to_index(grid.corners())
    off = corners @ (rounded - grid.affine)[:3, :3].T + (rounded - grid.affine)[:3, 3]
    if (
        moved := (torch.linalg.inv(grid.affine[:3, :3]) @ off.T).abs().max().item()
    ) > MAX_ROUNDING_SHARE:
        raise ValueError(
            f"{path}: expected a grid whose affine NIfTI can hold in single precision, got one "
            f"whose voxels would move by up to {moved:.2g} of a voxel, centred about "
            f"{grid.centre.tolist()} mm; .mha and .nrrd keep it"
        )
    if max(grid.size) > MAX_AXIS_VOXELS:
        raise ValueError(
            f"{path}: expected at most {MAX_AXIS_VOXELS} voxels along an axis in NIfTI, got "
            f"{grid.size}; .mha and .nrrd keep them"
        )
    image = nibabel.Nifti1Image(values.T, affine)
    image.header.set_xyzt_units("mm")
    image.set_sform(affine, SCANNER_CODE)
    image.set_qform(affine, SCANNER_CODE if right_angled(grid) else 0)
    with written_whole(path) as part, part.open("wb") as file:
        if not _packed(Path(path)):
            image.to_stream(file)
            return
        with gzip.GzipFile("", "wb", 1, file, mtime=0) as packed:
            image.to_stream(packed)


def _header(path: Path) -> Any:
    """Read the header only: nibabel's own way would invoke parsers of extensions and
    other formats.
    """
    with _opened(path) as file:
        raw = file.read(max(HEADER_SIZES))
    sizes = [int.from_bytes(raw[:4], order) for order in ("little", "big")]
    size = next((size for size in sizes if size in HEADER_SIZES), None)
    if size is None:
        raise checks.Refused(
            f"{path}: cannot be read: it does not begin as a NIfTI file does; expected {EXPECTED}"
        )
    header = getattr(checks.io_library("nibabel", path), f"{HEADER_SIZES[size]}Header")(
        raw[:size], check=False
    )
    check_keys(path, KEYS, {"magic": header["magic"].item().decode("latin-1")}.get)
    _check_fields(path, header)
    header.check_fix(
        logger=SILENT_LOGGER, error_level=35
    )  # from a negative voxel size on; nibabel's other repairs are harmless
    return header


def _texts(path: Path, header: Any) -> Iterator[str]:
    """Texts of a header that may state a factor or a unit, and extensions of unknown codes."""
    texts = [(name, header[name].item()) for name in TEXTS]
    codes = checks.io_library("nibabel", path).nifti1.extension_codes.code
    with _opened(path) as file:
        raw = file.read(min(int(header["vox_offset"]), checks.MAX_TEXT_BYTES))
    place = int(header["sizeof_hdr"]) + 4
    extended = raw[place - 4]
    while extended and place + 8 < len(raw):
        size, code = struct.unpack_from(f"{header.endianness}2i", raw, place)
        if code == COMMENT_CODE:
            texts.append(("comment", raw[place + 8 : place + size][:COMMENT]))
        elif code not in codes:
            yield f"extension of code {code}"
        if size < 8:
            break
        place += size
    for name, value in texts:
        text = value.decode("latin-1").strip("\0 ")
        parts = [BETWEEN.split(part, maxsplit=1) for part in re.split("[;,\n]", text)]
        stated = any(has_effect(p[0][-SEARCHED:], p[1]) for p in parts if len(p) == 2)
        if stated or INVERSE_CM.search(text):
            yield f"{name} {checks.shown(text)}"


def _check_fields(path: Path, header: Any) -> None:
    """Raise for fields that nibabel would repair in silence.

    Raises:
        Refused: the message names the field.
    """
    with checks.file_errors(path, f"has the unknown datatype {int(header['datatype'])}"):
        bits = 8 * header.get_data_dtype().itemsize
    codes = {name: int(header[name]) for name in ("sform_code", "qform_code")}
    slope, intercept, place = (float(header[n]) for n in ("scl_slope", "scl_inter", "vox_offset"))
    scaled = slope != 0 and not math.isnan(slope)
    pixdim, units = header["pixdim"].astype(float), int(header["xyzt_units"])
    quaternion = np.array([float(header[f"quatern_{name}"]) for name in "bcd"])
    rows = np.array([header[f"srow_{name}"] for name in "xyz"], float)
    offsets = np.array([header[f"qoffset_{name}"] for name in "xyz"], float)
    stated = codes["qform_code"] > 0
    first = int(header["sizeof_hdr"]) + 4
    for name, value, expected, holds in (
        *(
            (name, code, f"from 0 to {MAX_FORM_CODE}", 0 <= code <= MAX_FORM_CODE)
            for name, code in codes.items()
        ),
        ("scl_slope", slope, "finite, 0 or nan", not math.isinf(slope)),
        ("scl_inter", intercept, "finite", not scaled or math.isfinite(intercept)),
        (
            "scl_inter",
            intercept,
            "0 or nan beside a scl_slope of nan",
            not math.isnan(slope) or math.isnan(intercept) or intercept == 0,
        ),
        (
            "xyzt_units",
            units,
            "of m, mm or um",
            units in range(UNIT_BITS + 1) and units & LENGTH_BITS < 4,
        ),
        ("vox_offset", place, f"of whole bytes from {first}", place >= first and place % 1 == 0),
        ("bitpix", int(header["bitpix"]), f"{bits} of its datatype", bits in (0, header["bitpix"])),
        ("pixdim[0]", float(pixdim[0]), "1, -1 or 0", not stated or pixdim[0] in (-1, 0, 1)),
        (
            "pixdim",
            pixdim[1:4].tolist(),
            "positive",
            (codes["sform_code"] > 0 and not stated)
            or (np.isfinite(pixdim[1:4]).all() and pixdim[1:4].min() > 0),
        ),
        (
            "quatern_b, quatern_c and quatern_d",
            quaternion.tolist(),
            "of length up to 1",
            not stated or np.linalg.norm(quaternion) <= 1 + 1e-5,
        ),
        ("qoffset", offsets.tolist(), "finite", not stated or np.isfinite(offsets).all()),
        (
            "srow_x, srow_y and srow_z",
            rows.tolist(),
            "finite",
            codes["sform_code"] <= 0 or np.isfinite(rows).all(),
        ),
    ):
        if not holds:
            raise checks.Refused(f"{path}: expected {name} {expected}, got {checks.shown(value)}")
