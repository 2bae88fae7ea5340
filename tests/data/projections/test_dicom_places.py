"""An attribute of a DICOM image means the same wherever the file states it: of the image, of all
frames, of a frame, and within any sequence of these.
"""

import numpy as np
import pydicom
import pytest
from pydicom.datadict import dictionary_VR
from pydicom.encaps import encapsulate

from mvrecon.core.files.checks import Refused
from mvrecon.data.dicom_pixels import pixels_of
from mvrecon.data.projections.dicom_views import BEAM, CAMERA_PLACES
from mvrecon.data.projections.exposures import DICOM
from mvrecon.data.projections.opening import open_projections
from tests.data.projections.conftest import CT_PD, VIEWS, dicom_image, grey, opened
from tests.data.projections.test_dicom_pixels import compressed, item, mapping

SHARED, OWN = "SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"
PROPERTIES, FIELD = "FramePixelDataPropertiesSequence", "FieldOfViewSequence"
#: Other values than the first frame's: of the last frame alone.
LAST = VIEWS - 1


def nested(sequences, **attributes):
    """Attributes within sequences of one item each, the outermost first."""
    group = item(**attributes)
    for name in reversed(sequences.split()):
        group = item(**{name: [group]})
    return group


def own(sequences, name, first, last):
    """Functional groups of the frames with a value, and another of the last frame; None: none."""
    values = [first] * LAST + [last]
    return {OWN: [nested(sequences, **({} if v is None else {name: v})) for v in values]}


PLACES = {
    "the image": lambda macro, **tags: tags,
    "its sequence": lambda macro, **tags: {macro: [item(**tags)]},
    "all frames": lambda macro, **tags: {SHARED: [nested(macro, **tags)], OWN: empty()},
    "every frame": lambda macro, **tags: {OWN: [nested(macro, **tags) for _ in range(VIEWS)]},
    "the last frame": lambda macro, **tags: {OWN: [*empty()[1:], nested(macro, **tags)]},
    "no sequence": lambda macro, **tags: {OWN: [*empty()[1:], item(**tags)]},
    "converted": lambda macro, **tags: {
        OWN: [*empty()[1:], nested("UnassignedPerFrameConvertedAttributesSequence", **tags)]
    },
}
REFUSED = {
    "PixelIntensityRelationship": (PROPERTIES, "LOG"),
    "PixelIntensityRelationshipSign": (PROPERTIES, -1),
    "LUTFunction": ("PixelIntensityRelationshipLUTSequence", "TO_LINEAR"),
    "FieldOfViewRotation": (FIELD, 180),
    "FieldOfViewHorizontalFlip": (FIELD, "YES"),
    "RescaleType": ("PixelValueTransformationSequence", "OD"),
}


def empty():
    """Functional groups of the frames without attributes."""
    return [item() for _ in range(VIEWS)]


@pytest.mark.pairwise(name=REFUSED, place=PLACES)
def test_an_attribute_to_refuse_is_found_in_every_place(name, place, tmp_path):
    macro, value = REFUSED[name]
    dicom_image(tmp_path / "a.dcm", grey(), **PLACES[place](macro, **{name: value}))
    with pytest.raises(Refused, match=name):
        open_projections(tmp_path / "a.dcm")


