"""DICOM NM: frames in any order are sorted by window, detector, rotation and angular view."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvrecon.data.projections.images import ImageFiles
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon_spect.files.nm import NmStudy, paired, read_frames, read_nm
from tests.data.nm_files import in_time, item, study

pydicom = pytest.importorskip("pydicom")


@pytest.fixture(scope="module")
def nm(tmp_path_factory: pytest.TempPathFactory) -> NmStudy:
    return read_nm(study(tmp_path_factory.mktemp("nm") / "a.dcm"))


def test_frames_are_sorted_by_their_vectors(nm: NmStudy):
    for w, counts in enumerate(nm.counts, 1):
        expected = [1000 * w + 100 * d + a for d in (1, 2) for a in (1, 2, 3)]
        assert counts.shape == (1, 1, 6, 4, 5)
        assert counts[0, 0, :, 2, 2].tolist() == expected
        assert (counts[0, 0, :, 0, 1] == 7).all()
    assert nm.windows[1] == ("peak", ((126.5, 154.5),)) and nm.pixel_mm == (2.0, 1.5)


def test_angles_follow_the_direction_from_each_detector_s_start(nm: NmStudy):
    assert [view.angle_degrees for view in nm.views] == [10.0, 340.0, 310.0, 190.0, 160.0, 130.0]
    assert [view.radius_mm for view in nm.views] == [250.0, 251.0, 252.0] * 2
    assert nm.views[0].duration_s == 20.0 and nm.views[4][:3] == (2, 1, 2)


def test_heads_without_a_start_angle_are_asked_for_it(tmp_path: Path):
    """Two heads of a rotation with a start angle: each head's own is needed, and neither where the
    rotation has none, either. Heads may state the same angle; one head takes the rotation's. Of
    several rotations, each with a start angle, those of the heads are unknown, but where each head
    has a rotation of its own that starts at its angle. A rotation without views is none.
    """
    from pydicom.dataset import Dataset

    def heads(*starts: float | None) -> dict[str, list]:
        items = [item(Dataset, **({} if s is None else {"StartAngle": s})) for s in starts]
        return {"DetectorInformationSequence": items}

    def turns(*starts: float | None) -> dict[str, list]:
        given = ({} if s is None else {"StartAngle": s} for s in starts)
        items = [item(Dataset, AngularStep=30.0, RotationDirection="CW", **g) for g in given]
        return {"RotationInformationSequence": items}

    for starts, without in (((None, None), "1, 2"), ((10.0, None), "2"), ((None, 190.0), "1")):
        with pytest.raises(ValueError, match=rf"StartAngle of each of the 2 .*detector {without}:"):
            read_nm(study(tmp_path / "a.dcm", **heads(*starts)))
    bare = read_nm(study(tmp_path / "b.dcm", **heads(None, None), **turns(None)))
    assert [view.angle_degrees for view in bare.views] == [None] * 6
    partly = read_nm(study(tmp_path / "c.dcm", **heads(10.0, None), **turns(None)))
    assert [view.angle_degrees for view in partly.views] == [10.0, 340.0, 310.0] + [None] * 3
    stacked = read_nm(study(tmp_path / "d.dcm", **heads(10.0, 10.0)))  # above one another
    assert [view.angle_degrees for view in stacked.views] == [10.0, 340.0, 310.0] * 2
    twice = {"RotationVector": [1, 2] * 6, "AngularViewVector": [1] * 12}
    twice |= {"EnergyWindowVector": [1] * 6 + [2] * 6, "DetectorVector": [1, 1, 2, 2, 3, 3] * 2}
    with pytest.raises(
        ValueError, match="one rotation of detectors .*got 2 with a StartAngle each"
    ):
        read_nm(study(tmp_path / "e.dcm", **twice, **heads(0.0, 120.0, 240.0), **turns(0.0, 60.0)))
    one = {"DetectorVector": [1] * 12, "AngularViewVector": [1, 2, 3, 4, 5, 6] * 2}
    one |= {"EnergyWindowVector": [1] * 6 + [2] * 6}
    alone = read_nm(study(tmp_path / "f.dcm", **one, **heads(None), **turns(10.0)))
    assert [view.angle_degrees for view in alone.views][:2] == [10.0, 340.0]
    each: dict[str, list[int]] = {"RotationVector": ([1] * 3 + [2] * 3) * 2}
    each |= {"EnergyWindowVector": [1] * 6 + [2] * 6, "AngularViewVector": [1, 2, 3] * 4}
    each["DetectorVector"] = each["RotationVector"]
    own = read_nm(study(tmp_path / "g.dcm", **each, **heads(10.0, 190.0), **turns(10.0, -170.0)))
    assert [view.angle_degrees for view in own.views] == [10.0, 340.0, 310.0, 190.0, 160.0, 130.0]
    bare = read_nm(study(tmp_path / "i.dcm", **each, **heads(None, None), **turns(10.0, -170.0)))
    assert [view[3:] for view in bare.views] == [view[3:] for view in own.views]
    with pytest.raises(ValueError, match=r"StartAngle of each of the 2 .*detector 1, 2:"):
        read_nm(study(tmp_path / "j.dcm", **each, **heads(None, None), **turns(10.0, 370.0)))
    unused = read_nm(study(tmp_path / "k.dcm", **heads(10.0, 190.0), **turns(10.0, 100.0)))
    assert [view.angle_degrees for view in unused.views] == [view[3] for view in own.views]
    for starts in ((10.0, 10.0), (190.0, 10.0)):
        with pytest.raises(ValueError, match="got 2 with a StartAngle each"):
            read_nm(study(tmp_path / "h.dcm", **each, **heads(10.0, 190.0), **turns(*starts)))


def test_a_dynamic_study_is_read_frame_by_frame(tmp_path: Path):
    """Phase 1: 4 frames of 10 s, 2 s between them, after 5 s; phase 2: 2 of 60 s, after 1 s."""
    from pydicom.dataset import Dataset

    phases = [
        item(
            Dataset,
            PhaseDelay=delay,
            ActualFrameDuration=duration,
            PauseBetweenFrames=pause,
            NumberOfFramesInPhase=count,
        )
        for delay, duration, pause, count in ((5000, 10000, 2000, 4), (1000, 60000, 0, 2))
    ]
    vectors = ("PhaseVector", "TimeSliceVector")
    path = in_time(tmp_path / "a.dcm", vectors, PhaseInformationSequence=phases)
    with pytest.raises(ValueError, match="NumberOfFramesInPhase is 3, got 4"):
        fewer = [Dataset(phase) for phase in phases]
        fewer[0].NumberOfFramesInPhase = 3
        read_nm(in_time(tmp_path / "b.dcm", vectors, PhaseInformationSequence=fewer))
    frames, studies = zip(*read_frames(path), strict=True)
    assert [frame[:2] for frame in frames] == [(1, 1), (1, 2), (1, 3), (1, 4), (2, 1), (2, 2)]
    # 5 + 4 (10 + 2) + 1 s until the second phase
    assert [frame.start_s for frame in frames] == [5, 17, 29, 41, 54, 114]
    assert [frame.duration_s for frame in frames] == [10] * 4 + [60] * 2
    for frame, one in zip(frames, studies, strict=True):
        value = 10 * frame.phase + frame.time_slice
        assert [view.detector for view in one.views] == [1, 2]
        assert one.counts[0][0, 0, :, 1, 1].tolist() == [100 + value, 200 + value]
        assert one.counts[0].shape == (1, 1, 2, 4, 5) and one.windows[0].name == "scatter"
    with pytest.raises(ValueError, match="study of 6; read_frames reads them"):
        read_nm(path)


def test_a_gated_study_is_read_slot_by_slot(tmp_path: Path):
    from pydicom.dataset import Dataset

    intervals = [item(Dataset, FrameTime=time) for time in (125.0, 200.0)]
    gate = item(Dataset, DataInformationSequence=intervals)
    vectors = ("RRIntervalVector", "TimeSlotVector")
    path = in_time(tmp_path / "a.dcm", vectors, GatedInformationSequence=[gate])
    frames, studies = zip(*read_frames(path), strict=True)
    assert [frame[2:] for frame in frames] == [
        (1, 1, 0.0, 0.125),
        (1, 2, 0.125, 0.125),
        (1, 3, 0.25, 0.125),
        (1, 4, 0.375, 0.125),
        (2, 1, 0.0, 0.2),
        (2, 2, 0.2, 0.2),
    ]
    counts = [one.counts[0][0, 0, 1, 0, 0].item() for one in studies]
    assert counts == [211, 212, 213, 214, 221, 222]
    # without the times of the slots the frames are the same
    bare = in_time(tmp_path / "b.dcm", vectors)
    assert [frame.start_s for frame, _ in read_frames(bare)] == [None] * 6
    gate.CardiacFramingType = "BACK"  # from the next R wave on
    back = in_time(tmp_path / "c.dcm", vectors, GatedInformationSequence=[gate])
    assert [frame.start_s for frame, _ in read_frames(back)] == [None] * 6


def test_a_tomogram_is_a_single_frame(tmp_path: Path):
    path = study(tmp_path / "a.dcm")
    ((frame, one),) = read_frames(path)
    assert frame == (1, 1, 1, 1, None, None)
    assert all(map(torch.equal, one.counts, read_nm(path).counts))


def test_pinholes_for_nm_are_read_from_a_camera_file(nm: NmStudy):
    """DICOM NM does not say where pinholes are: without a rig of the same views it is refused."""
    rig = dcspect80(pixels=[4, 5])[:6]
    rig = replace(rig, u=rig.u * 1.5 / rig.u.norm(dim=-1, keepdim=True))
    rig = replace(rig, v=rig.v * 2.0 / rig.v.norm(dim=-1, keepdim=True))
    assert paired(nm, rig) is rig
    with pytest.raises(ValueError, match="does not say where pinholes are"):
        paired(nm, None)
    with pytest.raises(ValueError, match="Expected 6 cameras"):
        paired(nm, rig[torch.arange(5)])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Modality": "CT"}, "expected Modality NM, got 'CT'"),
        ({"DetectorVector": [1] * 12}, "every view once in every frame"),
        ({"SliceVector": list(range(1, 13))}, "slices of a volume"),
        ({"AngularViewVector": [1, 2]}, "AngularViewVector of 12 numbers"),
        ({"TimeSlotVector": [1] * 11 + [2]}, "every view once in every frame"),
        ({"PixelRepresentation": 1, "PixelData": b"\xff" * 480}, "not negative, got -1"),
        ({"PixelData": bytes(100)}, "cannot be read"),
    ],
)
def test_an_inconsistent_nm_file_is_refused(tmp_path: Path, changes: dict, message: str):
    """A DICOM NM file whose vectors, modality, counts or size do not fit is refused."""
    with pytest.raises(ValueError, match=message):
        read_nm(study(tmp_path / "a.dcm", **changes))


def scaled(slope: float, unit: str = "", **values: object) -> list:
    """A real world value mapping of a slope and a unit."""
    from pydicom.dataset import Dataset

    whole = {"RealWorldValueFirstValueMapped": 0, "RealWorldValueLastValueMapped": 65535}
    code = [item(Dataset, CodeValue=unit)] if unit else []
    stated = {"RealWorldValueSlope": slope, "RealWorldValueIntercept": 0.0, **whole, **values}
    return [item(Dataset, MeasurementUnitsCodeSequence=code, **stated)]


@pytest.mark.parametrize(
    "changes",
    [
        {"RescaleSlope": 2.0, "RescaleIntercept": 0.0},
        {"RealWorldValueMappingSequence": scaled(2.0)},
        {"RealWorldValueMappingSequence": scaled(2.0, "{counts}")},
        {"RescaleSlope": 2.0, "RealWorldValueMappingSequence": scaled(2.0, "1")},
    ],
)
def test_counts_are_scaled_by_either_mapping(tmp_path: Path, nm: NmStudy, changes: dict):
    again = read_nm(study(tmp_path / "a.dcm", **changes))
    for got, plain in zip(again.counts, nm.counts, strict=True):
        assert torch.equal(got, 2 * plain)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"RealWorldValueMappingSequence": scaled(2.0, "Bq/ml")},
            "expected MeasurementUnitsCodeSequence .* got 'Bq/ml'",
        ),
        (
            {"RescaleSlope": 1.0, "RealWorldValueMappingSequence": scaled(2.0)},
            "agrees with the slope 1 and intercept 0 of its pixels, got 2 and 0",
        ),
        (
            {"RealWorldValueMappingSequence": scaled(2.0, RealWorldValueLastValueMapped=900)},
            "stored numbers from 0 to 900",
        ),
        ({"Units": "BQML"}, "Units of counts .* got 'BQML'"),
        ({"CorrectedImage": ["UNIF", "ATTN"]}, "counts as measured, got CorrectedImage with ATTN"),
        ({"CorrectedImage": "DECY"}, "CorrectedImage with DECY"),
        ({"PhotometricInterpretation": "PALETTE COLOR"}, "PhotometricInterpretation"),
    ],
)
def test_nm_views_of_another_unit_or_corrected_are_refused(
    tmp_path: Path, changes: dict, message: str
):
    """DICOM NM views that are no measured counts, or whose scale is ambiguous, are refused."""
    with pytest.raises(ValueError, match=message):
        read_nm(study(tmp_path / "a.dcm", **changes))


@pytest.mark.parametrize(("value", "limit"), [(0, None), (65535, None), (0, 6)])
def test_padding_of_zero_counts_is_accepted(
    tmp_path: Path, nm: NmStudy, value: int, limit: int | None
):
    """GE's cameras state a PixelPaddingValue of 0, which is also a measured count. Also tried: the
    padding 7, which pixels have and which is refused, and padding of NM volumes.
    """
    changes = {"PixelPaddingValue": value} | ({"PixelPaddingRangeLimit": limit} if limit else {})
    pixels = np.zeros((12, 4, 5), "<u2")
    pixels[:, 1, 2] = 9
    padded = read_nm(study(tmp_path / "a.dcm", PixelData=pixels.tobytes(), **changes))
    assert padded.counts[0].sum() == 9 * 6 and padded.views == nm.views


def test_uniformity_correction_is_accepted(tmp_path: Path, nm: NmStudy):
    neutral = {"ScatterFractionFactor": 0.0, "DecayFactor": 1.0, "DeadTimeCorrected": "NO"}
    corrected = ["UNIF", "COR", "NRGY", "LIN", "MOTN"]
    again = read_nm(study(tmp_path / "a.dcm", CorrectedImage=corrected, **neutral))
    assert all(map(torch.equal, again.counts, nm.counts))


def test_nm_frames_are_refused_as_projections_in_file_order(tmp_path: Path):
    """Frames of DICOM NM, which may be in any order, are refused as projections in their order."""
    with pytest.raises(ValueError, match="to be sorted by its vectors"):
        ImageFiles([study(tmp_path / "a.dcm")])


def turn(**values: object) -> dict:
    """Rotations of the study with other values, None to leave one out."""
    from pydicom.dataset import Dataset

    usual = {"StartAngle": 10.0, "AngularStep": 30.0, "RotationDirection": "CW", "ScanArc": 90.0}
    usual |= {"ActualFrameDuration": 20000, "NumberOfFramesInRotation": 3}
    usual |= {"RadialPosition": [250.0, 251.0, 252.0], **values}
    named = {name: value for name, value in usual.items() if value is not None}
    return {"RotationInformationSequence": [item(Dataset, **named)]}


def heads(**values: object) -> dict:
    """The study's detectors with more values."""
    from pydicom.dataset import Dataset

    items = [item(Dataset, **{"StartAngle": start, **values}) for start in (10.0, 190.0)]
    return {"DetectorInformationSequence": items}


