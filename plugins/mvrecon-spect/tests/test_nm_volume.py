"""Volumes as DICOM NM lie where they lay, as SimpleITK and pydicom read them."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from mvrecon.apps.reconstruct import run_reconstruction
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import euler_rotation
from mvrecon_spect.files.nm_volume import read_nm_volume, write_nm
from mvrecon_spect.operators.projector import Spect

pydicom = pytest.importorskip("pydicom")
sitk = pytest.importorskip("SimpleITK")

pytestmark = pytest.mark.usefixtures("blank_pictures")

GRID = Grid.centred(size=(5, 6, 7), spacing=(1.5, 2.0, 3.0), centre=(10.0, -20.0, 30.0))
TURN = euler_rotation(torch.tensor([20.0, 115.0, -30.0], dtype=torch.float64))
TURNED = GRID.moved(TURN, torch.ones(3, dtype=torch.float64))
PRONE = GRID.moved(euler_rotation([180.0, 0.0, 0.0], "xyz"), torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize("grid", [GRID, TURNED, PRONE])
def test_every_voxel_keeps_its_position(tmp_path: Path, grid: Grid):
    """SimpleITK reads the grid's value (RAS) at each world point (LPS)."""
    volume = torch.rand(grid.shape, generator=torch.Generator().manual_seed(0))
    write_nm(tmp_path / "v.dcm", volume, grid)
    image = sitk.ReadImage(str(tmp_path / "v.dcm"))
    step = (volume.max() / 65535).item()
    for point, value in zip(
        voxel_centres(grid).reshape(-1, 3).tolist(), volume.flatten().tolist(), strict=True
    ):
        place = [-point[0], -point[1], point[2]]
        index = image.TransformPhysicalPointToContinuousIndex(place)
        np.testing.assert_allclose(index, np.round(index), atol=1e-5)
        found = image.GetPixel(*(round(i) for i in index))
        assert abs(found - value) < 0.51 * step


def test_slices_are_shown_from_the_feet_with_anterior_up(tmp_path: Path):
    volume = torch.zeros(GRID.shape)
    volume[0, -1, 0] = 5.0  # feet, front, left
    write_nm(tmp_path / "v.dcm", volume, GRID)
    dataset = pydicom.dcmread(tmp_path / "v.dcm")
    assert dataset.file_meta.MediaStorageSOPClassUID.name == "Nuclear Medicine Image Storage"
    assert dataset.ImageType[2:] == ["RECON TOMO", "EMISSION"]
    assert dataset.pixel_array.shape == GRID.shape and dataset.pixel_array[0, 0, -1] == 65535
    assert dataset.PixelSpacing == [2.0, 1.5] and dataset.SpacingBetweenSlices == 3.0
    detector = dataset.DetectorInformationSequence[0]
    assert detector.ImageOrientationPatient == [1, 0, 0, 0, 1, 0]
    np.testing.assert_allclose(detector.ImagePositionPatient, [-13.0, 15.0, 21.0])
    mapped = dataset.RealWorldValueMappingSequence[0]
    assert 65535 * mapped.RealWorldValueSlope == pytest.approx(5.0)
    assert mapped.MeasurementUnitsCodeSequence[0].CodeValue == "{counts}/mm3"


def test_patient_and_study_are_copied_from_another_file(tmp_path: Path):
    write_nm(tmp_path / "a.dcm", torch.ones(GRID.shape), GRID)
    source = pydicom.dcmread(tmp_path / "a.dcm")
    source.PatientName, source.PatientID = "Doe^Jane", "17"
    source.save_as(tmp_path / "a.dcm")
    write_nm(tmp_path / "b.dcm", torch.ones(GRID.shape), GRID, like=tmp_path / "a.dcm")
    made = pydicom.dcmread(tmp_path / "b.dcm")
    for name in ("PatientName", "PatientID", "StudyInstanceUID", "FrameOfReferenceUID"):
        assert made[name].value == source[name].value
    assert made.SeriesInstanceUID != source.SeriesInstanceUID
    assert made.SOPInstanceUID != source.SOPInstanceUID


@pytest.mark.parametrize("values", [(-2.0, 5.0), (0.0, 0.0), (3.0, 3.0), (-4.0, -4.0), (0, 1e-9)])
def test_values_round_trip_within_half_a_step(tmp_path: Path, values: tuple[float, float]):
    volume = torch.linspace(*values, 210).reshape(GRID.shape)
    write_nm(tmp_path / "v.dcm", volume, GRID)
    found = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "v.dcm")))
    step = (max(values) - min(0.0, *values)) / 65535
    error = np.abs(found - volume.flip(-1, -2).numpy()).max()
    assert error <= 0.51 * step + 1e-6 * max(map(abs, values))


def test_a_volume_that_dicom_cannot_represent_is_refused(tmp_path: Path):
    """A volume of another shape or with NaN, and a sheared grid, are refused, and nothing is
    written.
    """
    sheared = GRID.affine.clone()
    sheared[0, 1] = 1.0
    for volume, grid, message in (
        (torch.ones(3, 4, 5), GRID, "grid's"),
        (torch.full(GRID.shape, torch.nan), GRID, "210 values that are not finite"),
        (torch.ones(GRID.shape), Grid(GRID.shape, sheared), "right angles"),
    ):
        with pytest.raises(ValueError, match=message):
            write_nm(tmp_path / "v.dcm", volume, grid)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def settings(scan_of):
    """Of expected counts of a block in one corner of a grid beside the world's origin."""
    rig, grid = dcspect80(pixels=16, columns=[2, 7, 12, 17]), Grid.centred(10, 12.0, (6, -9, 3))
    x = torch.zeros(1, 1, *grid.shape)
    x[..., 1:4, 2:5, 5:9] = 100.0
    counts = Spect(grid, rig)(x)
    options = "views.kind=integrals", "method.iterations=4"
    return lambda *more: ReconstructSettings(**scan_of(counts, rig, grid, *more, *options))


