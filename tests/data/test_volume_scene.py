"""Scenes of volumes in any format, and of other units than HU, are those of the same numbers."""

import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS
from mvrecon.data import digests
from mvrecon.data.attenuation import attenuation
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.volume_files import save_volume
from mvrecon.data.volumes import Hdf5Volumes, Volumes
from mvrecon.geometry.grid import Grid
from tests.data.conftest import RIG, SPACING, head
from tests.data.test_dicom_series import written


@pytest.fixture
def cameras():
    return CAMERAS.from_config(RIG)


@pytest.fixture
def folder(tmp_path):
    """One head as NIfTI, MHA and NRRD."""
    hu = torch.from_numpy(head().astype("f4"))
    grid = Grid.centred(size=hu.shape[::-1], spacing=SPACING[::-1], centre=(9.0, 2.0, -4.0))
    for name in ("c.nii.gz", "a.mha", "b.nrrd"):
        save_volume(tmp_path / "heads" / name, hu, grid)
    return tmp_path / "heads"


def test_a_folder_of_volumes_has_one_case_per_file(folder, grid, cameras):
    (folder / "notes.txt").write_text("not a volume")
    scene = Volumes(path=str(folder))
    assert scene.length == 3
    expected = Volumes(path=str(folder / "c.nii.gz")).sample(0, 0, grid, cameras)
    for index, name in enumerate("abc"):
        sample = scene.sample(index, 0, grid, cameras)
        assert sample.name == name
        assert torch.allclose(sample.volume, expected.volume, atol=1e-6)
        assert torch.allclose(sample.views, expected.views, atol=1e-4)


def test_files_that_differ_in_their_ending_have_names_of_their_own(folder):
    """`a.nii.gz` beside `a.mha`; a folder of DICOM slices beside a file."""
    (folder / "c.nii.gz").rename(folder / "a.nii.gz")
    written(folder / "b")
    names = [Volumes(path=str(folder)).case(k)[0] for k in range(4)]
    assert names == ["a.mha", "a.nii.gz", "b", "b.nrrd"]


def test_attenuation_declared_as_hu_is_refused(tmp_path, grid, cameras):
    """Attenuation in 1/mm, all of which would be water as HU, is refused, with what to say."""
    mu = attenuation(torch.from_numpy(head().astype("f4")))
    save_volume(tmp_path / "mu.nii.gz", mu, Grid.centred(size=mu.shape[::-1], spacing=3.0))
    path = str(tmp_path / "mu.nii.gz")
    with pytest.raises(ValueError, match=r"mu has values from .* stored_unit=1/mm"):
        Volumes(path=path).sample(0, 0, grid, cameras)
    assert Volumes(path=path, stored_unit="1/mm").sample(0, 0, grid, cameras).volume.max() > 0


def test_a_patient_of_few_voxels_raises_a_warning(tmp_path, grid, cameras):
    """A patient who is a tenth as large, as with a spacing in cm, is warned of."""
    hu = torch.from_numpy(head().astype("f4"))
    small = Grid.centred(size=hu.shape[::-1], spacing=[step / 10 for step in SPACING[::-1]])
    save_volume(tmp_path / "cm.nii.gz", hu, small)
    with pytest.warns(UserWarning, match="voxels of the grid; is the spacing in its file mm"):
        Volumes(path=str(tmp_path / "cm.nii.gz")).sample(0, 0, grid, cameras)


def test_dicom_series_are_cases_by_their_folders(tmp_path):
    for name in ("p2", "p1"):
        written(tmp_path / name)
    assert [Volumes(path=str(tmp_path)).case(k)[0] for k in range(2)] == ["p1", "p2"]
    assert Volumes(path=str(tmp_path / "p2")).length == 1


def test_a_change_in_a_folder_changes_its_digests(folder):
    def made():
        settings = {"name": "volumes", "path": str(folder)}
        return {path: digests.of_file(path) for path in digests.files_in(settings)}

    before = made()
    assert before and made() == before
    (folder / "b.nrrd").write_bytes((folder / "b.nrrd").read_bytes()[:-1])
    changed = made()
    (folder / "b.nrrd").unlink()
    assert len({str(digest) for digest in (before, changed, made())}) == 3


