"""Every attribute of a DICOM image that changes its pixels is applied or refused by name."""

from functools import partial

import imagecodecs
import numpy as np
import pydicom
import pytest
import torch
from pydicom.encaps import encapsulate

from mvrecon.core.files.checks import Refused
from mvrecon.data.dicom_image import KEYS
from mvrecon.data.dicom_pixels import pixels_of
from mvrecon.data.projections.dicom_views import DICOM_KEYS
from mvrecon.data.projections.opening import open_projections
from mvrecon.geometry.cameras.rigs import circular
from tests.data.projections.conftest import dicom_image, grey, opened


def item(**attributes):
    """A data set with these attributes."""
    dataset = pydicom.Dataset()
    for name, value in attributes.items():
        setattr(dataset, name, value)
    return dataset


def mapping(slope, intercept=0.0, first=0, last=65535, **attributes):
    """An item of a RealWorldValueMappingSequence."""
    return item(
        RealWorldValueSlope=float(slope),
        RealWorldValueIntercept=float(intercept),
        RealWorldValueFirstValueMapped=first,
        RealWorldValueLastValueMapped=last,
        **attributes,
    )


def compressed(path, values, **tags):
    """A DICOM image in JPEG-LS, or of signed numbers in JPEG 2000, by imagecodecs without loss."""
    dicom_image(path, values, **tags)
    dataset = pydicom.dcmread(path)
    encode, syntax = imagecodecs.jpegls_encode, pydicom.uid.JPEGLSLossless
    if values.dtype.kind == "i":
        encode = partial(imagecodecs.jpeg2k_encode, codecformat="j2k", level=0, reversible=True)
        syntax = pydicom.uid.JPEG2000Lossless
    dataset.PixelData = encapsulate([encode(view) for view in values])
    dataset["PixelData"].is_undefined_length = True
    dataset.file_meta.TransferSyntaxUID = syntax
    dataset.save_as(path, enforce_file_format=True)


SCALES = {
    "none": ({}, 1, 0),
    "rescale": ({"RescaleSlope": 0.5, "RescaleIntercept": -10}, 0.5, -10),
    "slope alone": ({"RescaleSlope": 4}, 4, 0),
    "intercept alone": ({"RescaleIntercept": 7}, 1, 7),
    "mapping alone": ({"RealWorldValueMappingSequence": [mapping(2)]}, 2, 0),
    "mapping with intercept": ({"RealWorldValueMappingSequence": [mapping(0.25, 3)]}, 0.25, 3),
    "both": (
        {
            "RescaleSlope": 2,
            "RescaleIntercept": 1,
            "RealWorldValueMappingSequence": [mapping(2, 1)],
        },
        2,
        1,
    ),
    "of shared functional groups": (
        {
            "SharedFunctionalGroupsSequence": [item(RealWorldValueMappingSequence=[mapping(3)])],
            "PerFrameFunctionalGroupsSequence": [item() for _ in grey()],
        },
        3,
        0,
    ),
    "white as the smallest": ({"PhotometricInterpretation": "MONOCHROME1"}, 1, 0),
}


@pytest.mark.pairwise(scale=SCALES, write=[dicom_image, compressed])
def test_pixels_are_slope_times_stored_number_plus_intercept(scale, write, tmp_path):
    """Also of compressed images, whose decoder scales some by itself and inverts MONOCHROME1."""
    tags, slope, intercept = SCALES[scale]
    write(tmp_path / "a.dcm", grey(), **tags)
    expected = slope * grey().astype("f4") + intercept
    assert np.array_equal(pixels_of(tmp_path / "a.dcm"), expected)


MAPPINGS = {
    "another slope than RescaleSlope": {
        "RescaleSlope": 1,
        "RescaleIntercept": 0,
        "RealWorldValueMappingSequence": [mapping(2)],
    },
    "several": {"RealWorldValueMappingSequence": [mapping(2), mapping(5)]},
    "a look-up table": {
        "RealWorldValueMappingSequence": [item(RealWorldValueLUTData=[0.0, 1.0, 4.0])]
    },
    "part of the range": {"RealWorldValueMappingSequence": [mapping(2, last=1000)]},
}


