"""Volumes in files of their own, by the file's ending."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from mvrecon.data.nifti import read_nifti, save_nifti
from mvrecon.files.checks import Refused
from mvrecon.geometry.grid import Grid

ENDINGS = (".nii", ".nii.gz")


def read_volume(path: str | Path) -> tuple[Float[Tensor, "d h w"], Grid]:
    """The values of a volume as they are stored (CT: HU), float32, and where its voxels lie in mm.

    Raises:
        ImportError: nibabel is not installed.
        FileNotFoundError: nothing is there.
        ValueError: another ending than .nii and .nii.gz, or a file that cannot be read; see
            `data.nifti.read_nifti`.
    """
    return read_nifti(_checked(path))


def save_volume(path: str | Path, volume: Float[Tensor, "d h w"], grid: Grid) -> None:
    """Write a volume, float32, with the place of its voxels; a file of that name is replaced whole
    or not at all.

    Raises:
        ImportError: nibabel is not installed.
        ValueError: another ending than .nii and .nii.gz, or a volume that is not the grid's.
    """
    if tuple(volume.shape) != grid.shape:
        raise ValueError(
            f"Expected one volume [d h w] of the grid's {grid.shape} voxels, got "
            f"{tuple(volume.shape)}; volumes[0, 0] is the first of a batch"
        )
    save_nifti(_checked(path), volume, grid)


def _checked(path: str | Path) -> Path:
    path = Path(path).expanduser()
    if not path.name.endswith(ENDINGS):
        raise Refused(f"{path}: expected a volume whose name ends in {' or '.join(ENDINGS)}")
    return path