def test_attenuation_in_a_file_is_not_converted(tmp_path, grid, cameras):
    hu = head()
    mu = attenuation(torch.from_numpy(hu).float()).numpy()
    write_volumes(tmp_path / "hu.h5", [Stored("a", hu, SPACING)])
    write_volumes(tmp_path / "mu.h5", [Stored("a", mu, SPACING)], units="1/mm")
    assert VolumeFile(tmp_path / "mu.h5").unit == "1/mm"
    expected = Hdf5Volumes(path=str(tmp_path / "hu.h5"))
    scene = Hdf5Volumes(path=str(tmp_path / "mu.h5"), stored_unit="1/mm")
    assert scene.unit == expected.unit == "1/mm"
    got, want = (s.sample(0, 0, grid, cameras) for s in (scene, expected))
    assert torch.allclose(got.volume, want.volume, atol=1e-7)
    assert torch.allclose(got.views, want.views, atol=1e-5)
    assert torch.equal(got.inside, want.inside)


def test_activity_in_a_file_is_projected_without_conversion(tmp_path, cameras):
    activity = np.zeros((8, 8, 8), "f4")
    activity[2:6, 3:6, 3:5] = 70.0
    path = tmp_path / "a.h5"
    write_volumes(path, [Stored("a", activity, (6.0, 6.0, 6.0))], units="activity")
    scene = Hdf5Volumes(path=str(path), stored_unit="activity", crop="none", data_range=70.0)
    sample = scene.sample(0, 0, Grid.centred((8, 8, 8), 6.0), cameras)
    assert scene.unit == "activity"
    assert torch.allclose(sample.volume[0], torch.from_numpy(activity), atol=1e-4)
    assert torch.equal(sample.inside[0], torch.from_numpy(activity > 0))
    assert sample.views.max() == pytest.approx(70.0 * 6 * 2**0.5 * 2, rel=0.6)


def test_inconsistent_units_are_refused(tmp_path, volume_file, grid, cameras):
    """A volume of other units than the scene's, or of HU as 1/mm, is refused with both named."""
    with pytest.raises(ValueError, match="to be the file's, 'HU', got '1/mm'"):
        Hdf5Volumes(path=str(volume_file), stored_unit="1/mm").case(0)
    with pytest.raises(ValueError, match=r"stored_unit must be one of .*got 'Bq'"):
        Hdf5Volumes(path=str(volume_file), stored_unit="Bq")  # type: ignore[arg-type]
    with pytest.raises(Refused, match="'units': 'Bq'"):
        write_volumes(tmp_path / "a.h5", [Stored("a", head(), SPACING)], units="Bq")
    hu = torch.from_numpy(head().astype("f4"))
    save_volume(tmp_path / "a.nii", hu, Grid.centred(size=hu.shape[::-1], spacing=2.0))
    with pytest.raises(ValueError, match=r"a\.nii: a has values up to 1000, .* are they HU"):
        Volumes(path=str(tmp_path / "a.nii"), stored_unit="1/mm").sample(0, 0, grid, cameras)


def test_a_folder_that_is_not_a_scene_is_refused(tmp_path):
    """A folder without volumes, or with DICOM slices beside others, is refused as a scene."""
    with pytest.raises(FileNotFoundError, match="no such file or folder; expected a volume or"):
        Volumes(path=str(tmp_path / "nowhere")).case(0)
    with pytest.raises(Refused, match=r"expected volumes \(\.nii.*or DICOM series, got none"):
        Volumes(path=str(tmp_path)).case(0)
    written(tmp_path)
    save_volume(tmp_path / "a.nii", torch.zeros(2, 2, 2), Grid.centred(2, spacing=1.0))
    with pytest.raises(Refused, match="expected DICOM slices alone"):
        Volumes(path=str(tmp_path)).case(0)
