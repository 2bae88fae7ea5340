"""Reading and writing volumes, by the type of the path."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, check_link
from mvrecon.core.parts import VOLUME_FILES, VOLUME_READERS
from mvrecon.data import dicom, itk, nifti
from mvrecon.data.dicom_image import dicom_file
from mvrecon.data.resample import Slabs
from mvrecon.geometry.grid import Grid

READ_ENDINGS, WRITTEN_ENDINGS = (
    (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd"),
    (".nii", ".nii.gz", ".mha", ".nrrd"),
)
ENDING = re.compile(r"\.(nii(\.gz)?|mha|mhd|nrrd)$", re.IGNORECASE)


def read_volume(path: str | Path, resample: bool = False) -> tuple[Float[Tensor, "d h w"], Grid]:
    """Read a volume and its grid.

    Args:
        path: NIfTI, MHA, MHD or NRRD by its ending, or that of a plugin, such as .dcm; a folder
            with one DICOM CT series, or a DICOM file with all of its slices.
        resample: align the slices of a tilted gantry, see `data.dicom.open_series`.

    Returns:
        The values as stored, HU for CT, in float32, and the grid in world mm (RAS).

    Raises:
        ImportError, FileNotFoundError, ValueError: as `open_volume`.

    Examples:
        >>> grid = mv.Grid.centred(size=(5, 4, 3), spacing=2.0)
        >>> mv.save_volume("air.nii.gz", torch.full(grid.shape, -1000.0), grid)
        >>> volume, grid = mv.read_volume("air.nii.gz")
        >>> volume.shape, volume.mean().item(), grid.spacing
        (torch.Size([3, 4, 5]), -1000.0, (2.0, 2.0, 2.0))
    """
    slabs, grid = open_volume(path, resample)
    return slabs.whole(), grid


def open_volume(path: str | Path, resample: bool = False) -> tuple[Slabs, Grid]:
    """Open a volume: values as stored, slab by slab, and the grid in world mm (RAS).

    Args:
        path: NIfTI, MHA, MHD or NRRD by its ending, or that of a plugin, such as .dcm; a folder
            with one DICOM CT series, or a DICOM file with all of its slices.
        resample: interpolate the slices of a tilted gantry, see `data.dicom.open_series`.

    Raises:
        ImportError: a library of the extra `io` is not installed.
        FileNotFoundError: nothing is there.
        ValueError: another ending, or a file that cannot be read; see `data.nifti.open_nifti`,
            `data.itk.open_itk` and `data.dicom.open_series`.
    """
    path = Path(path).expanduser()
    if path.is_dir() or dicom.ct_file(path):
        return dicom.open_series(path, resample)
    ending = _ending(path)
    if ending not in READ_ENDINGS:
        if (name := ending.lstrip(".")) in VOLUME_READERS.names():
            return VOLUME_READERS.build(name, path)
        known = [*READ_ENDINGS, *(f".{name}" for name in VOLUME_READERS.names())]
        raise Refused(
            f"{path}: expected a volume whose name ends in {' or '.join(known)}, or the folder of "
            f"a DICOM CT series"
        )
    return nifti.open_nifti(path) if ending.startswith(".nii") else itk.open_itk(path)


def save_volume(
    path: str | Path,
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    unit: str = "unknown",
    like: str | Path | None = None,
) -> None:
    """Write a volume, float32, with the position of its voxels; an existing file is replaced
    atomically.

    Args:
        path: path of the file; its ending is .nii, .nii.gz, .mha, .nrrd or that of a plugin, such
            as .dcm.
        volume: the values.
        grid: grid of the volume.
        unit: unit of the values, such as "activity", which DICOM requires.
        like: a volume file with the voxels of the grid, whose order of axes the written file gets,
            so that other programs read arrays that can be compared; None: the grid's. The files of
            plugins have an order of their own.

    Raises:
        ImportError: a library of the extra `io` is not installed.
        ValueError: another ending, a volume of another shape than the grid's, a grid or unit
            that the file cannot hold, or a file `like` with other voxels.

    Examples:
        >>> grid = mv.Grid.centred(16, spacing=2.0, centre=(0.0, 0.0, 50.0))
        >>> volumes = torch.rand(1, 1, *grid.shape)
        >>> mv.save_volume("volume.nii.gz", volumes[0, 0], grid)
        >>> torch.equal(mv.read_volume("volume.nii.gz")[0], volumes[0, 0])
        True
    """
    path = Path(path).expanduser()
    if tuple(volume.shape) != grid.shape:
        raise ValueError(
            f"Expected one volume [d h w] of the grid's {grid.shape} voxels, got "
            f"{tuple(volume.shape)}; volumes[0, 0] is the first of a batch"
        )
    volume_writer(path, grid, unit, like)(volume)


def volume_writer(
    path: Path, grid: Grid, unit: str, like: str | Path | None = None
) -> Callable[[Float[Tensor, "d h w"]], None]:
    """Return the function that writes a volume of this grid and unit; raises as `save_volume`, for
    a plugin's file before there is a volume.
    """
    if (ending := check_ending(path)) not in WRITTEN_ENDINGS:
        return VOLUME_FILES.build(ending.lstrip("."), path, grid, unit)
    save = nifti.save_nifti if ending.startswith(".nii") else itk.save_itk
    return partial(save, path, grid=grid, stored=None if like is None else _stored(like, grid))


def _stored(path: str | Path, grid: Grid) -> np.ndarray | None:
    """The affine of the file that has the voxels of a grid, in its order of axes."""
    slabs, own = open_volume(path)
    if own.shape != grid.shape or not torch.allclose(own.affine, grid.affine, rtol=1e-6):
        raise ValueError(
            f"{path}: expected the voxels of the written volume, {grid.shape} at "
            f"{grid.affine.tolist()}, got {own.shape} at {own.affine.tolist()}"
        )
    return slabs.stored


def check_ending(path: Path) -> str:
    """Return the ending of a volume file to write.

    Raises:
        Refused: an ending that `save_volume` does not support.
    """
    written = [*WRITTEN_ENDINGS, *(f".{name}" for name in VOLUME_FILES.names())]
    if (ending := _ending(path)) not in written:
        raise Refused(f"{path}: expected a volume whose name ends in {' or '.join(written)}")
    return ending


def volumes_in(path: str | Path) -> list[Path]:
    """Return the volumes at a path, sorted by name: a file, a DICOM series, or a folder of either.

    Raises:
        FileNotFoundError: nothing is there, or a link leads nowhere.
        Refused: a folder without volumes, or with single DICOM files beside other volumes.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; expected a volume or several")
    if not path.is_dir():
        return [path]
    inside = [item for item in sorted(path.iterdir()) if not item.name.startswith(".")]
    named = [item for item in inside if ENDING.search(item.name)]
    for item in named:
        check_link(item)
    volumes = [item for item in named if item.is_file()]
    series = [item for item in inside if item.is_dir() and _has_dicom(item)]
    if _has_dicom(path):
        if volumes or series:
            raise Refused(f"{path}: expected DICOM slices alone, got other volumes beside them")
        return [path]
    if not volumes and not series:
        raise Refused(
            f"{path}: expected volumes ({', '.join(READ_ENDINGS)}) or DICOM series, got none"
        )
    return sorted([*volumes, *series])


def name_of(path: Path) -> str:
    """The name of a volume: its file's without the ending, or its folder's."""
    return ENDING.sub("", path.name)


def _has_dicom(folder: Path) -> bool:
    return any(
        item.is_file() and not ENDING.search(item.name) and dicom_file(item)
        for item in folder.iterdir()
    )


def _ending(path: Path) -> str:
    match = ENDING.search(path.name)
    return (match[0] if match else path.suffix).lower()
