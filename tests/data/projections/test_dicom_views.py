"""What DICOM projections state of rig, order and values, in standard, private and DICOM-CT-PD's
attributes, is compared, refused by name, or named in one warning for all files.
"""

import re
import struct
import warnings

import numpy as np
import pydicom
import pytest
from pydicom.data import get_testdata_file

from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS
from mvrecon.data.projections.opening import open_projections
from tests.data.projections.conftest import CT_PD, VIEWS, dicom_image, grey, opened
from tests.data.projections.test_dicom_pixels import item
from tests.data.projections.test_dicom_places import OWN, nested

COUNT = 4
PRIMARY = "PositionerPrimaryAngle"


def views(folder, change=None, **tags):
    """A set of four files of an XA, `change` of the k-th one's data set."""
    for k in range(COUNT):
        path = folder / f"{k}.dcm"
        dicom_image(path, grey()[k], InstanceNumber=k + 1, Modality="XA", **tags)
        if change:
            dataset = pydicom.dcmread(path)
            change(dataset, k)
            dataset.save_as(path)
    return folder


def warned(path):
    """The warnings of opening projections, whose grey values are as they are stored."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stack = opened(path, flat=60_000.0, find_bad_pixels=False).stack
        count = len(stack.names)
        assert np.array_equal(stack.read(0, count), grey()[:count].astype("f4"))
    return [str(one.message) for one in caught]


def unknown(name, value, block=0x10):
    """Sets an attribute of DICOM-CT-PD as pydicom finds it without its dictionary: bytes."""

    def change(dataset, k):
        stated = value(k) if callable(value) else value
        group, element = divmod(CT_PD[name][0], 0x10000)
        dataset.add_new((group, block), "LO", "DICOM-CT-PD")
        dataset.add_new((group, block << 8 | element & 0xFF), "UN", stated)

    return change


def single(value):
    return struct.pack("<f", value)


def short(value):
    return struct.pack("<H", value)


CT_PD_CASES = {
    "DetectorShape": (b"FLAT", b"CYLINDRICAL "),
    "NumberofDetectorRows": (short(6), short(8)),
    "FlyingFocalSpotMode": (b"FFSNONE ", b"FFSZ"),
    "LogFlag": (b"NO", b"YES "),
    "DetectorFocalCenterAxialPosition": (single(3), lambda k: single(k)),
    "DetectorFocalCenterRadialDistance": (single(595), lambda k: single(595 + k)),
    "DetectorFocalCenterAngularPosition": (lambda k: single(0.1 * k), None),
    "ConstantRadialDistance": (single(1085), lambda k: single(1085 + k % 2)),
    "DetectorCentralElement": (
        struct.pack("<2f", 4.125, 3.5),
        lambda k: struct.pack("<2f", 4 + k, 3.5),
    ),
    "SourceAngularPositionShift": (single(0), lambda k: single(1e-4 * (-1) ** k)),
    "SourceAxialPositionShift": (single(0), lambda k: single(0.1 * (k % 2))),
    "SourceRadialDistanceShift": (single(0), lambda k: single(0.1 * (k % 2))),
    "SpectrumIndex": (short(1), lambda k: short(1 + k % 2)),
    "ScatterCorrectionFlag": (b"YES ", lambda k: b"YES " if k else b"NO"),
    "PhotonStatistics": (lambda k: single(1e5 + k), None),
    "WaterAttenuationCoefficient": (b"0.0192", None),
}


@pytest.mark.parametrize("block", [0x10, 0x21])
@pytest.mark.parametrize("name", CT_PD_CASES)
def test_attributes_of_dicom_ct_pd_of_an_unknown_type(name, block, tmp_path):
    """A value of a flat detector in one place is read without a warning; another is refused, or
    warned of once where it differs between views, by name.
    """
    good, bad = CT_PD_CASES[name]
    assert warned(views(tmp_path, unknown(name, good, block))) == []
    if callable(bad):
        (text,) = warned(views(tmp_path, unknown(name, bad, block)))
        assert name in text
    elif bad is not None:
        with pytest.raises(Refused, match=name):
            open_projections(views(tmp_path, unknown(name, bad, block)))


def test_the_pixel_of_dicom_ct_pd_is_compared(tmp_path):
    """With ImagerPixelSpacing, rows first; without it, it is the pixel size."""
    sizes = {"DetectorElementAxialSpacing": 0.5, "DetectorElementTransverseSpacing": 0.25}
    assert open_projections(views(tmp_path, **sizes)).pixel_mm == (0.5, 0.25)
    assert warned(views(tmp_path, ImagerPixelSpacing=[0.5, 0.25], **sizes)) == []
    with pytest.raises(Refused, match="DetectorElementAxialSpacing, DetectorElementTransverse"):
        open_projections(views(tmp_path, ImagerPixelSpacing=[0.25, 0.5], **sizes))


def test_a_set_has_one_warning_of_places_and_one_of_light(tmp_path):
    """However many attributes and files state them."""

    def change(dataset, k):
        dataset.TableHeight, dataset.PatientPosition = float(k), "HFS" if k else "HFP"
        dataset.KVP, dataset.FilterMaterial = 100 + k, "CU" if k else "AL"

    light, places = warned(views(tmp_path, change))
    assert all(word in light for word in ("KVP", "FilterMaterial"))
    assert all(word in places for word in ("TableHeight", "PatientPosition"))


@pytest.mark.parametrize(
    ("name", "other", "counts"),
    [
        ("TableHeight", 200.0, False),
        ("TableTraverse", 500.0, False),
        ("TableTopVerticalPosition", 0.0, False),
        ("PatientPosition", "HFP", False),
        ("DistanceSourceToPatient", 0.0, False),
        ("TableVerticalIncrement", 9.0, False),
        ("DistanceSourceToDetector", 1200.0, True),
        ("RTImageSID", 1200.0, True),
        ("DetectorPrimaryAngle", 9.0, True),
    ],
)
def test_places_of_the_object_are_not_those_of_a_flat_field(name, other, counts, tmp_path):
    """It is taken without the object; how far its source is from the detector is compared."""
    first = "HFS" if name == "PatientPosition" else 100.0
    views(tmp_path, **{name: first})
    flat = tmp_path / "flat.dcm"
    dicom_image(flat, grey()[0] * 0 + 60_000, Modality="XA", **{name: other})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        opened(tmp_path, flat=str(flat), find_bad_pixels=False)
    texts = [str(one.message) for one in caught if one.category is UserWarning]
    assert [name in text for text in texts] == [True] * counts


@pytest.mark.parametrize(
    ("names", "way"),
    [
        ("ExposureTime XRayTubeCurrent", "ExposureTime*XRayTubeCurrent"),
        ("ExposureTime XRayTubeCurrent Exposure", "Exposure"),
        ("KVP ExposureTime", "ExposureTime"),
        ("AveragePulseWidth", "AveragePulseWidth"),
    ],
)
def test_the_advice_of_a_warning_is_an_option(names, way, tmp_path):
    """The product of time and current, or the exposure that contains both."""

    def change(dataset, k):
        for name in names.split():
            setattr(dataset, name, 100 + 10 * k)

    (text,) = warned(views(tmp_path, change))
    assert f"views.exposure={way} or <file>" in text


@pytest.mark.parametrize(
    ("creator", "group", "element", "kind", "values"),
    [
        ("GEMS_GENIE_1", 0x11, 0x3B, "FD", {1.0: None, 2.0: "Pixel Scale"}),
        ("GEMS_GENIE_1", 0x11, 0x3C, "FD", {0.0: None, 5.0: "Pixel Offset"}),
        ("GEMS_GENIE_1", 0x11, 0x3B, "FD", {(1.0, 1.0): None, (1.0, 3.0): "Pixel Scale"}),
        ("GEMS_GENIE_1", 0x11, 0x19, "FD", {250.0: None}),
        ("SIEMENS MED NM", 0x33, 0x38, "FL", {1.0: None, 0.5: "Pixel scale factor"}),
        ("SIEMENS SMS-AX  VIEW 1.0", 0x19, 0x0F, "US", {0: None, 1: "Flipped"}),
        ("GEMS_DL_IMG_01", 0x19, 0x34, "DS", {"1.5": None}),
        ("GEMS_PARM_01", 0x43, 0x17, "DS", {"0.095": None}),
        ("nobody", 0x11, 0x3B, "FD", {2.0: None}),
    ],
)
def test_private_attributes_that_may_scale_or_turn_pixels(
    creator, group, element, kind, values, tmp_path
):
    """Are named in one warning for all files, with creator and value, in a block of any number; a
    value that changes nothing, an attribute of another kind, and one unknown are not.
    """
    for block in (0x10, 0x12):
        for value, name in values.items():

            def change(dataset, _, block=block, value=value):
                dataset.add_new((group, block), "LO", creator)
                stated = list(value) if isinstance(value, tuple) else value
                dataset.add_new((group, block << 8 | element), kind, stated)

            texts = warned(views(tmp_path, change))
            assert len(texts) == (name is not None)
            assert all(name in text and creator in text for text in texts)


def test_real_ct_slices_with_private_attributes_open_without_a_warning(tmp_path):
    """pydicom's slice of a GE scanner, thrice."""
    dataset = pydicom.dcmread(get_testdata_file("CT_small.dcm"))
    for k in range(3):
        dataset.InstanceNumber = k + 1
        dataset.save_as(tmp_path / f"{k}.dcm")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = open_projections(tmp_path).read(0, 1)[0]
    assert np.array_equal(values, dataset.pixel_array + float(dataset.RescaleIntercept))