CONTRADICTIONS = {
    "a slope of the image and another of a frame": (
        {"RescaleSlope": 1.0, **own("PixelValueTransformationSequence", "RescaleSlope", 1.0, 16)},
        "RescaleSlope",
    ),
    "an intercept of all frames and another of a frame": (
        {
            **own("PixelValueTransformationSequence", "RescaleIntercept", 0, 5),
            SHARED: [nested("PixelValueTransformationSequence", RescaleIntercept=0)],
        },
        "RescaleIntercept",
    ),
    "small slopes that differ": (
        {
            "RescaleSlope": 2e-9,
            SHARED: [nested("PixelValueTransformationSequence", RescaleSlope=5e-9)],
        },
        "RescaleSlope",
    ),
    "small mappings that differ": (
        {"RealWorldValueMappingSequence": [mapping(2e-9), mapping(5e-9)]},
        "RealWorldValueMappingSequence",
    ),
    "a slope of some frames": (
        own("PixelValueTransformationSequence", "RescaleSlope", 2, None),
        "RescaleSlope of every frame or of none",
    ),
    "a mapping of some frames": (
        {OWN: [item(RealWorldValueMappingSequence=[mapping(2)]), *empty()[1:]]},
        "RealWorldValueMappingSequence of every frame or of none",
    ),
    "a mapping of the image and another of the frames": (
        {
            "RealWorldValueMappingSequence": [mapping(2)],
            OWN: [item(RealWorldValueMappingSequence=[mapping(3)]) for _ in range(VIEWS)],
        },
        "RealWorldValueMappingSequence",
    ),
    "a frame's mapping and its slope": (
        {
            "RescaleSlope": 2,
            OWN: [item(RealWorldValueMappingSequence=[mapping(2 + k)]) for k in range(VIEWS)],
        },
        "RealWorldValueMappingSequence",
    ),
    "pixel sizes of the frames": (
        own(PROPERTIES, "ImagerPixelSpacing", [0.4, 0.4], [0.4, 0.3]),
        "ImagerPixelSpacing of all frames",
    ),
    "fields of view of the frames": (
        own(FIELD, "FieldOfViewOrigin", [0.0, 0.0], [8.0, 0.0]),
        "FieldOfViewOrigin of all frames",
    ),
    "pixel sizes by name": (
        {"ImagerPixelSpacing": [0.4, 0.4], "NominalScannedPixelSpacing": [0.2, 0.2]},
        "NominalScannedPixelSpacing",
    ),
    "an aspect ratio": (
        {"ImagerPixelSpacing": [0.4, 0.4], "PixelAspectRatio": [2, 1]},
        "PixelAspectRatio",
    ),
    "an aspect ratio alone": ({"PixelAspectRatio": [1, 2]}, "PixelAspectRatio"),
    "frames in another order": (
        {
            OWN: [
                nested("FrameContentSequence", FrameAcquisitionNumber=n)
                for n in [2, 1, *range(3, 13)]
            ]
        },
        "FrameAcquisitionNumber",
    ),
    "too few functional groups": ({OWN: empty()[1:]}, "NumberOfFrames, got 12 with 11 groups"),
    "more frames than stated": ({"NumberOfFrames": 6}, "NumberOfFrames, 6, got those of 12"),
    "too many frames": ({"NumberOfFrames": 2**31 - 1}, "NumberOfFrames 1 to 65536"),
    "a negative number of frames": ({"NumberOfFrames": -1}, "NumberOfFrames 1 to 65536"),
    "frames that are not stated": ({"NumberOfFrames": None}, "NumberOfFrames, 1, got those of 12"),
    "the highest bits": ({"BitsStored": 12, "HighBit": 15}, "HighBit 11"),
    "the lowest bits": ({"BitsStored": 12, "HighBit": 7}, "HighBit 11"),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_places_that_contradict_each_other_are_refused_by_name(case, tmp_path):
    """Values of the image, of all frames and of a frame; of names that repeat each other; of frames
    and of what counts them; of bits. Tried as well: implicit VR, where numbers of nested sequences
    are ambiguous; RLE and JPEG-LS; 1500 frames; pydicom's own files.
    """
    tags, name = CONTRADICTIONS[case]
    dicom_image(tmp_path / "a.dcm", grey(), **tags)
    with pytest.raises(Refused, match=name):
        open_projections(tmp_path / "a.dcm").read(0, 1)


AGREED = {
    "a slope of all places": (
        {
            "RescaleSlope": "2",
            SHARED: [nested("PixelValueTransformationSequence", RescaleSlope="2.0")],
            **own("PixelValueTransformationSequence", "RescaleSlope", "2.000", "2"),
        },
        2.0,
    ),
    "a slope and its mapping": (
        {
            "RescaleSlope": 0.5,
            OWN: [item(RealWorldValueMappingSequence=[mapping(0.5)]) for _ in range(VIEWS)],
        },
        0.5,
    ),
    "mappings that share the range": (
        {"RealWorldValueMappingSequence": [mapping(3, last=20000), mapping(3, first=20001)]},
        3.0,
    ),
    "slopes of the frames": (
        {
            OWN: [
                nested("PixelValueTransformationSequence", RescaleSlope=k + 1) for k in range(VIEWS)
            ]
        },
        np.arange(1.0, VIEWS + 1)[:, None, None],
    ),
    "attributes of another image": (
        {
            OWN: [
                nested("DerivationImageSequence SourceImageSequence", RescaleSlope=7)
                for _ in range(VIEWS)
            ]
        },
        1.0,
    ),
    "what is stated and means nothing": (
        {
            "PixelAspectRatio": [1, 1],
            "NominalScannedPixelSpacing": [0.4, 0.4],
            "ImagerPixelSpacing": [0.4, 0.4],
            "RescaleType": "US",
            "PixelPaddingValue": 0,
            "PlanarConfiguration": 0,
            **own(PROPERTIES, "PixelIntensityRelationship", "LIN", "LIN"),
        },
        1.0,
    ),
}


@pytest.mark.parametrize("case", AGREED)
def test_places_that_agree_are_applied_once(case, tmp_path):
    tags, slope = AGREED[case]
    dicom_image(tmp_path / "a.dcm", grey(), **tags)
    values = open_projections(tmp_path / "a.dcm").read(0, VIEWS).numpy()
    assert np.array_equal(values, (grey().astype("f8") * slope).astype("f4"))


@pytest.mark.parametrize(
    "name",
    [n for n in (*DICOM, *BEAM, *CAMERA_PLACES) if n != "PhotometricInterpretation"],
)
def test_views_of_several_exposures_are_warned_of(name, tmp_path):
    """In each of DICOM's units, in files of their own as in the functional groups of frames, where
    they differ by more than 1 %.
    """
    kinds = CT_PD[name][1] if name in CT_PD else dictionary_VR(name)
    kind = str if kinds in ("CS", "LO", "LT", "SH", "ST") else int
    for k in range(3):
        tags = {"InstanceNumber": k, name: kind(100 + 2 * (k // 2))}
        dicom_image(tmp_path / f"{k}.dcm", grey()[k], **tags)
    with pytest.warns(UserWarning, match=f"views have several values of {name}, 100.* or 102"):
        open_projections(tmp_path)


def test_views_and_fields_that_a_program_may_have_inverted_are_warned_of(tmp_path):
    """Some invert the pixels of MONOCHROME1, which by itself affects display alone."""
    shown = {"PhotometricInterpretation": "MONOCHROME1"}
    for k in range(2):
        dicom_image(tmp_path / f"{k}.dcm", grey()[k], InstanceNumber=k, **(shown if k else {}))
    with pytest.warns(UserWarning, match="several values of PhotometricInterpretation"):
        open_projections(tmp_path)
    (tmp_path / "1.dcm").unlink()
    dicom_image(tmp_path / "flat.dcm", grey()[1] * 0 + 60_000, **shown)
    with pytest.warns(UserWarning, match="flat field has the PhotometricInterpretation MONOC"):
        opened(tmp_path, find_bad_pixels=False)


def test_exposures_of_radiotherapy_images_are_warned_of(tmp_path):
    """In the ExposureSequence of RT images; filters in XRayFilterSequence."""
    for k in range(2):
        exposed = item(MetersetExposure=1.0 + k, KVP=100)
        filters = item(FilterType=("NONE", "STRIP")[k])
        tags = {"ExposureSequence": [exposed], "XRayFilterSequence": [filters]}
        dicom_image(tmp_path / f"{k}.dcm", grey()[k], InstanceNumber=k, **tags)
    with pytest.warns(UserWarning) as caught:
        open_projections(tmp_path)
    texts = " ".join(str(one.message) for one in caught)
    assert "MetersetExposure, 1.0 or 2.0" in texts and "FilterType" in texts and "KVP" not in texts


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("FieldOfViewOrigin", ([0.0, 0.0], [0.0, 3.0])),
        ("PixelDataAreaOriginRelativeToFOV", ([0.0, 0.0], [0.0, 3.0])),
        ("XRayImageReceptorTranslation", ([0.0, 0.0, 0.0], [0.0, 3.0, 0.0])),
        ("XRayImageReceptorAngle", (0.0, 90.0)),
        ("RTImagePosition", ([-5.0, 5.0], [-2.0, 5.0])),
        ("DetectorActiveOrigin", ([0.0, 0.0], [4.0, 0.0])),
    ],
)
def test_views_in_files_of_their_own_are_of_one_detector(name, places, tmp_path):
    for k, place in enumerate(places):
        dicom_image(tmp_path / f"{k}.dcm", grey()[k], InstanceNumber=k, **{name: place})
    with pytest.raises(Refused, match=name):
        open_projections(tmp_path)


@pytest.mark.parametrize("write", [dicom_image, compressed])
@pytest.mark.parametrize("kind", ["u2", "i2"])
def test_bits_above_the_stored_ones_are_cleared(kind, write, tmp_path):
    """Such as overlays of old files; signed numbers keep their sign. An overlay within the stored
    bits is part of the values, and refused.
    """
    signed = kind == "i2"
    values = (grey() % 4096 - 2048 * signed).astype(kind)
    mixed = ((values.view("u2") & 0x0FFF) | 0xA000).view(kind)
    bits = {"BitsStored": 12, "HighBit": 11}
    write(tmp_path / "a.dcm", mixed, **bits)
    dataset = pydicom.dcmread(tmp_path / "a.dcm")
    for place, allowed in ((13, True), (3, False), (11, False)):
        for element, value in ((0x0100, 16), (0x0102, place)):
            dataset.add_new((0x6000, element), "US", value)
        dataset.save_as(tmp_path / "a.dcm", enforce_file_format=True)
        if allowed:
            assert np.array_equal(pixels_of(tmp_path / "a.dcm"), values)
            continue
        with pytest.raises(Refused, match=f"OverlayBitPosition {place}"):
            pixels_of(tmp_path / "a.dcm")


def test_a_pixel_of_padding_is_refused(tmp_path):
    """Of integers, of a range, of signed numbers, and of floats."""
    values = grey()
    dicom_image(tmp_path / "a.dcm", values, PixelPaddingValue=int(values[3, 2, 1]))
    with pytest.raises(Refused, match="1 of its PixelPaddingValue in frame 3"):
        pixels_of(tmp_path / "a.dcm")
    limits = {"PixelPaddingValue": 0, "PixelPaddingRangeLimit": int(values.min())}
    dicom_image(tmp_path / "b.dcm", values, **limits)
    with pytest.raises(Refused, match="1 of its PixelPaddingValue"):
        pixels_of(tmp_path / "b.dcm")
    floats(tmp_path / "c.dcm", values.astype("f4") / 3, FloatPixelPaddingValue=values[3, 2, 1] / 3)
    with pytest.raises(Refused, match="1 of its PixelPaddingValue"):
        pixels_of(tmp_path / "c.dcm")


def floats(path, values, **tags):
    """A DICOM image of float32."""
    dicom_image(path, values, **tags)
    dataset = pydicom.dcmread(path)
    for name in ("BitsStored", "HighBit", "PixelRepresentation", "PixelData"):
        delattr(dataset, name)
    dataset.BitsAllocated, dataset.FloatPixelData = 32, values.tobytes()
    dataset.save_as(path, enforce_file_format=True)


def test_floats_are_read(tmp_path):
    values = grey().astype("f4") / 3
    floats(tmp_path / "a.dcm", values, RescaleSlope=2)
    assert np.array_equal(open_projections(tmp_path / "a.dcm").read(0, VIEWS), 2 * values)


@pytest.mark.parametrize("frames", [VIEWS - 2, 1, VIEWS])
def test_compressed_frames_are_counted(frames, tmp_path):
    """By the code streams, in a file with or without a table of their offsets."""
    compressed(tmp_path / "a.dcm", grey())
    dataset = pydicom.dcmread(tmp_path / "a.dcm")
    parts = list(pydicom.encaps.generate_frames(dataset.PixelData, number_of_frames=VIEWS))
    for table in (True, False):
        dataset.NumberOfFrames, dataset.PixelData = frames, encapsulate(parts, has_bot=table)
        dataset.save_as(tmp_path / "a.dcm", enforce_file_format=True)
        if frames == VIEWS:
            assert np.array_equal(pixels_of(tmp_path / "a.dcm"), grey())
            continue
        with pytest.raises(Refused, match=f"NumberOfFrames, {frames}, got those of {VIEWS}"):
            pixels_of(tmp_path / "a.dcm")


def test_curved_and_transposed_detectors_of_dicom_ct_pd_are_refused(tmp_path):
    """Its private attributes, with and without the creator of their group, as they are in the
    Mayo Clinic's library, and of an unknown type. Flat ones are read.
    """
    greys = grey()
    rows, columns = greys.shape[-2:]
    assert rows != columns

    def written(shape, sizes, creator=True, kind="CS"):
        path = tmp_path / "a.dcm"
        dicom_image(path, greys)
        dataset = pydicom.dcmread(path)
        if creator:
            dataset.private_block(0x7029, "DICOM-CT-PD", create=True)
        dataset.add_new(0x7029100B, kind, shape)
        for tag, size in zip((0x70291010, 0x70291011), sizes, strict=True):
            dataset.add_new(tag, "US", size)
        dataset.save_as(path)
        return path

    for creator in (True, False):
        assert open_projections(written("FLAT", (rows, columns), creator)).shape == greys.shape[-2:]
        for shape in ("CYLINDRICAL", "SPHERICAL"):
            with pytest.raises(Refused, match=f"DetectorShape FLAT, got '{shape}'"):
                open_projections(written(shape, (rows, columns), creator))
        with pytest.raises(Refused, match=f"NumberofDetectorRows {columns}; transpose"):
            open_projections(written("FLAT", (columns, rows), creator))
    with pytest.raises(Refused, match="DetectorShape FLAT"):
        open_projections(written(b"CYLINDRICAL ", (rows, columns), kind="UN"))
