"""Scenes from files: views agree with the truth, and the patient has the correct position."""

import pickle

import nibabel
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.data.attenuation import WATER, attenuation
from mvrecon.data.hdf5 import Stored, write_volumes
from mvrecon.data.resample import reversed_axes
from mvrecon.data.volumes import Hdf5Volumes, Volumes
from mvrecon.geometry.grid import Grid, voxel_centres
from tests.data.conftest import RIG, SPACING, head


@pytest.fixture
def cameras():
    return CAMERAS.from_config(RIG)


def one(tmp_path, hu, spacing=SPACING, **attributes):
    path = tmp_path / "one.h5"
    write_volumes(path, [Stored("pt_1", hu, spacing)], **attributes)
    return str(path)


def centroid(volume, grid):
    return (voxel_centres(grid) * volume[0, ..., None]).sum(dim=(0, 1, 2)) / volume.sum()


def test_truth_is_the_block_mean_of_what_is_projected(volume_file, grid, cameras):
    scene = Hdf5Volumes(path=str(volume_file), fine=3, rays=2)
    sample = scene.sample(2, 0, grid, cameras)
    (fine,) = scene.finer(2, 0, grid, cameras, 3)
    assert sample.name == "pt_2" and fine.shape == (24, 24, 24)
    assert torch.allclose(sample.volume, F.avg_pool3d(fine[None], 3))
    A = PROJECTORS.build("drr", grid=grid.refined(3), cameras=cameras.refined(2), method="siddon")
    assert torch.equal(sample.views, F.avg_pool2d(A(fine[None, None])[0], 2))
    assert sample.views.shape == (1, 3, 10, 12) and sample.views.dtype == torch.float32
    assert sample.volume.shape == sample.inside.shape == (1, 8, 8, 8)


def test_a_ball_of_water_measures_its_chord(tmp_path, cameras):
    xyz = voxel_centres(Grid.centred((60, 60, 60), 1.0))
    hu = torch.where(xyz.norm(dim=-1) < 20, 0.0, -2048.0).numpy()
    scene = Hdf5Volumes(path=one(tmp_path, hu, (1.0, 1.0, 1.0)), crop="none", rays=1)
    views = scene.sample(0, 0, Grid.centred((32, 32, 32), 1.6), cameras).views
    start, end = cameras.rays()
    along = torch.nn.functional.normalize(end - start, dim=-1)
    across = torch.linalg.cross(start.expand_as(along), along).norm(dim=-1)
    chord = 2 * (400 - across**2).clamp(min=0).sqrt()
    assert torch.allclose(views[0].double(), WATER * chord, atol=0.03 * WATER * 40)


@pytest.mark.parametrize("spacing", [6.0, 3.0], ids=["whole", "cut by the grid"])
@pytest.mark.parametrize("index", [0, 8], ids=["as in the file", "rotated"])
@pytest.mark.parametrize("own_voxels", [False, True])
def test_views_of_a_parallel_rig_count_the_same_attenuation(
    volume_file, spacing, index, own_voxels
):
    detector = {"pixels": [60, 80], "pixel_mm": 1.0}
    parallel = CAMERAS.build("parallel", n_views=4, detector=detector, depth_mm=200.0)
    scene = Hdf5Volumes(path=str(volume_file), vary=True, own_voxels=own_voxels)
    sample = scene.sample(index, 0, Grid.centred((8, 8, 8), spacing), parallel)
    seen = sample.views.sum(dim=(-1, -2))
    expected = sample.volume.sum() * spacing**3
    assert torch.allclose(seen, expected, rtol=1e-2 if index else 2e-3)  # rotated: interpolated


def test_views_of_own_voxels_are_integrals_of_the_truth_where_both_grids_are_equal(
    tmp_path, cameras
):
    grid = Grid.centred(size=(30, 30, 20), spacing=SPACING[::-1])
    scene = Hdf5Volumes(path=one(tmp_path, head()), crop="none", own_voxels=True)
    sample = scene.sample(0, 0, grid, cameras)
    A = PROJECTORS.build("drr", grid=grid, cameras=cameras.refined(2), method="siddon")
    assert torch.allclose(sample.views, F.avg_pool2d(A(sample.volume[None])[0], 2), rtol=1e-5)


def test_the_patient_is_centred_in_the_grid_or_left_alone(tmp_path, cameras):
    path = one(tmp_path, head((7.0, -5.0, 4.0), radius=10))
    for place in [(0.0, 0.0, 0.0), (20.0, -10.0, 5.0)]:
        grid = Grid.centred((16, 16, 16), 2.0, centre=place)
        inside = Hdf5Volumes(path=path).sample(0, 0, grid, cameras).inside
        box = voxel_centres(grid)[inside[0]]
        middle = (box.amin(dim=0) + box.amax(dim=0)) / 2
        assert torch.allclose(middle, torch.tensor(place, dtype=torch.float64), atol=1.6)
    free = Hdf5Volumes(path=path, crop="none").sample(
        0, 0, Grid.centred((20, 20, 20), 3.0), cameras
    )
    box = voxel_centres(Grid.centred((20, 20, 20), 3.0))[free.inside[0]]
    middle = (box.amin(dim=0) + box.amax(dim=0)) / 2
    assert torch.allclose(middle, torch.tensor([7.0, -5.0, 4.0], dtype=torch.float64), atol=1.6)