def test_a_reconstruction_is_written_to_dicom_in_its_position(
    tmp_path: Path, parts: None, settings
):
    """SimpleITK reads `out=volume.dcm` as it reads `out=volume.mha`, voxel by voxel."""
    images = []
    for name in ("activity.dcm", "activity.mha"):
        out = tmp_path / name
        run = settings(f"out={out}", "projector=spect", "method=osem")
        assert run_reconstruction(run, tmp_path / name[-3:])["volume"] == str(out)
        images.append(sitk.ReadImage(str(out)))
    dicom, plain = images
    placed = sitk.Resample(plain, dicom)  # by world coordinates
    values = sitk.GetArrayFromImage(placed)
    assert 80 < values.max() < 130
    step = values.max() / 65535
    np.testing.assert_allclose(sitk.GetArrayFromImage(dicom), values, rtol=1e-5, atol=step)


def test_unsupported_dicom_output_is_refused_before_computation(
    tmp_path: Path, parts: None, settings
):
    options = f"out={tmp_path}/volume.dcm", "projector=drr", "method=sirt"
    with pytest.raises(Refused, match="activity for DICOM NM, got a volume in the unit 1/mm"):
        run_reconstruction(settings(*options), tmp_path / "run")
    assert not (tmp_path / "run").exists() and not (tmp_path / "volume.dcm").exists()
    affine = GRID.affine.clone()
    affine[0, 1] = 1.0
    with pytest.raises(Refused, match="right angles"):
        save_volume(
            tmp_path / "v.dcm", torch.ones(GRID.shape), Grid(GRID.shape, affine), "activity"
        )


def detectors(*positions: tuple[float, float, float]) -> list:
    items = []
    for position in positions:
        one = pydicom.Dataset()
        one.ImagePositionPatient = list(position)
        one.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
        items.append(one)
    return items


PLACE = (-13.0, 15.0, 21.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"DetectorInformationSequence": detectors(PLACE, (0, 0, 0))}, "ImagePositionPatient"),
        ({"ImagePositionPatient": [0, 0, 0]}, "ImagePositionPatient"),
        ({"ImageOrientationPatient": [0, 1, 0, 1, 0, 0]}, "ImageOrientationPatient"),
        ({"DetectorInformationSequence": []}, "ImagePositionPatient"),
        ({"PixelAspectRatio": [1, 1]}, "PixelAspectRatio"),
        ({"SpacingBetweenSlices": None}, "SpacingBetweenSlices"),
        (
            {"SliceVector": [1, 2, 3] * 2 + [1], "TimeSlotVector": [1, 1, 1, 2, 2, 2, 3]},
            "TimeSlotVector",
        ),
        ({"Units": "BQML"}, "MeasurementUnitsCodeSequence and Units"),
        ({"HighBit": 11}, "HighBit 15"),
        ({"RescaleSlope": 3.0}, "RealWorldValueMappingSequence"),
    ],
)
def test_an_nm_volume_that_contradicts_itself_is_refused(
    tmp_path: Path, changes: dict, message: str
):
    """An NM volume of two positions, directions, pixel sizes, units or slopes is refused by the
    attribute's name; the same value in two places is read.
    """
    volume = torch.rand(GRID.shape, generator=torch.Generator().manual_seed(0))
    write_nm(tmp_path / "v.dcm", volume, GRID)
    same = {"DetectorInformationSequence": detectors(PLACE, PLACE), "ImagePositionPatient": PLACE}
    for values, fails in ((same, False), (changes, True)):
        dataset = pydicom.dcmread(tmp_path / "v.dcm")
        for name, value in values.items():
            setattr(dataset, name, list(value) if isinstance(value, tuple) else value)
        dataset.save_as(tmp_path / "w.dcm")
        if not fails:
            assert torch.allclose(read_nm_volume(tmp_path / "w.dcm").volume, volume, atol=1e-4)
            continue
        with pytest.raises(ValueError, match=message):
            read_nm_volume(tmp_path / "w.dcm")


@pytest.mark.parametrize(
    ("creator", "group", "element", "value", "name"),
    [
        ("GEMS_GENIE_1", 0x11, 0x3B, 2.0, "Pixel Scale"),
        ("GEMS_GENIE_1", 0x11, 0x3B, 1.0, None),
        ("SIEMENS MED NM", 0x57, 0x07, 0.5, "Rescale Slope"),
    ],
)
def test_private_attributes_that_may_scale_a_volume_are_warned_of(
    tmp_path: Path, creator: str, group: int, element: int, value: float, name: str | None
):
    """By name, as those of views; tried in test_nm.py with others."""
    volume = torch.rand(GRID.shape)
    write_nm(tmp_path / "v.dcm", volume, GRID)
    dataset = pydicom.dcmread(tmp_path / "v.dcm")
    dataset.private_block(group, creator, create=True).add_new(element, "FD", value)
    dataset.save_as(tmp_path / "v.dcm")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert torch.allclose(read_nm_volume(tmp_path / "v.dcm").volume, volume, atol=1e-4)
    assert [name is not None and name in str(one.message) for one in caught] == [True] * bool(name)