def several(name: str, *values: float) -> dict:
    """An attribute of two detectors, of two rotations, or of the time slots of gated frames."""
    from pydicom.dataset import Dataset

    if name == "ZoomFactor":
        items = heads()["DetectorInformationSequence"]
    elif name == "TimeSlotTime":
        items = [Dataset() for _ in values]
    else:
        items = [turn(StartAngle=None)["RotationInformationSequence"][0] for _ in values]
    for one, value in zip(items, values, strict=True):
        setattr(one, name, value)
    if name == "ZoomFactor":
        return {"DetectorInformationSequence": items}
    if name != "TimeSlotTime":
        return {"RotationInformationSequence": items, "RotationVector": [1] * 12}
    intervals = [item(Dataset, FrameTime=values[0], TimeSlotInformationSequence=items)] * 2
    return {"GatedInformationSequence": [item(Dataset, DataInformationSequence=intervals)]}


def test_detectors_of_several_zooms_are_refused(tmp_path: Path, nm: NmStudy):
    """The file has one pixel size."""
    zoomed = study(tmp_path / "a.dcm", **several("ZoomFactor", [1.45, 1.45], [1.45, 1.45]))
    assert read_nm(zoomed).views == nm.views
    with pytest.raises(ValueError, match="ZoomFactor of all detectors"):
        read_nm(study(tmp_path / "a.dcm", **several("ZoomFactor", [1.0, 1.0], [1.45, 1.45])))