def test_the_object_is_inside(volume_file, grid, cameras):
    sample = Hdf5Volumes(path=str(volume_file)).sample(0, 0, grid, cameras)
    radius = voxel_centres(grid).norm(dim=-1)
    assert sample.inside[0][radius < 11].all() and not sample.inside[0][radius > 22].any()


@pytest.mark.parametrize("letters", ["RAS", "LAS", "RPS", "RAI", "LPI"])
def test_a_file_in_any_orientation_shows_the_same_patient(tmp_path, letters, grid, cameras):
    straight = head()
    hu = np.flip(straight, reversed_axes(letters)) if letters != "RAS" else straight
    by_option = Hdf5Volumes(path=one(tmp_path, hu), orientation=letters).sample(0, 0, grid, cameras)
    by_file = Hdf5Volumes(path=one(tmp_path, hu, orientation=letters)).sample(0, 0, grid, cameras)
    expected = Hdf5Volumes(path=one(tmp_path, straight)).sample(0, 0, grid, cameras)
    for sample in (by_option, by_file):
        assert torch.allclose(sample.volume, expected.volume, atol=1e-6)
        assert torch.allclose(sample.views, expected.views, atol=1e-4)
    heavy = centroid(expected.volume, grid)
    assert (
        heavy[0] > 0.1 and heavy[1] < -0.1 and heavy[2] > 0.05
    )  # the bone lies towards (+x, -y, +z)


def test_an_orientation_is_three_letters():
    for wrong in ("SAR", "RA", "ras"):
        with pytest.raises(ValueError, match=f"such as 'LPI'; got '{wrong}'"):
            Hdf5Volumes(path="any.h5", orientation=wrong)


def test_hdf5_and_nifti_of_one_volume_agree(tmp_path, grid, cameras):
    hu = head()
    affine = np.diag([*SPACING[::-1], 1.0])
    affine[:3, 3] = [30.0, 40.0, 50.0]
    nibabel.save(nibabel.Nifti1Image(hu.transpose(2, 1, 0), affine), tmp_path / "head.nii.gz")
    nifti = SCENES.build("volumes", path=str(tmp_path / "head.nii.gz")).sample(0, 0, grid, cameras)
    hdf5 = SCENES.build("hdf5", path=one(tmp_path, hu)).sample(0, 0, grid, cameras)
    assert torch.allclose(nifti.volume, hdf5.volume, atol=1e-6)
    assert nifti.name == "head"


def test_a_nifti_volume_stays_in_world_mm_without_crop(tmp_path, cameras):
    affine = np.diag([-SPACING[2], SPACING[1], SPACING[0], 1.0])
    affine[:3, 3] = [2.0 * 29 / 2 + 30.0, -29.0, -28.5]  # centred on (30, 0, 0)
    nibabel.save(nibabel.Nifti1Image(head().transpose(2, 1, 0), affine), tmp_path / "head.nii")
    grid = Grid.centred((16, 16, 16), 4.0, centre=(30.0, 0.0, 0.0))
    sample = Volumes(path=str(tmp_path / "head.nii"), crop="none").sample(0, 0, grid, cameras)
    heavy = centroid(sample.volume, grid)
    assert (
        heavy[0] < 29.9 and heavy[1] < -0.1 and heavy[2] > 0.05
    )  # the file's first axis runs to the left


def test_a_case_is_a_pure_function_of_its_index(volume_file, grid, cameras):
    scene, other = Hdf5Volumes(path=str(volume_file)), Hdf5Volumes(path=str(volume_file))
    scene.sample(3, 0, grid, cameras)
    a, b = (
        scene.sample(1, 0, grid, cameras),
        pickle.loads(pickle.dumps(other)).sample(1, 5, grid, cameras),
    )
    assert torch.equal(a.volume, b.volume) and torch.equal(a.views, b.views) and a.name == b.name


