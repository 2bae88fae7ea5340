"""A CT series whose pixels are no Hounsfield units of one body at rest is refused; clinical files
with their private attributes are read without a warning.
"""

import warnings

import numpy as np
import pydicom
import pytest
from pydicom.data import get_testdata_file

from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import read_volume
from tests.data.projections.test_dicom_pixels import item
from tests.data.test_dicom_series import hu, written


def read(folder, change):
    """A series as it is read, and the texts of warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        values, _ = read_volume(written(folder, change=change))
    return values.numpy(), [str(one.message) for one in caught]


@pytest.mark.parametrize(
    "words",
    [
        *("LOCALIZER", "CSA MIP THICK", "MINIMUM", "SUBTRACTION", "STD_DEVIATION", "MAT_SPECIFIC"),
        *("MAT_FRACTIONAL", "MAT_VALUE_BASED", "EFF_ATOMIC_NUM", "ELECTRON_DENSITY"),
    ],
)
@pytest.mark.parametrize("place", ["ImageType", "FrameType"])
def test_slices_of_something_else_are_refused(place, words, tmp_path):
    """Also without a RescaleType, or with one that says nothing; in the image and in a sequence."""

    def change(k, _):
        stated = {place: ["DERIVED", "PRIMARY", "AXIAL", words], "RescaleType": "US"}
        return {"CTImageFrameTypeSequence": [item(**stated)]} if place == "FrameType" else stated

    with pytest.raises(Refused, match=f"{place} with {words.replace('CSA ', '').split()[0]}"):
        read(tmp_path, change)


ORDINARY = {
    "clinical": {
        "ImageType": ["ORIGINAL", "PRIMARY", "AXIAL", "CT_SOM5 SPI"],
        "RescaleType": "HU",
        "PatientPosition": "HFS",
        "GantryDetectorTilt": 0.0,
        "BurnedInAnnotation": "NO",
        "LossyImageCompression": "00",
        "KVP": 120,
        "WindowCenter": [40, 400],
    },
    "reformatted": {"ImageType": ["DERIVED", "SECONDARY", "MPR"]},
    "monoenergetic": {
        "ImageType": ["DERIVED", "PRIMARY", "AXIAL", "VMI"],
        "RescaleType": "HU",
        "MultienergyCTAcquisition": "YES",
        "MultienergyCTProcessingSequence": [item(MonoenergeticEnergyEquivalent=70.0)],
    },
    "without contrast agent": {"ImageType": ["DERIVED", "PRIMARY", "AXIAL", "MAT_REMOVED"]},
    "one phase": {"NominalPercentageOfCardiacPhase": 70.0},
    "a quality control": {"QualityControlImage": "YES"},
}


@pytest.mark.parametrize("case", ORDINARY)
def test_slices_in_hounsfield_units_are_read_without_a_warning(case, tmp_path):
    values, texts = read(tmp_path, lambda k, tags: {"RescaleSlope": 1, **ORDINARY[case]})
    assert np.array_equal(values, hu()[:, ::-1, ::-1]) and texts == []


@pytest.mark.parametrize(
    ("name", "first", "last"),
    [
        ("PatientPosition", "HFS", "FFP"),
        ("NominalPercentageOfCardiacPhase", 70.0, 40.0),
        ("NominalPercentageOfRespiratoryPhase", 0.0, 50.0),
        ("NominalCardiacTriggerDelayTime", 0.0, 300.0),
    ],
)
def test_slices_of_several_states_are_refused(name, first, last, tmp_path):
    with pytest.raises(Refused, match=name):
        read(tmp_path, lambda k, tags: {name: first if k < 3 else last})


@pytest.mark.parametrize("name", ["BurnedInAnnotation", "SegmentationType"])
def test_pixels_that_are_not_measured_are_refused(name, tmp_path):
    with pytest.raises(Refused, match=name):
        read(tmp_path, lambda k, tags: {name: "YES"})


def test_slices_at_several_energies_are_warned_of_once(tmp_path):
    def change(k, _):
        energy = item(MonoenergeticEnergyEquivalent=70.0 if k < 3 else 40.0)
        return {"MultienergyCTProcessingSequence": [energy]}

    _, (text,) = read(tmp_path, change)
    assert "MonoenergeticEnergyEquivalent" in text


def test_private_attributes_of_slices_change_nothing(tmp_path):
    """pydicom's slice of a GE scanner, at three places, with a private scale of PET beside."""
    dataset = pydicom.dcmread(get_testdata_file("CT_small.dcm"))
    dataset.private_block(0x7053, "Philips PET Private Group", create=True).add_new(0, "DS", "3.5")
    for k in range(3):
        dataset.ImagePositionPatient[2] = -75.0 + 5 * k
        dataset.save_as(tmp_path / f"{k}.dcm")
    expected = dataset.pixel_array * float(dataset.RescaleSlope) + float(dataset.RescaleIntercept)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = read_volume(tmp_path)[0].numpy()
    low = dataset.pixel_array == dataset.get("PixelPaddingValue", 0)
    assert np.array_equal(values[0, ::-1, ::-1][~low], expected[~low])