FRAMES = {
    "FrameAcquisitionDateTime": [f"202601011200{k:02d}" for k in range(VIEWS)],
    "FrameReferenceDateTime": [
        "20260101120000+0100",
        *(f"202601011200{k:02d}.5+0100" for k in range(VIEWS - 1)),
    ],
    "TemporalPositionIndex": list(range(VIEWS)),
    "DimensionIndexValues": [[1, k + 1] for k in range(VIEWS)],
}


@pytest.mark.parametrize(
    ("stated", "other"),
    [
        ({"AcquisitionNumber": lambda k: COUNT - 1 - k}, True),
        ({"AcquisitionTime": lambda k: f"1200{59 - k}"}, True),
        ({"AcquisitionDateTime": lambda k: f"2024010112{59 - k}"}, True),
        ({"AcquisitionDate": lambda k: f"2024010{9 - k}", "AcquisitionTime": lambda k: "12"}, True),
        ({"AcquisitionNumber": lambda k: 3}, False),
        ({"AcquisitionNumber": lambda k: None if k else 3}, False),
        (
            {  # over midnight
                "AcquisitionDate": lambda k: f"2024010{1 + k // 2}",
                "AcquisitionTime": lambda k: f"{(23 + k // 2) % 24:02}0{k}00.5",
            },
            False,
        ),
    ],
)
def test_views_acquired_in_another_order_are_warned_of(stated, other, tmp_path):
    """Files are in the order of InstanceNumber; equal numbers and times, or those of some files
    alone, are of no order.
    """

    def change(dataset, k):
        for name, value in stated.items():
            setattr(dataset, name, value(k))

    texts = warned(views(tmp_path, change))
    assert ["InstanceNumber" in text for text in texts] == [True] * other


