"""NIfTI volumes. Needs nibabel, the extra `io`."""

import zlib
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid

EXPECTED = "a NIfTI volume of three axes (.nii or .nii.gz)"
#: Millimetres in the units that a NIfTI header may name.
MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}


def read_nifti(path: str | Path) -> tuple[Float[Tensor, "d h w"], Grid]:
    """Values of a NIfTI volume, slope and intercept applied, and where its voxels lie in world mm.

    Axes are swapped and reversed (values stay at their places) until x, y, z run roughly to the patient's right, front
    and head; an oblique rest stays in the grid's affine.

    Raises:
        ImportError: nibabel is not installed.
        FileNotFoundError: nothing is there.
        ValueError: not NIfTI, cut short, not three axes, or an affine that is no grid.
    """
    try:
        import nibabel
        from nibabel.filebasedimages import ImageFileError
    except ImportError as error:
        raise ImportError(f"{path}: NIfTI needs nibabel: pip install 'mvrecon[io]'") from error
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {EXPECTED}")
    try:
        image = nibabel.load(path)
        if not isinstance(image, nibabel.Nifti1Image):
            raise ValueError(f"{path}: is of type {type(image).__name__}; expected {EXPECTED}")
        if len(image.shape) != 3:
            raise ValueError(f"{path}: has shape {image.shape}; expected {EXPECTED}")
        affine = torch.from_numpy(image.affine).double()
        if not affine.isfinite().all() or torch.linalg.det(affine) == 0:
            raise ValueError(f"{path}: has the affine {affine.tolist()}; expected a finite one that can be inverted")
        image = nibabel.as_closest_canonical(image)
        values = torch.from_numpy(image.get_fdata(dtype="float32", caching="unchanged"))
        affine = torch.from_numpy(image.affine).double().clone()
        affine[:3] *= MILLIMETRES[image.header.get_xyzt_units()[0]]
        return values.permute(2, 1, 0).contiguous(), Grid(tuple(values.shape[::-1]), affine)  # type: ignore[arg-type]
    except (OSError, EOFError, zlib.error, ImageFileError) as error:
        raise ValueError(f"{path}: cannot be read ({error}); is it cut short? Expected {EXPECTED}") from error
