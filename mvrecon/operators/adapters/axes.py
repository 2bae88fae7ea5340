"""Volumes in the axes of MONAI, TorchIO and SimpleITK, with their affines, and back.

Convention: ours is [c d h w] = (z, y, x) with an affine from (x, y, z) to RAS in mm; MONAI and
TorchIO hold [c x y z] with the same affine; SimpleITK's world is LPS, so x and y change signs.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.operators.adapters.missing import needs

#: From our world (RAS) to ITK's (LPS), and back.
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def to_monai(volume: Float[Tensor, "c d h w"], grid: Grid) -> Any:
    """A volume as MONAI's `MetaTensor` [c x y z], the affine in mm (RAS).

    Raises:
        ImportError: MONAI is not installed.
        ValueError: another shape than the grid's.
    """
    with needs("monai"):
        from monai.data import MetaTensor  # pyright: ignore[reportMissingImports]

    return MetaTensor(_turned(volume, grid), affine=grid.affine)


def from_monai(image: Float[Tensor, "c x y z"]) -> tuple[Float[Tensor, "c d h w"], Grid]:
    """The volume and the grid, in mm, of MONAI's `MetaTensor`; a left-handed one is flipped along
    its first axis.

    Raises:
        ValueError: no affine, or no channel and three axes.
    """
    affine = getattr(image, "affine", None)
    if affine is None:
        raise ValueError(f"Expected MONAI's MetaTensor with an affine, got {type(image).__name__}")
    return _ours(image.as_subclass(Tensor), np.asarray(affine, np.float64))


def to_torchio(volume: Float[Tensor, "c d h w"], grid: Grid) -> Any:
    """A volume as TorchIO's `ScalarImage` [c x y z], the affine in mm (RAS).

    Raises:
        ImportError: TorchIO is not installed.
        ValueError: another shape than the grid's.
    """
    with needs("torchio"):
        from torchio import ScalarImage  # pyright: ignore[reportMissingImports]

    return ScalarImage(tensor=_turned(volume, grid), affine=grid.affine.numpy())


def from_torchio(image: Any) -> tuple[Float[Tensor, "c d h w"], Grid]:
    """The volume and the grid, in mm, of TorchIO's image; a left-handed one is flipped along its
    first axis.
    """
    return _ours(image.data, np.asarray(image.affine, np.float64))


def to_simpleitk(volume: Float[Tensor, "d h w"], grid: Grid) -> Any:
    """A volume as SimpleITK's `Image`, its origin, spacing and direction in mm (LPS).

    Raises:
        ImportError: SimpleITK is not installed.
        ValueError: another shape than the grid's, or an affine that shears, which ITK has not.
    """
    with needs("SimpleITK"):
        import SimpleITK

    _check(volume[None], grid)
    affine = LPS @ grid.affine.numpy()
    direction = affine[:3, :3] / np.asarray(grid.spacing)
    if not np.allclose(direction.T @ direction, np.eye(3), atol=1e-6):
        raise ValueError("Expected a grid whose axes are at right angles, got one that shears")
    image = SimpleITK.GetImageFromArray(volume.detach().cpu().numpy())
    image.SetSpacing(list(map(float, grid.spacing)))
    image.SetDirection(direction.flatten().tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    return image


def from_simpleitk(image: Any) -> tuple[Float[Tensor, "d h w"], Grid]:
    """The volume and the grid, in mm, of SimpleITK's image; a left-handed one is flipped along its
    first axis.

    Raises:
        ImportError: SimpleITK is not installed.
        ValueError: an image of another number of axes than three, or several values a voxel.
    """
    with needs("SimpleITK"):
        import SimpleITK

    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1:
        raise ValueError(
            f"Expected an image of three axes and one value a voxel, got {image.GetDimension()} "
            f"axes and {image.GetNumberOfComponentsPerPixel()} values"
        )
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * np.asarray(image.GetSpacing())
    affine[:3, 3] = image.GetOrigin()
    values = torch.from_numpy(SimpleITK.GetArrayFromImage(image)).permute(2, 1, 0)
    volume, grid = _ours(values[None], LPS @ affine)
    return volume[0], grid


def _check(volume: Tensor, grid: Grid) -> None:
    if volume.ndim != 4 or tuple(volume.shape[1:]) != tuple(grid.shape):
        raise ValueError(
            f"Expected a volume [c d h w] of the grid's {tuple(grid.shape)} voxels, got "
            f"{tuple(volume.shape)}; volume[0] is the first of a batch"
        )


def _turned(volume: Tensor, grid: Grid) -> Float[Tensor, "c x y z"]:
    _check(volume, grid)
    return volume.permute(0, 3, 2, 1).contiguous()


def _ours(
    values: Float[Tensor, "c x y z"], affine: np.ndarray
) -> tuple[Float[Tensor, "c d h w"], Grid]:
    """A volume and its right-handed grid."""
    if values.ndim != 4:
        raise ValueError(f"Expected an image [c x y z], got the shape {tuple(values.shape)}")
    if np.linalg.det(affine[:3, :3]) < 0:
        flip = np.diag([-1.0, 1.0, 1.0, 1.0])
        flip[0, 3] = values.shape[1] - 1
        values, affine = values.flip(1), affine @ flip
    volume = values.permute(0, 3, 2, 1).contiguous()
    d, h, w = volume.shape[1:]
    return volume, Grid((d, h, w), torch.from_numpy(affine))