@pytest.mark.parametrize("name", FRAMES)
def test_frames_in_another_order_than_they_state_are_refused(name, tmp_path):
    for values in (FRAMES[name], [*FRAMES[name][1:], FRAMES[name][0]]):
        groups = [nested("FrameContentSequence", **{name: value}) for value in values]
        dicom_image(tmp_path / "a.dcm", grey(), **{OWN: groups})
        if values == FRAMES[name]:
            assert warned(tmp_path / "a.dcm") == []
            continue
        with pytest.raises(Refused, match=f"order of their {name}"):
            open_projections(tmp_path / "a.dcm")


@pytest.mark.parametrize("name", ["PositionOfIsocenterProjection", "TableXPositionToIsocenter"])
def test_what_moves_between_frames_is_warned_of(name, tmp_path):
    """In the functional groups of frames, and in such a sequence of the images of files."""
    sequence = {"P": "FrameDetectorParameters", "T": "IsocenterReferenceSystem"}[name[0]]
    values = [[4.0, float(k)] if name[0] == "P" else float(k) for k in range(VIEWS)]
    groups = [nested(f"{sequence}Sequence", **{name: value}) for value in values]
    dicom_image(tmp_path / "a.dcm", grey(), **{OWN: groups})
    (text,) = warned(tmp_path / "a.dcm")
    assert name in text
    (tmp_path / "a.dcm").unlink()

    def change(dataset, k):
        setattr(dataset, f"{sequence}Sequence", [item(**{name: values[k]})])

    (text,) = warned(views(tmp_path, change))
    assert name in text


