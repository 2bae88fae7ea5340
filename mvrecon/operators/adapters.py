"""Conversion of volumes and affines to and from MONAI, TorchIO and SimpleITK, and of operators to
deepinv and SciPy.

Convention: volumes are [c d h w] = (z, y, x) with an affine from (x, y, z) to RAS in mm; MONAI and
TorchIO use [c x y z] with the same affine; SimpleITK's world is LPS, so x and y change signs.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import LinearOperator


@contextmanager
def needs(package: str) -> Iterator[None]:
    """Context of an import of another library.

    Raises:
        ImportError: it is not installed, with the command that installs it; or its import fails,
            with the reason.
    """
    try:
        yield
    except Exception as error:
        if find_spec(package) is not None:
            raise ImportError(f"{package} is installed but does not import: {error}") from error
        raise ImportError(f"This needs {package}: pip install {package}") from error


#: From RAS to ITK's LPS, and back.
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def to_xyz(
    volume: Float[Tensor, "c d h w"], grid: Grid
) -> tuple[Float[Tensor, "c x y z"], np.ndarray]:
    """Convert a volume to the axes of nibabel, MONAI and TorchIO, with its affine to RAS in mm:
    `MetaTensor(values, affine=affine)`, `ScalarImage(tensor=values, affine=affine)`.

    Raises:
        ValueError: another shape than the grid's.
    """
    _check(volume, grid)
    return volume.permute(0, 3, 2, 1).contiguous(), grid.affine.numpy()


def from_xyz(
    values: Float[Tensor, "c x y z"], affine: np.ndarray | Tensor
) -> tuple[Float[Tensor, "c d h w"], Grid]:
    """The volume and the right-handed grid, in mm, of an image of nibabel, MONAI or TorchIO; a
    left-handed one is flipped along its first axis.

    Args:
        values: MONAI's `MetaTensor` as it is, TorchIO's `image.data`.
        affine: map from voxel (x, y, z) to RAS in mm, `image.affine`.

    Raises:
        ValueError: no channel and three axes.
    """
    if values.ndim != 4:
        raise ValueError(f"Expected an image [c x y z], got the shape {tuple(values.shape)}")
    values, affine = values.as_subclass(Tensor), np.asarray(affine, np.float64)
    if np.linalg.det(affine[:3, :3]) < 0:
        flip = np.diag([-1.0, 1.0, 1.0, 1.0])
        flip[0, 3] = values.shape[1] - 1
        values, affine = values.flip(1), affine @ flip
    volume = values.permute(0, 3, 2, 1).contiguous()
    d, h, w = volume.shape[1:]
    return volume, Grid((d, h, w), torch.from_numpy(affine))


def to_simpleitk(volume: Float[Tensor, "d h w"], grid: Grid) -> Any:
    """A volume as SimpleITK's `Image`, its origin, spacing and direction in mm (LPS).

    Raises:
        ImportError: SimpleITK is not installed.
        ValueError: another shape than the grid's, or an affine that shears (unknown to ITK).
    """
    with needs("SimpleITK"):
        import SimpleITK

    _check(volume[None], grid)
    affine = RAS_TO_LPS @ grid.affine.numpy()
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
        ValueError: an image of another number of axes than three, or several values per voxel.
    """
    with needs("SimpleITK"):
        import SimpleITK

    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1:
        raise ValueError(
            f"Expected an image of three axes and one value per voxel, got {image.GetDimension()} "
            f"axes and {image.GetNumberOfComponentsPerPixel()} values"
        )
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * np.asarray(image.GetSpacing())
    affine[:3, 3] = image.GetOrigin()
    values = torch.from_numpy(SimpleITK.GetArrayFromImage(image)).permute(2, 1, 0)
    volume, grid = from_xyz(values[None], RAS_TO_LPS @ affine)
    return volume[0], grid


def _check(volume: Tensor, grid: Grid) -> None:
    if volume.ndim != 4 or tuple(volume.shape[1:]) != tuple(grid.shape):
        raise ValueError(
            f"Expected a volume [c d h w] of the grid's {tuple(grid.shape)} voxels, got "
            f"{tuple(volume.shape)}; volume[0] is the first of a batch"
        )


def deepinv_physics(A: LinearOperator) -> Any:
    """An operator as deepinv's `LinearPhysics`, in the unit of A (mm), differentiable as A is.

    Convention: deepinv's x are volumes [b c d h w] and its y are views [b c m v u], as here. Its
    step sizes refer to the norm of A: `physics.compute_norm` returns it, or divide A by it
    (`(1 / norm) * A`).

    Args:
        A: the operator; the physics computes on its device.

    Raises:
        ImportError: deepinv is not installed.
    """
    with needs("deepinv"):
        from deepinv.physics import LinearPhysics

    return LinearPhysics(
        A=lambda x, **_: A(x), A_adjoint=lambda y, **_: A.T(y), img_size=(1, *A.domain_shape)
    )


def scipy_operator(A: LinearOperator, dtype: Any = np.float64) -> Any:
    """An operator as `scipy.sparse.linalg.LinearOperator`, in the unit of A (mm), so that
    `lsqr`, `lsmr`, `svds` and others work on it.

    Convention: SciPy's vectors are volumes [d h w] and views [m v u] of one sample and one channel,
    flattened with the last axis fastest.

    Args:
        A: the operator, on any device.
        dtype: type of its products, float32 or float64.

    Raises:
        ImportError: SciPy is not installed.
        ValueError: another dtype.
    """
    with needs("scipy"):
        from scipy.sparse import linalg

    if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise ValueError(f"Expected the dtype float32 or float64, got {np.dtype(dtype)}")
    shape = (int(np.prod(A.range_shape)), int(np.prod(A.domain_shape)))

    @torch.no_grad()
    def product(operator: LinearOperator, vectors: np.ndarray) -> np.ndarray:
        """The columns of a matrix are the samples of a batch."""
        columns = np.ascontiguousarray(vectors.reshape(len(vectors), -1).T, dtype=dtype)
        batch = torch.from_numpy(columns).to(A.device)
        result = operator(batch.reshape(-1, 1, *operator.domain_shape))
        return result.reshape(len(batch), -1).T.cpu().numpy()

    return linalg.LinearOperator(
        dtype=np.dtype(dtype),
        shape=shape,
        matvec=lambda x: product(A, x),
        rmatvec=lambda y: product(A.T, y),
        matmat=lambda x: product(A, x),
        rmatmat=lambda y: product(A.T, y),
    )