@pytest.mark.parametrize("case", MAPPINGS)
def test_an_ambiguous_real_world_value_mapping_is_refused(case, tmp_path):
    """DICOM pixels with a real world value mapping that contradicts their RescaleSlope, that is a
    look-up table, several mappings, or does not hold for all pixels are refused.
    """
    dicom_image(tmp_path / "a.dcm", grey(), **MAPPINGS[case])
    with pytest.raises(Refused, match="RealWorldValueMappingSequence"):
        open_projections(tmp_path / "a.dcm").read(0, 1)


VALUES = {
    "ModalityLUTSequence": [item(LUTDescriptor=[2, 0, 16])],
    "DoseGridScaling": 1e-6,
    "PhotometricInterpretation": "PALETTE COLOR",
    "SamplesPerPixel": 3,
    "PixelIntensityRelationship": "LOG",
    "PixelIntensityRelationshipSign": -1,
    "LUTFunction": "TO_LINEAR",
    "PresentationIntentType": "FOR PRESENTATION",
    "RescaleType": "OD",
    "FieldOfViewRotation": 90,
    "FieldOfViewHorizontalFlip": "YES",
    "PixelDataAreaRotationAngleRelativeToFOV": 90.0,
    "AppliedMaskSubtractionFlag": "YES",
    "ConcatenationUID": "1.2.3",
    "InConcatenationNumber": 1,
    "Planes": 3,
    "SegmentationType": "FRACTIONAL",
    "SegmentationFractionalType": "OCCUPANCY",
    "MaximumFractionalValue": 255,
    "BurnedInAnnotation": "YES",
    "LogFlag": "YES",
    "ImageProcessingApplied": ["FRAME_AVERAGING", "HIGH_PASS_FILTER"],
    "FluoroscopyPersistenceFlag": "YES",
    "FluoroscopyLastImageHoldPersistenceFlag": "YES",
    "RotationOfScannedFilm": 180,
    "GeometricalProperties": "NON_UNIFORM",
    "TableMotion": "DYNAMIC",
    "DetectorShape": "CYLINDRICAL",
    "FlyingFocalSpotMode": "FFSXY",
}


@pytest.mark.parametrize(
    "key",
    [name for key in (*KEYS, *DICOM_KEYS) if key.use == "refused" for name in key.names],
)
def test_every_attribute_to_refuse_is_refused_by_name(key, tmp_path):
    """DICOM projections with an attribute that changes their pixels otherwise are refused."""
    dicom_image(tmp_path / "a.dcm", grey(), **{key: VALUES[key]})
    with pytest.raises(Refused, match=key):
        open_projections(tmp_path / "a.dcm").read(0, 1)