def test_a_table_that_moves_during_a_run_is_warned_of(tmp_path):
    """By its increments, a number for each frame; those of the arm, and zeros, are allowed."""
    path = tmp_path / "a.dcm"
    still = {
        "TableMotion": "STATIC",
        "TableVerticalIncrement": [0.0] * VIEWS,
        "PositionerPrimaryAngleIncrement": [2.0 * k for k in range(VIEWS)],
    }
    dicom_image(path, grey(), **still)
    assert warned(path) == []
    dicom_image(path, grey(), TableLateralIncrement=[0.5 * k for k in range(VIEWS)])
    (text,) = warned(path)
    assert "TableLateralIncrement" in text


@pytest.mark.parametrize(
    "tags",
    [
        {"Modality": "PT"},
        {"Modality": "RTDOSE"},
        {"ImageType": ["ORIGINAL", "PRIMARY", "LOCALIZER"]},
        {"ImageType": ["DERIVED", "SECONDARY", "MPR"]},
        {"SOPClassUID": "1.2.840.10008.5.1.4.1.1.13.1.1"},
        {"SOPClassUID": "1.2.840.10008.5.1.4.1.1.2.1"},
        {"SOPClassUID": "1.2.840.10008.5.1.4.1.1.66.4"},
    ],
)
def test_volumes_doses_and_labels_are_no_projections(tags, tmp_path):
    dicom_image(tmp_path / "a.dcm", grey(), **tags)
    with pytest.raises(Refused, match=f"expected projections, got {next(iter(tags))}"):
        open_projections(tmp_path / "a.dcm")


@pytest.mark.parametrize("numbers", [(1, 2, 1, 2), (1.5, 1, 1, 1)])
def test_slopes_that_are_one_in_some_files_alone_are_applied(numbers, tmp_path):
    """Also tried: intercepts of 0 and 1, and a flat field of another slope."""

    def scaled(dataset, k):
        dataset.RescaleSlope, dataset.RescaleIntercept = numbers[k], 0

    options = {"kind": "intensities", "saturation": 65_535, "flat": 6e4, "find_bad_pixels": False}
    found = opened(views(tmp_path, scaled), **options).stack.read(0, COUNT).numpy()
    expected = grey()[:COUNT].astype("f4") * np.array(numbers, "f4")[:, None, None]
    assert np.array_equal(found, expected)


@pytest.mark.parametrize(
    ("text", "code", "expected"),
    [
        ("-log of flat-corrected images", "", ["derivation '-log of flat-corrected images'"]),
        ("", "Pixel by pixel subtraction", ["derivation 'Pixel by pixel subtraction'"]),
        ("JPEG 2000 lossless", "Lossy Compression", []),
    ],
)
def test_derived_images_are_named_unless_compressed(text, code, expected, tmp_path):
    codes = [item(CodeValue="1", CodingSchemeDesignator="DCM", CodeMeaning=code)] if code else []
    tags = {"DerivationDescription": text, "DerivationCodeSequence": codes}
    assert open_projections(views(tmp_path, **tags)).unknown == expected * COUNT


@pytest.mark.parametrize(("name", "warned"), [("DistanceSourceToDetector", True), (None, False)])
def test_the_distance_of_source_and_detector_is_compared_with_the_cameras(name, warned, tmp_path):
    """As `RTImageSID` is; of detectors that are tilted, it is the perpendicular one."""
    stack = open_projections(views(tmp_path, **({} if name is None else {name: 1200.0})))
    detector = {"pixels": (6, 8), "pixel_mm": (1.0, 1.0)}
    for sdd in (1200.0, 1195.0, 1000.0):
        rig = {"name": "circular", "n_views": COUNT, "sid": 800.0, "sdd": sdd, "detector": detector}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            stack.check_rig(CAMERAS.from_config(rig))
        expected = ["1200 mm for 0, got a camera with 1000"] * (warned and sdd == 1000)
        assert len(caught) == len(expected)
        assert all(text in str(one.message) for one, text in zip(caught, expected, strict=True))


#: Angles of views by how a file states them: of each image, or from the first frame on, or from the
#: frame before.
TURNS = {
    "images": ([0.0, 10.0, 20.0, 30.0], None),
    "from the first": (-15.0, [0.0, 10.0, 20.0, 30.0]),
    "from the frame before": (-15.0, [0.0, 10.0, 10.0, 10.0]),
    "from the frame before, measured": (-15.0, [0.0, 10.05, 9.98, 9.98]),
    "clockwise, across 0": ([15.0, 5.0, 355.0, 345.0], None),
    "uneven": (0.0, [0.0, 10.5, 19.6, 30.2]),
}


