"""NIfTI volumes. Needs nibabel, the extra `io`."""

import gzip
import logging
import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.durable import written_whole
from mvrecon.geometry.grid import Grid
from mvrecon.limits import DEFLATE, SPACING, VOLUME, Refused, blaming

EXPECTED = "a NIfTI volume of three axes (.nii or .nii.gz)"
#: Millimetres in the units that a NIfTI header may name.
MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}
#: The bytes of a header, which begins with their number, by NIfTI's version.
HEADERS = {348: "Nifti1", 540: "Nifti2"}
SILENT = logging.Logger("nibabel's remarks", logging.CRITICAL)


def read_nifti(path: str | Path) -> tuple[Float[Tensor, "d h w"], Grid]:
    """Values of a NIfTI volume, slope and intercept applied, and where its voxels lie in world mm.

    Axes are swapped and reversed (values stay at their places) until x, y, z run roughly to the
    patient's right, front and head; an oblique rest stays in the grid's affine. The header's
    extensions are not looked at.

    Raises:
        ImportError: nibabel is not installed.
        FileNotFoundError: nothing is there.
        ValueError: not NIfTI, cut short, not three axes, more than the file can hold, or an affine
            that is no grid.
    """
    nibabel = _nibabel(path)
    from nibabel.arrayproxy import ArrayProxy

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {EXPECTED}")
    with blaming(path, "cannot be read", f"is it cut short? Expected {EXPECTED}"):
        header = _header(path)
        _check(path, header)
        stored = ArrayProxy(str(path), header, mmap=False)
        kind = (
            nibabel.Nifti2Image if isinstance(header, nibabel.Nifti2Header) else nibabel.Nifti1Image
        )
        image = nibabel.as_closest_canonical(kind(stored, header.get_best_affine(), header))
        # reversed axes of values that are single precision already are strides backwards, which
        # torch does not take
        values = torch.from_numpy(image.get_fdata(dtype="float32", caching="unchanged").T.copy())
        affine = torch.from_numpy(image.affine).double().clone()
        affine[:3] *= MILLIMETRES[image.header.get_xyzt_units()[0]]
        grid = Grid(tuple(values.shape), affine)  # type: ignore[arg-type]
        if not SPACING[0] <= min(grid.spacing) <= max(grid.spacing) <= SPACING[1]:
            raise Refused(
                f"{path}: has voxels of {grid.spacing} mm, expected {SPACING[0]} to {SPACING[1]}"
            )
        return values, grid


def save_nifti(path: str | Path, volume: Float[Tensor, "d h w"], grid: Grid) -> None:
    """Write a volume as NIfTI, float32, whose first axis is x: the grid's affine goes with it
    unchanged.

    Compressed where the name ends in .gz (the same bytes for the same volume), and replaced whole
    or not at all.

    Raises:
        ImportError: nibabel is not installed.
    """
    nibabel = _nibabel(path)
    values = volume.detach().cpu().float().permute(2, 1, 0).contiguous().numpy()
    raw = nibabel.Nifti1Image(values, grid.affine.numpy()).to_bytes()
    packed = gzip.compress(raw, 1, mtime=0) if str(path).endswith(".gz") else raw
    with written_whole(path) as part:
        part.write_bytes(packed)


def _nibabel(path: str | Path) -> Any:
    try:
        import nibabel
    except ImportError as error:
        raise ImportError(f"{path}: NIfTI needs nibabel: pip install 'mvrecon[io]'") from error
    return nibabel


def _header(path: Path) -> Any:
    """The header alone: nibabel's own way would hand extensions and other formats to further
    parsers.
    """
    import nibabel

    with gzip.open(path) if path.name.endswith(".gz") else path.open("rb") as file:
        raw = file.read(max(HEADERS))
    sizes = [int.from_bytes(raw[:4], order) for order in ("little", "big")]
    size = next((size for size in sizes if size in HEADERS), None)
    if size is None or not path.name.endswith((".nii", ".nii.gz")):
        raise Refused(
            f"{path}: cannot be read: it does not begin as a NIfTI file does; expected {EXPECTED}"
        )
    header = getattr(nibabel, f"{HEADERS[size]}Header")(raw[:size], check=False)
    header.check_fix(
        logger=SILENT, error_level=35
    )  # from a negative voxel size on; what is mended below is harmless
    return header


def _check(path: Path, header: Any) -> None:
    shape, dtype, offset = (
        header.get_data_shape(),
        header.get_data_dtype(),
        float(header["vox_offset"]),
    )
    if len(shape) != 3 or min(shape) < 1 or dtype.kind not in "iuf":
        raise Refused(f"{path}: has {dtype} of shape {shape}; expected {EXPECTED}")
    held = path.stat().st_size * (DEFLATE if path.name.endswith(".gz") else 1)
    declared = offset + math.prod(map(int, shape)) * dtype.itemsize
    if not 0 <= declared <= held or math.prod(map(int, shape)) * max(8, dtype.itemsize) > VOLUME:
        got = (
            f"{shape} of {dtype} from byte {offset:.0f} on, where there are at most {held} "
            f"bytes, {VOLUME} allowed"
        )
        raise Refused(
            f"{path}: cannot be read (it declares {got}); is it cut short? Expected {EXPECTED}"
        )
    affine = torch.from_numpy(header.get_best_affine()).double()
    if not affine.isfinite().all() or torch.linalg.det(affine) == 0:
        raise Refused(
            f"{path}: has the affine {affine.tolist()}; expected a finite one that can be inverted"
        )