@pytest.mark.parametrize(
    ("kind", "bits", "tags"),
    [
        ("u2", 16, {}),
        ("u2", 12, {}),
        ("u2", 14, {"RescaleSlope": 1, "RescaleIntercept": 0}),
        ("i2", 13, {}),
        ("u2", 12, {"RescaleSlope": 0.5, "RescaleIntercept": 100}),
        ("u2", 12, {"RescaleSlope": -1, "RescaleIntercept": 4095}),
        ("u2", 16, {"RealWorldValueMappingSequence": [mapping(2)]}),
    ],
)
@pytest.mark.parametrize("write", [dicom_image, compressed])
def test_pixels_at_full_scale_leave_the_mask(kind, bits, tags, write, tmp_path):
    """The greatest value of BitsStored, scaled, is saturation; of integers, kind= is not needed."""
    top = 2 ** (bits - (kind == "i2")) - 1
    values = np.full((2, 6, 8), top // 3, kind)
    slope = tags.get("RescaleSlope", 1)
    values[1, 2, 3], values[1, 4, 5] = (top, top - 1) if slope > 0 else (0, 1)
    write(tmp_path / "a.dcm", values, BitsStored=bits, HighBit=bits - 1, **tags)
    integer = slope == 1 and "RealWorldValueMappingSequence" not in tags
    kind_of = {} if integer else {"kind": "intensities"}
    flat = float(pixels_of(tmp_path / "a.dcm").max()) / 2
    measured = opened(tmp_path / "a.dcm", flat=flat, dark=-10.0, **kind_of)
    with pytest.warns(UserWarning, match="1 pixels of 2 views are saturated"):
        back = measured.whole()
    expected = torch.ones(2, 6, 8, dtype=torch.bool)
    expected[1, 2, 3] = False
    assert measured.kind == "intensities" and torch.equal(back.mask, expected)


@pytest.mark.parametrize(
    "tags", [{"RescaleSlope": 0.5, "RescaleIntercept": 100}, {"RescaleSlope": 2}, {}]
)
def test_scaled_pixels_in_proportion_to_intensity_need_no_kind(tags, tmp_path):
    """Where the file states so; else the message names the choice, and kind= decides."""
    said, open_ = tmp_path / "said.dcm", tmp_path / "open.dcm"
    dicom_image(said, grey(), **tags, PixelIntensityRelationship="LIN")
    dicom_image(open_, grey(), **tags)
    assert opened(said, flat=1e5, saturation=3e5).kind == "intensities"
    if tags:
        with pytest.raises(Refused, match="kind=integrals or kind=intensities .* a file scales"):
            opened(open_, flat=1e5)
        assert opened(said, kind="integrals").kind == "integrals"


def test_views_with_slopes_of_their_own_need_a_saturation(tmp_path):
    """DICOM intensities whose greatest stored value has another meaning in each view are refused
    without saturation=.
    """
    for k, slope in enumerate((1.5, 2.0)):
        dicom_image(tmp_path / f"{k}.dcm", grey()[k], InstanceNumber=k, RescaleSlope=slope)
    options = {"kind": "intensities", "flat": 1e5}
    with pytest.raises(Refused, match="give saturation="):
        opened(tmp_path, **options)
    assert opened(tmp_path, **options, saturation=3e5).whole().mask.all()
    assert opened(tmp_path, kind="integrals").whole().views.shape == (2, 6, 8)


def test_frames_with_slopes_of_their_own_need_a_saturation(tmp_path):
    """As views in files of their own; their values are scaled by frame."""
    groups = [
        item(PixelValueTransformationSequence=[item(RescaleSlope=k + 1.0, RescaleIntercept=0.0)])
        for k in range(len(grey()))
    ]
    dicom_image(tmp_path / "a.dcm", grey(), PerFrameFunctionalGroupsSequence=groups)
    with pytest.raises(Refused, match="give saturation="):
        opened(tmp_path / "a.dcm", kind="intensities", flat=1e5)
    values = opened(tmp_path / "a.dcm", kind="integrals").whole().views
    scale = torch.arange(1.0, len(grey()) + 1)[:, None, None]
    assert torch.equal(values, scale * torch.from_numpy(grey().astype("f4")))


def test_the_pixel_size_of_the_detector_is_compared_with_the_cameras(tmp_path):
    dicom_image(tmp_path / "a.dcm", grey(), ImagerPixelSpacing=[0.4, 0.3])
    views = opened(tmp_path / "a.dcm", kind="counts")
    for pitch in ((0.4, 0.3), (0.3, 0.4)):
        plate = {"pixels": [6, 8], "pixel_mm": pitch}
        rig = circular(n_views=len(grey()), sid=300.0, sdd=450.0, detector=plate)
        if pitch == (0.4, 0.3):
            assert views.cameras(rig).shape == (6, 8)
            continue
        with pytest.raises(Refused, match=r"the file's pixels of 0\.4 x 0\.3 mm"):
            views.cameras(rig)
