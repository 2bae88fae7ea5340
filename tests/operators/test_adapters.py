"""mvrecon's operators and volumes in other libraries: the same numbers at the same places."""

import sys

import numpy as np
import pytest
import torch

import mvrecon as mv
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.operators.adapters import (
    deepinv_physics,
    from_simpleitk,
    from_xyz,
    needs,
    scipy_operator,
    to_simpleitk,
    to_xyz,
)

DETECTOR = {"pixels": [5, 6], "pixel_mm": 3.0}
A = mv.Drr(mv.Grid.centred(size=(5, 4, 3), spacing=2.0), mv.circular(4, 100.0, 150.0, DETECTOR))
#: Rotated, off the origin, no two sizes and spacings alike.
GRID = mv.Grid.centred(size=(5, 4, 3), spacing=(1.0, 1.5, 2.0), centre=(8.0, -4.0, 2.0)).moved(
    euler_rotation(torch.tensor([20.0, -10.0, 30.0], dtype=torch.float64)),
    torch.zeros(3, dtype=torch.float64),
)
VOLUME = torch.rand(2, *GRID.shape, generator=torch.Generator().manual_seed(0))


def random(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def test_the_scipy_operator_is_the_matrix_and_its_solver_finds_the_volume():
    linalg = pytest.importorskip("scipy.sparse.linalg")
    B = scipy_operator(A)
    assert B.shape == (4 * 5 * 6, 3 * 4 * 5)
    x, y = random(1, 1, *A.domain_shape), random(1, 1, *A.range_shape)
    assert np.array_equal(B @ x.flatten().numpy(), A(x).flatten().numpy())
    assert np.array_equal(B.T @ y.flatten().numpy(), A.T(y).flatten().numpy())
    matrix = B @ np.eye(B.shape[1])
    assert np.allclose(matrix @ x.flatten().numpy(), A(x).flatten().numpy(), rtol=1e-12)
    assert np.allclose(B.T @ np.eye(B.shape[0]), matrix.T, rtol=1e-12, atol=1e-12)
    views = (A(x)).flatten().numpy()
    solution = linalg.lsqr(B, views, atol=1e-13, btol=1e-13, iter_lim=2000)[0]
    assert np.allclose(B @ solution, views, rtol=1e-6)
    with pytest.raises(ValueError, match="float32 or float64, got float16"):
        scipy_operator(A, np.float16)


def test_deepinv_s_physics_is_the_operator_with_its_adjoint_and_its_solver_works():
    pytest.importorskip("deepinv")
    physics = deepinv_physics(A)
    x, y = random(2, 1, *A.domain_shape), random(2, 1, *A.range_shape)
    assert torch.equal(physics(x), A(x)) and torch.equal(physics.A_adjoint(y), A.T(y))
    assert abs(float(physics.adjointness_test(x[:1]))) < 1e-8
    solution = physics.A_dagger(physics.A(x), max_iter=300, tol=1e-12)
    assert torch.allclose(A(solution), A(x), rtol=1e-3, atol=1e-3)


def centres(image_affine, index) -> np.ndarray:
    """World mm of a voxel."""
    return (np.asarray(image_affine) @ [*index, 1.0])[:3]


def test_a_simpleitk_image_keeps_voxel_positions_and_round_trips():
    pytest.importorskip("SimpleITK")
    image = to_simpleitk(VOLUME[0], GRID)
    for x, y, z in ((0, 0, 0), (4, 3, 2), (1, 2, 0)):
        assert image.GetPixel(x, y, z) == pytest.approx(VOLUME[0, z, y, x].item())
        point = image.TransformIndexToPhysicalPoint((x, y, z)) * np.array([-1, -1, 1])  # LPS
        assert np.allclose(point, centres(GRID.affine, (x, y, z)))
    volume, grid = from_simpleitk(image)
    assert torch.equal(volume, VOLUME[0])
    assert torch.allclose(grid.affine, GRID.affine, atol=1e-9)


def test_a_left_handed_simpleitk_image_is_flipped_and_keeps_voxel_positions():
    SimpleITK = pytest.importorskip("SimpleITK")
    image = SimpleITK.GetImageFromArray(VOLUME[0].numpy())
    image.SetDirection([1.0, 0, 0, 0, -1.0, 0, 0, 0, 1.0])
    volume, grid = from_simpleitk(image)
    point = np.array(image.TransformIndexToPhysicalPoint((1, 2, 0))) * [-1, -1, 1]
    index = np.linalg.inv(grid.affine.numpy()) @ [*point, 1.0]
    x, y, z = np.rint(index[:3]).astype(int)
    assert volume[z, y, x].item() == image.GetPixel(1, 2, 0)


@pytest.mark.parametrize("library", ["monai", "torchio"])
def test_monai_and_torchio_images_match_nibabel_and_round_trip(library):
    module = pytest.importorskip(library)
    values, affine = to_xyz(VOLUME, GRID)
    if library == "monai":
        values = image = module.data.MetaTensor(values, affine=affine)
    else:
        image = module.ScalarImage(tensor=values, affine=affine)
        values = image.data
    assert tuple(values.shape) == (2, 5, 4, 3)
    assert torch.equal(torch.as_tensor(values[:, 1, 2, 0]), VOLUME[:, 0, 2, 1])
    assert np.allclose(np.asarray(image.affine), GRID.affine.numpy())
    volume, grid = from_xyz(values, image.affine)
    assert type(volume) is torch.Tensor
    assert torch.equal(volume, VOLUME) and torch.allclose(grid.affine, GRID.affine)


def test_a_left_handed_array_is_flipped_and_keeps_voxel_positions():
    affine = np.diag([-1.0, 2.0, 3.0, 1.0])
    values = VOLUME.permute(0, 3, 2, 1)
    volume, grid = from_xyz(values, affine)
    x, y, z = np.rint(np.linalg.inv(grid.affine.numpy()) @ affine @ [1, 2, 0, 1])[:3].astype(int)
    assert torch.equal(volume[:, z, y, x], values[:, 1, 2, 0])
    with pytest.raises(ValueError, match=r"\[c x y z\], got the shape \(5, 4, 3\)"):
        from_xyz(values[0], affine)


def test_a_missing_library_and_a_wrong_shape_are_named(monkeypatch: pytest.MonkeyPatch):
    names = ("scipy", "scipy.sparse", "deepinv", "deepinv.physics")
    for name in (*names, "SimpleITK"):
        monkeypatch.setitem(sys.modules, name, None)
    for act, package in [
        (lambda: scipy_operator(A), "scipy"),
        (lambda: deepinv_physics(A), "deepinv"),
        (lambda: to_simpleitk(VOLUME[0], GRID), "SimpleITK"),
    ]:
        with pytest.raises(ImportError, match=f"needs {package}: pip install {package}"):
            act()
    monkeypatch.undo()
    with pytest.raises(ImportError, match="os is installed but does not import: another build"):
        with needs("os"):
            raise RuntimeError("another build")
    pytest.importorskip("SimpleITK")
    with pytest.raises(ValueError, match=r"of the grid's \(3, 4, 5\) voxels"):
        to_simpleitk(VOLUME[0].mT, GRID)