@pytest.mark.parametrize("case", TURNS)
@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_angles_are_compared_with_the_turn_of_the_cameras(case, beam, tmp_path):
    """Of files of one frame and of several; the zero and the direction of angles differ between
    devices. An object that turns before a camera at rest, and a positioner that is also turned
    about another axis, are not compared.
    """
    angles, steps = TURNS[case]
    if steps is None:
        path = views(tmp_path, lambda dataset, k: setattr(dataset, PRIMARY, angles[k]))
    else:
        path = tmp_path / "a.dcm"
        stated = {PRIMARY: angles, f"{PRIMARY}Increment": steps}
        dicom_image(path, grey()[:COUNT], Modality="XA", **stated)

    def messages(step):
        rig = {"name": "circular", "sid": 800.0, "sdd": 1200.0}
        rig = rig if beam == "cone" else {"name": "parallel"}
        rig |= {"n_views": COUNT, "angles": [step * k for k in range(COUNT)], "small_arc": True}
        detector = {"pixels": (6, 8), "pixel_mm": (1.0, 1.0)}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            stack.check_rig(CAMERAS.from_config({**rig, "detector": detector}))
        return [str(one.message) for one in caught]

    stack = open_projections(path)
    assert messages(10.0) == messages(-10.0) == []
    (message,) = messages(12.0)
    assert re.search(r"turn by 30\.[02] degrees from .*, got cameras that turn by 36\.0", message)


@pytest.mark.parametrize("secondary", [None, 0.0, 0.5, 20.0])
def test_angles_that_cannot_be_compared_are_not(secondary, tmp_path):
    """With a secondary angle; and equal angles."""
    tags = {} if secondary is None else {"PositionerSecondaryAngle": secondary}
    angles = open_projections(
        views(tmp_path, lambda dataset, k: setattr(dataset, PRIMARY, 10.0 * k), **tags)
    ).angles
    assert list(angles) == ([] if secondary == 20 else [0.0, 10.0, 20.0, 30.0])
    rest = open_projections(views(tmp_path, **{PRIMARY: 30.0}))
    options = {"n_views": COUNT, "sid": 800.0, "sdd": 1200.0, "name": "circular"}
    detector = {"pixels": (6, 8), "pixel_mm": (1.0, 1.0)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rest.check_rig(CAMERAS.from_config({**options, "detector": detector}))


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"ImageComments": "pixel values multiplied by 2"}, "ImageComments: pixel values mult"),
        ({"ImageComments": "flat: exposure 3, slope=2"}, "ImageComments: slope"),
        ({"AcquisitionDeviceProcessingDescription": "LOG SUBTRACTED"}, "LOG SUBTRACTED"),
        ({"DerivationDescription": "Smoothed"}, "derivation 'Smoothed'"),
        ({"ImageComments": "left knee, 0.5 mm of aluminium"}, None),
        ({"DerivationDescription": "Lossless JPEG compression"}, None),
    ],
)
def test_texts_of_dicom_that_state_what_was_done_to_values_are_named(tags, expected, tmp_path):
    """In one warning. Tried as well: FrameComments, and of frames in their functional groups."""
    texts = warned(views(tmp_path, **tags))
    assert (texts == []) if expected is None else (len(texts) == 1 and expected in texts[0])


def test_units_of_dicom_are_compared_with_the_kind_of_views(tmp_path):
    """Attenuation and Hounsfield units are no intensities; a number without a unit may be."""
    for unit, refused in (("/cm", True), ("[hnsf'U]", True), ("1", False), ("{counts}", False)):
        code = item(CodeValue=unit, CodingSchemeDesignator="UCUM", CodeMeaning="unit")
        mapping = item(
            RealWorldValueFirstValueMapped=0,
            RealWorldValueLastValueMapped=65535,
            RealWorldValueSlope=1.0,
            RealWorldValueIntercept=0.0,
            MeasurementUnitsCodeSequence=[code],
        )
        folder = views(tmp_path, RealWorldValueMappingSequence=[mapping])
        if refused:
            with pytest.raises(Refused, match="expected units of intensities"):
                warned(folder)
        else:
            assert warned(folder) == []