@pytest.mark.parametrize("name", ["TableTraverse", "TableHeight", "TimeSlotTime"])
@pytest.mark.parametrize("last", [400.0, 0.5])
def test_what_changes_within_a_study_is_warned_of_once(tmp_path: Path, name: str, last: float):
    """A table that moves between rotations, which a rig may have, and time slots of several
    durations; one value is read without a warning.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(read_frames(study(tmp_path / "a.dcm", **several(name, 400.0, last))))
    texts = [str(one.message) for one in caught]
    assert len(texts) == (last != 400.0) and all(name in text for text in texts)


@pytest.mark.parametrize(
    ("creator", "group", "element", "kind", "values"),
    [
        ("SIEMENS MED NM", 0x33, 0x38, "FL", {1.0: None, 0.5: "Pixel scale factor"}),
        ("SIEMENS MED NM", 0x55, 0x56, "SS", {0: None, 1: "Decay Corr"}),
        ("SIEMENS MED NM", 0x57, 0x04, "LO", {"NONE": None, "START": "Decay correction"}),
        ("SIEMENS MED NM", 0x57, 0x07, "FL", {1.0: None, 2.0: "Rescale Slope"}),
        ("SIEMENS MED NM", 0x55, 0x72, "SS", {3: None}),  # gains in x
        ("GEMS_GENIE_1", 0x13, 0x15, "FD", {1.0: None, 0.01: "Fscalar"}),
        ("GEMS_GENIE_1", 0x11, 0x1C, "FL", {126.0: None}),  # offset of the energy
        ("PHILIPS NM -Private", 0x7051, 0x04, "FL", {1.5: None}),  # centre of rotation
    ],
)
@pytest.mark.parametrize("implicit", [False, True])
def test_private_attributes_that_may_scale_counts_are_warned_of(
    tmp_path: Path, creator: str, group: int, element: int, kind: str, values: dict, implicit: bool
):
    """By name and creator, in one warning for a study; those of the rig, which the cameras state,
    and values that change nothing are not.
    """
    import pydicom

    for value, name in values.items():
        path = study(tmp_path / "a.dcm")
        dataset = pydicom.dcmread(path)
        dataset.private_block(group, creator, create=True).add_new(element, kind, value)
        if implicit:
            dataset.file_meta.TransferSyntaxUID = pydicom.uid.ImplicitVRLittleEndian
        dataset.save_as(path, implicit_vr=implicit, little_endian=True)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_nm(path)
        texts = [str(one.message) for one in caught]
        assert len(texts) == (name is not None)
        assert all(name in text and creator in text for text in texts)


def shared(**values: object) -> dict:
    from pydicom.dataset import Dataset

    return {"SharedFunctionalGroupsSequence": [item(Dataset, **values)]}


CONTRADICTIONS = {
    "corrections by other names": [
        ({"DecayCorrection": "START"}, "DecayCorrection"),
        ({"AttenuationCorrectionMethod": "CT"}, "AttenuationCorrectionMethod"),
        ({"ScatterCorrectionMethod": "DEW"}, "ScatterCorrectionMethod"),
        ({"DecayCorrected": "YES"}, "DecayCorrected"),
        ({"AttenuationCorrected": "YES"}, "AttenuationCorrected"),
        ({"ScatterCorrected": "YES"}, "ScatterCorrected"),
        ({"DecayFactor": 1.2}, "DecayFactor"),
        ({"ScatterFractionFactor": 0.3}, "ScatterFractionFactor"),
        ({"DoseCalibrationFactor": 40.0}, "DoseCalibrationFactor"),
        ({"SliceSensitivityFactor": 1.1}, "SliceSensitivityFactor"),
        ({"DeadTimeFactor": 1.05}, "DeadTimeFactor"),
        ({"DeadTimeCorrected": "YES"}, "DeadTimeCorrected"),
        ({"RandomsCorrected": "YES"}, "RandomsCorrected"),
        (shared(ScatterFractionFactor=0.3), "ScatterFractionFactor"),
        ({"CorrectedImage": ["UNIF", "DCAL"]}, "CorrectedImage with DCAL"),
        ({"CorrectedImage": ["UNIF", "DTIM"]}, "CorrectedImage with DTIM"),
        ({"CorrectedImage": "CLN"}, "CorrectedImage with CLN"),
        ({"DecayCorrection": "ADMIN"}, "DecayCorrection"),
        ({"DecayCorrectionDateTime": "20260101"}, "DecayCorrectionDateTime"),
        ({"CountLossNormalizationCorrected": "YES"}, "CountLossNormalizationCorrected"),
        ({"SensitivityCalibrated": "YES"}, "SensitivityCalibrated"),
        (shared(CorrectedImage=["ATTN"]), "CorrectedImage"),
    ],
    "another kind of values": [
        ({"CountsSource": "TRANSMISSION"}, "CountsSource"),
        ({"ImageType": ["ORIGINAL", "PRIMARY", "TOMO", "TRANSMISSION"]}, "ImageType"),
        ({"ImageType": ["DERIVED", "PRIMARY", "RECON GATED TOMO", "EMISSION"]}, "ImageType"),
        ({"ImageType": ["ORIGINAL", "PRIMARY", "WHOLE BODY", "EMISSION"]}, "ImageType"),
        ({"ScanVelocity": 2.0}, "ScanVelocity"),
        ({"SUVType": "BW"}, "SUVType"),
        ({"ReconstructionMethod": "OSEM"}, "ReconstructionMethod"),
        ({"BurnedInAnnotation": "YES"}, "BurnedInAnnotation"),
        ({"RescaleType": "HU"}, "RescaleType"),
        (shared(Units="BQML"), "Units"),
        ({"ConcatenationUID": "1.2.3"}, "ConcatenationUID"),
    ],
    "items that no vector numbers": [
        ({"DetectorVector": None, "AngularViewVector": [1] * 12}, "DetectorVector, which numbers"),
        ({"EnergyWindowVector": None}, "EnergyWindowVector, which numbers the 2 items"),
    ],
    "fewer items than a vector numbers": [
        ({"DetectorVector": [1, 3] * 6}, "every view once|DetectorInformationSequence has 2 items"),
    ],
    "angles": [
        (turn(StartAngle=45.0), "StartAngle of RotationInformationSequence in Det"),
        (turn(AngularStep=-30.0), "AngularStep not negative"),
        (turn(ScanArc=200.0), "ScanArc of 90 .*got 200"),
        (turn(NumberOfFramesInRotation=2, ScanArc=None), "NumberOfFramesInRotation 2"),
        (turn(RotationDirection="CCW"), "RotationDirection is CW or CC"),
        (turn(RotationDirection=None), "RotationDirection is CW or CC"),
    ],
    "radii": [
        (turn(RadialPosition=[250.0, 251.0]), "RadialPosition has one finite number or 3"),
        (turn(RadialPosition=[250.0] * 6), "RadialPosition has one finite number or 3"),
        (
            heads(RadialPosition=[240.0, 241.0, 242.0]),
            "RadialPosition of RotationInformationSequence in Det",
        ),
    ],
    "durations and sizes": [
        ({"ActualFrameDuration": 10000}, "ActualFrameDuration of the image"),
        ({"PixelAspectRatio": [1, 1]}, "PixelAspectRatio"),
        (shared(PixelSpacing=[2.0, 2.0]), "one PixelSpacing of frame 0"),
        ({"HighBit": 11}, "HighBit 15"),
        ({"PixelPaddingValue": 7}, "PixelPaddingValue"),
    ],
}


@pytest.mark.parametrize("kind", CONTRADICTIONS)
def test_nm_attributes_that_change_the_counts_or_views_are_refused_by_name(
    tmp_path: Path, kind: str
):
    """What would be read otherwise than it is meant: each names the attribute."""
    for changes, message in CONTRADICTIONS[kind]:
        with pytest.raises(ValueError, match=message):
            read_nm(study(tmp_path / "a.dcm", **changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"ActualFrameDuration": 20000, "ImageType": ["ORIGINAL", "PRIMARY", "TOMO", "EMISSION"]},
        {"DecayCorrection": "NONE", "ScatterCorrected": "NO", "RescaleType": "US"},
        turn(ScanArc=180.0),  # of both heads together
        turn(ScanArc=60.0),  # from the first view to the last
        turn(RadialPosition=None),
        heads(RadialPosition=[250.0, 251.0, 252.0]),
        turn(StartAngle=370.0),
        shared(PixelSpacing=[2.0, 1.5]),
        {"PixelAspectRatio": [4, 3]},
    ],
)
def test_nm_attributes_that_repeat_others_are_accepted(tmp_path: Path, nm: NmStudy, changes: dict):
    again = read_nm(study(tmp_path / "a.dcm", **changes))
    assert all(map(torch.equal, again.counts, nm.counts))
    assert [v.angle_degrees for v in again.views] == [v.angle_degrees for v in nm.views]


def test_radii_of_a_detector_are_its_own(tmp_path: Path):
    """Heads at two distances; the rotation repeats those of the first."""
    from pydicom.dataset import Dataset

    radii = ([250.0, 251.0, 252.0], [260.0, 261.0, 262.0])
    own = [
        item(Dataset, StartAngle=start, RadialPosition=values)
        for start, values in zip((10.0, 190.0), radii, strict=True)
    ]
    read = read_nm(study(tmp_path / "a.dcm", DetectorInformationSequence=own))
    assert [view.radius_mm for view in read.views] == [*radii[0], *radii[1]]
    own[0].RadialPosition, own[1].RadialPosition = 251.0, 260.0  # one of the rotation's, and none
    read = read_nm(study(tmp_path / "b.dcm", DetectorInformationSequence=own))
    assert [view.radius_mm for view in read.views] == [*radii[0], 260.0, 260.0, 260.0]


def test_items_of_a_gate_that_differ_are_refused(tmp_path: Path):
    from pydicom.dataset import Dataset

    gates = [
        item(Dataset, DataInformationSequence=[item(Dataset, FrameTime=time)])
        for time in (125.0, 200.0)
    ]
    vectors = ("RRIntervalVector", "TimeSlotVector")
    with pytest.raises(ValueError, match="GatedInformationSequence, got 2 that differ"):
        list(read_frames(in_time(tmp_path / "a.dcm", vectors, GatedInformationSequence=gates)))
