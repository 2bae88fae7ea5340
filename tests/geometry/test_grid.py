import re

import pytest
import torch

from mvrecon.geometry.grid import Grid, pixel_centres, voxel_centres
from mvrecon.geometry.lattice import normalised, sample
from mvrecon.geometry.rigid import random_rotation


def test_voxel_centres_surround_the_grid_centre():
    grid = Grid.centred(size=(8, 6, 4), spacing=(1.0, 2.0, 3.0), centre=(10.0, 20.0, 30.0))
    xyz = voxel_centres(grid)
    assert xyz.shape == (4, 6, 8, 3)
    assert torch.allclose(
        xyz.mean(dim=(0, 1, 2)), torch.tensor([10.0, 20.0, 30.0], dtype=torch.float64)
    )
    assert torch.allclose(
        xyz[1, 2, 3] - xyz[0, 1, 2], torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    )


def test_index_and_world_are_inverse_on_an_oblique_grid():
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] += 0.2 * torch.rand(
        3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    affine[:3, 3] = torch.tensor([100.0, -50.0, 7.0])
    grid = Grid((3, 4, 5), affine)
    xyz = torch.randn(20, 3, dtype=torch.float64)
    assert torch.allclose(grid.to_world(grid.to_index(xyz)), xyz)


def test_coarser_voxels_are_centred_on_the_voxels_they_combine():
    """Undoes `refined`; of five voxels the third pair stands out; an axis of one stays as it is."""
    grid = Grid.centred(size=(3, 4, 5), spacing=(1.0, 2.0, 3.0), centre=(5.0, -1.0, 2.0))
    same = grid.refined(2).coarsened(2)
    assert same.shape == grid.shape and torch.allclose(same.affine, grid.affine)
    flat = Grid.centred(size=(5, 4, 1), spacing=(1.0, 2.0, 3.0))
    coarse = flat.coarsened(2)
    assert coarse.size == (3, 2, 1) and coarse.spacing == (2.0, 4.0, 3.0)
    pairs = voxel_centres(flat)[:, :, :4].unflatten(1, (2, 2)).unflatten(3, (2, 2))
    assert torch.allclose(voxel_centres(coarse)[:, :, :2], pairs.mean(dim=(2, 4)))


def test_refined_grid_fills_the_same_box():
    grid = Grid.centred(size=(8, 6, 4), spacing=(1.0, 2.0, 3.0))
    assert torch.allclose(grid.refined(3).corners(), grid.corners())
    coarse = (
        voxel_centres(grid.refined(3))
        .unflatten(0, (4, 3))
        .unflatten(2, (6, 3))
        .unflatten(4, (8, 3))
    )
    assert torch.allclose(coarse.mean(dim=(1, 3, 5)), voxel_centres(grid))


@pytest.mark.parametrize("spacing", [-1.0, 0.0, (1.0, -2.0, 1.0), float("nan")])
def test_spacing_must_be_positive(spacing):
    with pytest.raises(ValueError, match="positive.* mm, got"):
        Grid.centred((2, 2, 2), spacing)


@pytest.mark.parametrize("shape", [(0, 2, 2), (8, 0, 8), (2, 2), (2, 2, 2, 2)])
def test_shape_must_be_three_positive_sizes(shape):
    for build in (
        lambda: Grid(shape, torch.eye(4)),
        lambda: Grid.centred(shape=shape, spacing=1.0),
    ):
        with pytest.raises(
            ValueError, match=rf"three positive sizes \(z, y, x\), got {re.escape(str(shape))}"
        ):
            build()


def test_user_input_is_in_the_order_x_y_z():
    grid = Grid.centred(size=(8, 6, 4), spacing=(1.0, 2.0, 3.0), centre=(10.0, 20.0, 30.0))
    assert grid.shape == (4, 6, 8)
    assert grid.size == (8, 6, 4)
    assert grid.spacing == (1.0, 2.0, 3.0)
    extent = grid.corners().amax(dim=0) - grid.corners().amin(dim=0)
    assert extent.tolist() == [8.0, 12.0, 12.0]


def test_a_cube_is_the_same_in_either_order():
    expected = Grid.centred(size=(4, 4, 4), spacing=(1.0, 2.0, 3.0))
    for options in ({"shape": (4, 4, 4)}, {"size": [4, 4, 4]}):
        assert torch.equal(Grid.centred(spacing=(1.0, 2.0, 3.0), **options).affine, expected.affine)
    for n in (4, (4, 4, 4)):
        assert torch.equal(Grid.centred(n, (1.0, 2.0, 3.0)).affine, expected.affine)


def test_a_shape_of_a_tensor_takes_one_spacing_for_all_axes():
    grid = Grid.centred(shape=torch.zeros(4, 6, 8).shape, spacing=2.0)
    assert torch.equal(grid.affine, Grid.centred(size=(8, 6, 4), spacing=2.0).affine)


@pytest.mark.parametrize(
    "call",
    [
        lambda: Grid.centred((4, 6, 8), 2.0),
        lambda: Grid.centred(shape=(4, 6, 8), spacing=(1.0, 2.0, 3.0)),
        lambda: Grid.centred(**{"shape": [4, 6, 8], "spacing": [1.0, 1.0, 3.0]}),
    ],
    ids=["positions", "keywords", "settings"],
)
def test_sizes_of_ambiguous_order_are_refused(call):
    """A tensor shape combined with the spacing of old settings raises an error with the correct
    size.
    """
    with pytest.raises(ValueError, match=r"size=\(x, y, z\).* expected size=\(8, 6, 4\)"):
        call()


def test_a_grid_needs_one_size_and_its_spacing():
    for options in ({}, {"size": (4, 4, 4), "shape": (4, 4, 4)}):
        with pytest.raises(TypeError, match="needs one of n, size .* and shape"):
            Grid.centred(spacing=1.0, **options)
    with pytest.raises(ValueError, match="spacing must be positive"):
        Grid.centred(4)


@pytest.mark.parametrize("convert", [lambda x: x, torch.Tensor.numpy])
def test_a_grid_keeps_its_own_affine(convert):
    affine = torch.eye(4, dtype=torch.float64)
    grid = Grid((2, 2, 2), convert(affine))
    affine[:3] *= 5
    assert grid.spacing == (1.0, 1.0, 1.0)


def test_left_handed_and_flat_grids_are_refused():
    for diagonal in ([-1.0, 1, 1, 1], [0.0, 1, 1, 1]):
        with pytest.raises(ValueError, match="right-handed"):
            Grid((2, 2, 2), torch.diag(torch.tensor(diagonal)))


def test_pixel_zero_is_centred_at_zero():
    assert pixel_centres((2, 3))[1, 2].tolist() == [2.0, 1.0]


def test_sampling_at_voxel_centres_is_exact_and_axes_are_xyz():
    volume = torch.randn(1, 1, 3, 4, 5)
    index = torch.tensor([[[[[4.0, 1.0, 2.0]]]]])  # x = 4, y = 1, z = 2
    assert sample(volume, normalised(index, (3, 4, 5))).item() == pytest.approx(
        volume[0, 0, 2, 1, 4].item(), rel=1e-5
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_nan_points_sample_to_zero(bad):
    points = normalised(torch.full((1, 1, 1, 1, 3), bad), (3, 4, 5))
    assert (points.abs() > 1).any(dim=-1).all()
    assert sample(torch.ones(1, 1, 3, 4, 5), points).item() == 0


def test_half_precision_volumes_are_sampled_with_float32_coordinates():
    volume = torch.randn(1, 1, 64, 2, 2)
    points = normalised(torch.tensor([[[[[0.25, 0.5, 40.37]]]]]), (64, 2, 2))
    exact = sample(volume.bfloat16().float(), points)
    assert sample(volume.bfloat16(), points).item() == exact.bfloat16().item()


@pytest.mark.parametrize(
    "make", [lambda n: Grid.centred((n, n, n), 1.0), Grid.centred((100,) * 3, 1.0).refined]
)
def test_a_grid_larger_than_memory_is_refused_with_both_sizes(make):
    """A grid of 100000^3 voxels is refused before any allocation, with the required and available
    GiB.
    """
    with pytest.raises(ValueError, match=r"needs [\d,.]+ GiB of memory; [\d,.]+ GiB are at hand"):
        make(100_000)


def test_available_memory_respects_a_limit(run_python):
    code = (
        "import resource, mvrecon.core.machine as m;"
        "resource.setrlimit(resource.RLIMIT_AS, (2**32, 2**32));"
        "assert 0 < m.memory_at_hand() < 2**32; m.check_memory(2**30, 'a');"
        "m.check_memory(3 * 2**31, 'This')"
    )
    done = run_python("-c", code)
    assert done.returncode == 1 and "ValueError: This needs 6.0 GiB of memory; " in done.stderr


def test_a_moved_grid_moves_its_voxels():
    grid = Grid.centred(size=(5, 4, 3), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
    rng = torch.Generator().manual_seed(0)
    R, t = random_rotation(rng), 100 * torch.randn(3, generator=rng, dtype=torch.float64)
    index = 10 * torch.rand(20, 3, generator=rng, dtype=torch.float64)
    there = grid.moved(R, t)
    assert torch.allclose(there.to_world(index), grid.to_world(index) @ R.T + t, atol=1e-12)
    assert there.spacing == pytest.approx(grid.spacing) and there.shape == grid.shape
    assert torch.allclose(there.moved(R.T, -R.T @ t).affine, grid.affine, atol=1e-12)


def test_a_grid_is_moved_only_by_rigid_motions():
    """A grid's motion by a matrix that is no rotation, or by a shift that is not finite, is
    refused.
    """
    grid = Grid.centred(4, spacing=1.0)
    with pytest.raises(ValueError, match="R must be rotations"):
        grid.moved(2 * torch.eye(3), torch.zeros(3))
    with pytest.raises(ValueError, match="finite mm, got .*nan"):
        grid.moved(torch.eye(3), torch.tensor([0.0, torch.nan, 0.0]))


@pytest.mark.parametrize(
    ("rotation", "translation"), [((2, 3, 3), (3,)), ((3, 4), (3,)), ((3, 3), (2, 3)), ((3, 3), ())]
)
def test_a_grid_moves_by_one_pose(rotation: tuple[int, ...], translation: tuple[int, ...]):
    """A batch of poses, a pose of 3 x 4, and a number are refused with their shapes."""
    with pytest.raises(ValueError, match=r"R \[3 3\] with t \[3\], got \["):
        Grid.centred(4, spacing=1.0).moved(torch.zeros(rotation), torch.zeros(translation))


def test_a_resized_grid_has_the_same_centre_and_voxels():
    """Also by an odd number of voxels, to fewer ones, and of rotated anisotropic voxels."""
    grid = Grid.centred(size=(6, 5, 1), spacing=(2.0, 3.0, 4.0))
    turn = torch.linalg.matrix_exp(
        torch.tensor([[0, -0.3, 0], [0.3, 0, 0.2], [0, -0.2, 0]]).double()
    )
    grid = grid.moved(turn, torch.tensor([7.0, -8.0, 9.0]).double())
    other = grid.resized([9, 4, 1])
    assert other.size == (9, 4, 1) and other.spacing == pytest.approx(grid.spacing)
    assert torch.allclose(other.centre, grid.centre)
    assert torch.equal(other.affine[:3, :3], grid.affine[:3, :3])