def test_varied_copies_are_pure_differ_and_keep_their_mass_and_views(volume_file, cameras):
    grid = Grid.centred((16, 16, 16), 6.0)  # holds every shift
    scene = Hdf5Volumes(path=str(volume_file), vary=True)
    plain, first, second, again = (
        scene.sample(i, s, grid, cameras) for i, s in ((2, 1), (9, 1), (16, 1), (9, 1))
    )
    assert torch.equal(first.volume, again.volume) and torch.equal(first.views, again.views)
    assert (plain.name, first.name, second.name) == ("pt_2", "pt_2-1-1", "pt_2-1-2")
    assert not torch.allclose(plain.volume, first.volume) and not torch.allclose(
        first.volume, second.volume
    )
    assert not torch.equal(first.volume, scene.sample(9, 2, grid, cameras).volume)
    for sample in (first, second):
        assert 0.9**3 - 0.02 < sample.volume.sum() / plain.volume.sum() < 1.1**3 + 0.02
        assert centroid(sample.volume, grid).abs().max() < 22
    with pytest.raises(IndexError, match="has 7 case.*got index 9; `vary: true`"):
        Hdf5Volumes(path=str(volume_file)).sample(9, 1, grid, cameras)


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("name", ["circular", "parallel"])
def test_split_pixels_join_again(name, factor):
    detector = {"pixels": [4, 6], "pixel_mm": [2.0, 3.0], "offset_mm": [1.0, -2.0]}
    cone = {"sid": 300.0, "sdd": 450.0} if name == "circular" else {}
    cameras = CAMERAS.build(name, n_views=3, detector=detector, **cone)
    again = cameras.refined(factor).binned(factor)
    assert again.shape == cameras.shape
    for key in ("source", "origin", "u", "v"):
        assert torch.allclose(getattr(again, key), getattr(cameras, key), atol=1e-12)


def test_nan_in_a_file_is_an_error(tmp_path, grid, cameras):
    hu = head().astype(np.float32)
    hu[3, 4, 5] = np.nan
    with pytest.raises(ValueError, match=r"one\.h5: pt_1 has 1 values that are not finite HU"):
        Hdf5Volumes(path=one(tmp_path, hu)).sample(0, 0, grid, cameras)


def test_an_empty_scan_is_an_error(tmp_path, grid, cameras):
    empty = np.full((20, 30, 30), -1000, np.int16)
    with pytest.raises(ValueError, match=r"pt_1 shows no patient: expected values above -400 HU"):
        Hdf5Volumes(path=one(tmp_path, empty)).sample(0, 0, grid, cameras)
    assert (
        not Hdf5Volumes(path=one(tmp_path, empty), crop="none")
        .sample(0, 0, grid, cameras)
        .views.any()
    )


def test_wrong_options_are_refused():
    with pytest.raises(ValueError, match="crop must be 'body' or 'none', got 'head'"):
        Volumes(path="a.nii", crop="head")
    with pytest.raises(ValueError, match="fine >= 2.*got fine 1"):
        Volumes(path="a.nii", fine=1)
    with pytest.raises(TypeError, match="no option 'crpo'; did you mean 'crop'"):
        SCENES.build("volumes", path="a.nii", crpo="body")


def test_views_come_from_a_grid_four_times_finer_where_it_is_not_too_large():
    scene = Volumes(path="a.nii")
    factors = {
        (1, 1, 1): 4,
        (128, 128, 128): 4,
        (128, 128, 129): 3,
        (171, 171, 170): 3,
        (171, 171, 171): 2,
    }
    assert {
        shape: scene.factor(Grid.centred(shape=shape, spacing=1.0)) for shape in factors
    } == factors
    assert Volumes(path="a.nii", fine=8).factor(Grid.centred((171, 171, 171), 1.0)) == 8


def test_the_truth_does_not_depend_on_how_fine_the_views_are(volume_file, grid, cameras):
    truths = [
        Hdf5Volumes(path=str(volume_file), fine=k).sample(1, 0, grid, cameras).volume
        for k in (2, 3, 8)
    ]
    for truth in truths[1:]:
        assert torch.allclose(truth, truths[0], atol=1e-7)


def test_the_truth_on_the_files_own_voxels_is_the_file(tmp_path, cameras):
    hu = head()
    grid = Grid.centred(size=hu.shape[::-1], spacing=SPACING[::-1])
    sample = Hdf5Volumes(path=one(tmp_path, hu), crop="none").sample(0, 0, grid, cameras)
    assert torch.allclose(sample.volume[0], attenuation(torch.from_numpy(hu).float()), atol=1e-8)


def test_exact_moves_are_those_of_every_series_and_keep_the_patient_s_mass(volume_file, cameras):
    """Mirrored and shifted by any length, voxels' means stay exact."""
    roomy = Grid.centred((16, 16, 16), 6.0)
    scene = Hdf5Volumes(path=str(volume_file), vary="exact", fine=2)
    still = scene.sample(2, 0, roomy, cameras)
    moves = [scene.sample(7 * turn + 2, 0, roomy, cameras) for turn in (1, 2, 3)]
    for turn, move in enumerate(moves, start=1):
        again = scene.sample(7 * turn + 2, 9, roomy, cameras)
        assert torch.equal(again.views, move.views) and again.name == move.name
        assert move.volume.sum().item() == pytest.approx(still.volume.sum().item(), rel=1e-5)
        assert not torch.equal(move.volume, still.volume)
    assert len({move.name for move in moves}) == 3
