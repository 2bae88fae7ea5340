"""A CT series is read in the order of its slices in space, or refused with the reason."""

import warnings
from io import BytesIO

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.dicom import AIR, VALUES_DEPEND, open_series
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.rigid import euler_rotation
from tests.data.projections.conftest import dicom_image

COUNT, ROWS, COLUMNS = 7, 5, 6
SPACING = (2.0, 1.5, 3.0)  # columns, rows, slices
SERIES = pydicom.uid.generate_uid()
SCALE = ("Slope", "Intercept")


def hu():
    """Hounsfield units, no two voxels alike, [slice row column]."""
    values = np.arange(COUNT * ROWS * COLUMNS).reshape(COUNT, ROWS, COLUMNS)
    return (values * 7 % 2001 - 1000).astype("i2")


def written(folder, turn=(0.0, 0.0, 0.0), change=None):
    """Files of a series, named in an order that is not that of the slices; `change` alters the tags
    of slice k.
    """
    folder.mkdir(exist_ok=True)
    axes = euler_rotation(list(turn), "xyz").numpy().T  # rows: directions of x, y, z
    for k, values in enumerate(hu()):
        corner = np.array([-10.0, 20.0, 30.0]) + axes[2] * SPACING[2] * k
        tags = {
            "SeriesInstanceUID": SERIES,
            "Modality": "CT",
            "ImagePositionPatient": [float(f"{x:.10g}") for x in corner],
            "ImageOrientationPatient": [float(f"{x:.10g}") for x in axes[:2].ravel()],
            "PixelSpacing": [SPACING[1], SPACING[0]],
            "RescaleSlope": 2 if k % 2 else 1,
            "RescaleIntercept": -1024,
        }
        tags |= change(k, tags) if change else {}
        slope, intercept = tags.get("RescaleSlope") or 1, tags.get("RescaleIntercept") or 0
        stored = np.rint((values - intercept) / slope).astype("i2")
        dicom_image(folder / f"{(k * 3) % COUNT}.dcm", stored, **tags)
    return folder


def world(grid, z, y, x):
    return grid.to_world(torch.tensor([x, y, z], dtype=torch.float64))


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (20.0, -10.0, 5.0), (90.0, 0.0, 0.0)])
def test_voxel_positions_match_simple_itk(turn, tmp_path):
    folder = written(tmp_path / "ct", turn)
    values, grid = read_volume(folder)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    image = reader.Execute()
    assert values.numel() == COUNT * ROWS * COLUMNS and (grid.affine[:3, :3].diag() > 0).all()
    for k, j, i in np.random.default_rng(0).integers(0, (COUNT, ROWS, COLUMNS), (40, 3)).tolist():
        xyz = torch.tensor(image.TransformIndexToPhysicalPoint((i, j, k)))
        place = grid.to_index(xyz.double() * torch.tensor([-1.0, -1.0, 1.0]).double())
        x, y, z = place.round().int().tolist()
        assert torch.allclose(place, place.round(), atol=1e-3)
        assert values[z, y, x].item() == pytest.approx(image.GetPixel((i, j, k)))


@pytest.mark.parametrize("ending", [".mha", ".nrrd"])
def test_a_gap_of_a_series_that_itk_joined_is_refused(ending, tmp_path):
    """SimpleITK spreads the slices over the gap, with a warning and a key in the file that it
    writes. Distances that are rounded are read: to 0.01 mm, also as ITK's key of 0.0001.
    """

    def joined(name, change=None, without=None):
        folder = written(tmp_path / name, change=change)
        if without:
            (folder / without).unlink()
        reader = sitk.ImageSeriesReader()
        reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
        sitk.WriteImage(reader.Execute(), str(file := tmp_path / f"{name}{ending}"))
        return file

    def rounded(k, tags):
        x, y, z = tags["ImagePositionPatient"]
        return {"ImagePositionPatient": [x, y, z + 0.01 * (k % 2)]}

    for name, change in (("even", None), ("rounded", rounded)):
        values, grid = read_volume(joined(name, change))
        assert values.numel() == hu().size and grid.spacing[2] == pytest.approx(3, abs=0.01)
    with pytest.raises(Refused, match="got ITK_non_uniform_sampling_deviation .* were missing"):
        read_volume(joined("gap", without="2.dcm"))


def test_a_link_to_a_slice_that_was_not_fetched_is_refused(tmp_path):
    """The last one leaves no gap. Hidden links, as of an editor, are none of the series."""
    written(tmp_path)
    (tmp_path / ".#lock").symlink_to("somebody@elsewhere")
    shape = read_volume(tmp_path)[0].shape
    last = sorted(tmp_path.glob("[!.]*"))[-1]
    last.rename(tmp_path.parent / "last")
    last.symlink_to(tmp_path.parent / "last")
    assert read_volume(tmp_path)[0].shape == shape
    (tmp_path.parent / "last").unlink()
    with pytest.raises(FileNotFoundError, match="is a link to .*, which is not there"):
        read_volume(tmp_path)


def test_slope_and_intercept_are_per_slice(tmp_path):
    values, _ = read_volume(written(tmp_path / "ct"))
    expected = torch.from_numpy(hu()[:, ::-1, ::-1].astype("f4"))  # LPS to RAS: x and y reversed
    odd = expected[1::2]
    assert torch.equal(values[::2], expected[::2])
    assert (values[1::2] - odd).abs().max() <= 1  # a slope of 2 keeps every second number


def group(**macros):
    """A functional group of an enhanced image: sequences of one item, by their names."""
    item = pydicom.Dataset()
    for sequence, values in macros.items():
        one = pydicom.Dataset()
        for name, value in values.items():
            setattr(one, name, value)
        setattr(item, f"{sequence}Sequence", [one])
    return item


def enhanced(folder, plain):
    """The slices of a plain series as frames of one file, in an order that is not theirs."""
    slices = [pydicom.dcmread(file) for file in sorted(plain.iterdir())]
    frames = [
        group(
            PlanePosition={"ImagePositionPatient": item.ImagePositionPatient},
            PixelValueTransformation={
                "RescaleSlope": item.RescaleSlope,
                "RescaleIntercept": item.RescaleIntercept,
            },
        )
        for item in slices
    ]
    shared = group(
        PlaneOrientation={"ImageOrientationPatient": slices[0].ImageOrientationPatient},
        PixelMeasures={"PixelSpacing": slices[0].PixelSpacing},
    )
    folder.mkdir()
    tags = {"Modality": "CT", "SeriesInstanceUID": SERIES}
    groups = {
        "PerFrameFunctionalGroupsSequence": frames,
        "SharedFunctionalGroupsSequence": [shared],
    }
    pixels = np.stack([item.pixel_array for item in slices])
    dicom_image(folder / "all.dcm", pixels, **tags, **groups)
    return folder


@pytest.mark.parametrize("name", ["", "all.dcm"])
def test_frames_of_an_enhanced_image_are_the_slices_of_a_series(name, tmp_path):
    plain = written(tmp_path / "plain", turn=(20.0, -10.0, 5.0))
    (values, grid), (expected, there) = map(
        read_volume, (enhanced(tmp_path / "frames", plain) / name, plain)
    )
    assert torch.equal(values, expected) and torch.equal(grid.affine, there.affine)


def parts(folder, file, splits, **changed):
    """The parts of a concatenation: the frames of an enhanced image up to and from `splits`."""
    whole = pydicom.dcmread(file)
    pixels, frames = whole.pixel_array, whole.PerFrameFunctionalGroupsSequence
    ends, uid = [0, *splits, len(frames)], pydicom.uid.generate_uid()
    folder.mkdir()
    for number, (first, last) in enumerate(zip(ends, ends[1:], strict=False), 1):
        tags = {"ConcatenationUID": uid, "InConcatenationNumber": number}
        tags |= {"InConcatenationTotalNumber": len(splits) + 1} | changed
        groups = {
            "PerFrameFunctionalGroupsSequence": frames[first:last],
            "SharedFunctionalGroupsSequence": whole.SharedFunctionalGroupsSequence,
        }
        kept = {name: value for name, value in tags.items() if value is not None}
        tags = {"Modality": "CT", "SeriesInstanceUID": SERIES, **kept, **groups}
        dicom_image(folder / f"{number}.dcm", pixels[first:last], **tags)
    return folder


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("TemporalPositionIdentifier", (1, 2)),
        ("StackID", ("1", "2")),
        ("KVP", (80, 140)),
        ("ConvolutionKernel", ("B30f", "B70f")),
    ],
)
def test_slices_of_several_times_or_kinds_of_values(name, values, tmp_path):
    """Refused where they are of several volumes, warned of where their values may differ."""
    read_volume(written(tmp_path / "one", change=lambda k, tags: {name: values[0]}))
    folder = written(tmp_path / "two", change=lambda k, tags: {name: values[k % 2]})
    match = f"expected one {name} of all slices, got .*{values[0]}.* and .*{values[1]}"
    warned = name in VALUES_DEPEND
    with pytest.warns(UserWarning, match=match) if warned else pytest.raises(Refused, match=match):
        read_volume(folder)


LOST = {
    "the first": ((1, 2), [1], {}, "all 3 parts .*, got 2, 3; put"),
    "one between": ((1, 2), [2], {}, "all 3 parts .*, got 1, 3; put"),
    "the last": ((1, 2), [3], {}, "all 3 parts .*, got 1, 2; put"),
    "all but one": ((2,), [2], {}, "all 2 parts .*, got 1; put"),
    "one without a UID": ((2,), [2], {"ConcatenationUID": None}, "all 2 parts .*, got 1; put"),
    "unknown": ((2,), [], {"InConcatenationTotalNumber": None}, "InConcatenationTotalNumber"),
}


@pytest.mark.parametrize("lost", LOST)
def test_a_concatenation_is_one_volume_of_all_its_parts(lost, tmp_path):
    """A part alone would be a volume that is cut; a gap between parts was found already."""
    plain = written(tmp_path / "plain")
    file = enhanced(tmp_path / "frames", plain) / "all.dcm"
    splits, gone, changed, message = LOST[lost]
    found, _ = read_volume(parts(tmp_path / "all", file, splits))
    assert torch.equal(found, read_volume(plain)[0])
    folder = parts(tmp_path / "parts", file, splits, **changed)
    for number in gone:
        (folder / f"{number}.dcm").unlink()
    with pytest.raises(Refused, match=message):
        read_volume(folder)


def test_slices_of_a_tilted_gantry_are_shifted_to_their_places(tmp_path):
    """Values that rise linearly in space are the same at every place, exact for linear steps."""
    slope, lean = torch.tensor([3.0, -5.0, 7.0], dtype=torch.float64), np.array([0.7, -0.9, 3.0])

    def change(k, tags):
        return {
            "ImagePositionPatient": (np.array([-10.0, 20.0, 30.0]) + lean * k).tolist(),
            "RescaleSlope": 1,
            "RescaleIntercept": -1024,
        }

    folder = written(tmp_path / "ct", change=change)
    for file in folder.iterdir():
        dataset = pydicom.dcmread(file)
        x, y, z = dataset.ImagePositionPatient
        lps = (x + 2.0 * np.arange(COLUMNS), y + 1.5 * np.arange(ROWS)[:, None], z)
        plane = -3.0 * lps[0] + 5.0 * lps[1] + 7.0 * lps[2]
        dataset.PixelData = np.rint(plane * 10).astype("i2").tobytes()
        dataset.RescaleSlope, dataset.RescaleIntercept = 0.1, 0
        dataset.save_as(file)
    values, grid = read_volume(folder, resample=True)
    inside = values != AIR
    for z, y, x in inside.nonzero().tolist():
        expected = (world(grid, z, y, x) * slope).sum().item()
        assert values[z, y, x].item() == pytest.approx(expected, abs=0.11)
    assert COUNT * (ROWS - 1) * (COLUMNS - 1) <= int(inside.sum()) <= COUNT * ROWS * COLUMNS


def test_frames_without_a_position_are_refused(tmp_path):
    """An image of several frames whose functional groups are missing or too few is refused."""
    file = enhanced(tmp_path / "frames", written(tmp_path / "plain")) / "all.dcm"
    dataset = pydicom.dcmread(file)
    del dataset.PerFrameFunctionalGroupsSequence[-1]
    dataset.save_as(file)
    with pytest.raises(Refused, match="7 with 6 groups"):
        read_volume(file.parent)
    del dataset.PerFrameFunctionalGroupsSequence
    dataset.save_as(file)
    with pytest.raises(Refused, match="an image of several frames"):
        read_volume(file.parent)


FRAMES = {
    "a unit of the last frame": (
        lambda image, own, shared: setattr(
            own[-1].PixelValueTransformationSequence[0], "RescaleType", "HU_MOD"
        ),
        "frame 6: expected RescaleType HU or US, got 'HU_MOD'",
    ),
    "a slope of the image": (
        lambda image, own, shared: setattr(image, "RescaleSlope", 1),
        "one RescaleSlope of frame",
    ),
    "a position of the image": (
        lambda image, own, shared: setattr(image, "ImagePositionPatient", [0, 0, 0]),
        "one ImagePositionPatient of frame",
    ),
    "a pixel size of a frame": (
        lambda image, own, shared: setattr(
            own[2],
            "PixelMeasuresSequence",
            group(PixelMeasures={"PixelSpacing": [1.5, 2.1]}).PixelMeasuresSequence,
        ),
        "one PixelSpacing of frame 2 .* of the shared functional groups and .* of frame 2",
    ),
    "a direction of a frame": (
        lambda image, own, shared: setattr(own[2], "ImageOrientationPatient", [0, 1, 0, 1, 0, 0]),
        "one ImageOrientationPatient of frame 2",
    ),
    "two shared groups": (
        lambda image, own, shared: shared.append(group(PixelMeasures={"PixelSpacing": [2, 2]})),
        "one PixelSpacing of frame 0",
    ),
    "no slope of one frame": (
        lambda image, own, shared: delattr(
            own[3].PixelValueTransformationSequence[0], "RescaleSlope"
        ),
        "RescaleSlope of every frame or of none, got it of 6 of 7",
    ),
    **{
        f"two values of {name}": (
            lambda image, own, shared, name=name, values=values: [
                setattr(frame, name, values[k % 2]) for k, frame in enumerate(own)
            ],
            f"one {name} of all frames",
        )
        for name, values in {
            "StackID": ("1", "2"),
            "TemporalPositionIndex": (1, 2),
            "FrameType": (["ORIGINAL", "VMI"], ["ORIGINAL", "NONE"]),
        }.items()
    },
    "the greatest of several slices": (
        lambda image, own, shared: setattr(image, "VolumeBasedCalculationTechnique", "MAX_IP"),
        "expected VolumeBasedCalculationTechnique NONE or MPR, got 'MAX_IP'",
    ),
    "a curved slice": (
        lambda image, own, shared: setattr(own[2], "VolumetricProperties", "DISTORTED"),
        "frame 2: expected VolumetricProperties VOLUME or SAMPLED or MIXED, got 'DISTORTED'",
    ),
    "a look-up table of a frame": (
        lambda image, own, shared: setattr(own[3], "ModalityLUTSequence", [pydicom.Dataset()]),
        "frame 3: expected no ModalityLUTSequence",
    ),
    "another unit of the values": (
        lambda image, own, shared: setattr(shared[0], "Units", "BQML"),
        "Hounsfield units by Units .* got BQML",
    ),
    "a mapping of a frame": (
        lambda image, own, shared: setattr(
            own[3],
            "RealWorldValueMappingSequence",
            group(
                RealWorldValueMapping={"RealWorldValueSlope": 9.0, "RealWorldValueIntercept": 0.0}
            ).RealWorldValueMappingSequence,
        ),
        "RealWorldValueMappingSequence of every frame or of none",
    ),
}


@pytest.mark.parametrize("case", FRAMES)
def test_frames_that_contradict_the_image_or_each_other_are_refused_by_name(case, tmp_path):
    change, message = FRAMES[case]
    file = enhanced(tmp_path / "frames", written(tmp_path / "plain")) / "all.dcm"
    image = pydicom.dcmread(file)
    own, shared = image.PerFrameFunctionalGroupsSequence, image.SharedFunctionalGroupsSequence
    change(image, own, shared)
    image.save_as(file)
    with pytest.raises(Refused, match=message):
        read_volume(file.parent)


def test_real_world_values_take_the_place_of_a_slope(tmp_path):
    """Of each frame its own, in Hounsfield units. Without either, values are refused."""
    file = enhanced(tmp_path / "frames", written(tmp_path / "plain")) / "all.dcm"
    expected, _ = read_volume(file.parent)
    image = pydicom.dcmread(file)
    for own in image.PerFrameFunctionalGroupsSequence:
        (scale,) = own.PixelValueTransformationSequence
        names = {f"RealWorldValue{end}": float(scale[f"Rescale{end}"].value) for end in SCALE}
        own.update(group(RealWorldValueMapping=names))
        del own.PixelValueTransformationSequence
    image.save_as(file)
    assert torch.equal(read_volume(file.parent)[0], expected)
    for own in image.PerFrameFunctionalGroupsSequence:
        del own.RealWorldValueMappingSequence
    image.save_as(file)
    with pytest.raises(Refused, match="expected a finite RescaleSlope"):
        read_volume(file.parent)


def test_padding_of_a_frame_is_its_own(tmp_path):
    """Padding of frame 2 alone would be air there; of some frames alone it is refused."""
    file = enhanced(tmp_path / "frames", written(tmp_path / "plain")) / "all.dcm"
    expected, _ = read_volume(file.parent)
    image = pydicom.dcmread(file)
    for k, own in enumerate(image.PerFrameFunctionalGroupsSequence):
        one = pydicom.Dataset()
        one.PixelPaddingValue = int(image.pixel_array[k, 1, 2]) if k == 2 else -32768
        own.UnassignedPerFrameConvertedAttributesSequence = [one]
    image.save_as(file)
    values, _ = read_volume(file.parent)
    changed = (values != expected).nonzero()
    assert len(changed) == 1 and values[tuple(changed[0])] == AIR
    del image.PerFrameFunctionalGroupsSequence[0].UnassignedPerFrameConvertedAttributesSequence
    image.save_as(file)
    with pytest.raises(Refused, match="PixelPaddingValue of every frame or of none"):
        read_volume(file.parent)


@pytest.mark.parametrize("code", ["RLE", "JPEG"])
def test_a_compressed_series_is_read_like_an_uncompressed_one(code, tmp_path):
    plain, packed = written(tmp_path / "plain"), tmp_path / "packed"
    packed.mkdir()
    for file in plain.iterdir():
        dataset = pydicom.dcmread(file)
        dataset.PixelRepresentation = 0
        if code == "RLE":
            dataset.compress(pydicom.uid.RLELossless)
        else:
            stored = sitk.GetImageFromArray(dataset.pixel_array.astype("u2")[None])
            writer = sitk.ImageFileWriter()
            writer.SetFileName(str(tmp_path / "one.dcm"))
            writer.UseCompressionOn()
            writer.SetCompressor("JPEG")
            writer.Execute(stored)
            jpeg = pydicom.dcmread(tmp_path / "one.dcm")
            dataset.PixelData = jpeg.PixelData
            dataset.file_meta.TransferSyntaxUID = jpeg.file_meta.TransferSyntaxUID
        dataset.save_as(packed / file.name)
    assert torch.equal(read_volume(packed)[0], read_volume(plain)[0])


def lifted(k, tags, mm):
    x, y, z = tags["ImagePositionPatient"]
    return {"ImagePositionPatient": [x, y, z + mm]}


def test_padding_above_air_becomes_air(tmp_path):
    """All voxels from 200 HU on are padding; and those at -1000 HU and below, which stay."""
    plain, _ = read_volume(written(tmp_path / "plain"))

    def padding(first, last):
        def change(k, tags):
            stored = [(hu + 1024) // (2 if k % 2 else 1) for hu in (first, last)]
            return dict(zip(("PixelPaddingValue", "PixelPaddingRangeLimit"), stored, strict=True))

        return change

    values, _ = read_volume(written(tmp_path / "above", change=padding(200, 3000)))
    assert (plain >= 200).any() and (plain < 199).any()
    assert torch.equal(values, torch.where(plain >= 200, torch.tensor(AIR), plain))
    values, _ = read_volume(written(tmp_path / "below", change=padding(-1000, -2000)))
    assert (plain <= -1000).any() and torch.equal(values, plain)


BROKEN = {
    "a gap": (
        lambda k, tags: lifted(k, tags, 3.0 if k > 3 else 0.0),
        "slices 3 mm apart, got 6 mm between .* is a slice missing",
    ),
    "one place twice": (
        lambda k, tags: lifted(k, tags, -3.0 if k == 4 else 0.0),
        "every slice at its own place, got .* at one",
    ),
    "a tilted gantry": (
        lambda k, tags: {"ImagePositionPatient": [-10.0, 20.0 + 0.6 * k, 30.0 + 3 * k]},
        r"a gantry tilt of 11\.3 degrees; resample",
    ),
    "two series": (
        lambda k, tags: {"SeriesInstanceUID": SERIES if k < 4 else f"{SERIES[:-3]}.42"},
        rf"expected one series, got 2: .*{SERIES[:20]}.*, .*; put each",
    ),
    "another unit than HU": (
        lambda k, tags: {"RescaleType": "HU_MOD"},
        "expected RescaleType HU or US, got 'HU_MOD'",
    ),
    "a look-up table": (
        lambda k, tags: {"ModalityLUTSequence": [pydicom.Dataset()]},
        "expected no ModalityLUTSequence",
    ),
    "another modality": (lambda k, tags: {"Modality": "MR"}, "modality CT, got 'MR'"),
    "two sizes of pixels": (
        lambda k, tags: {"PixelSpacing": [1.5, 2.0 + 0.1 * (k == 5)]},
        r"expected \(5, 6\) pixels of \(1\.5, 2\.\d\) mm",
    ),
    "no intercept": (
        lambda k, tags: {"RescaleIntercept": None},
        "a finite RescaleIntercept of .*got None",
    ),
    "two frames of reference": (
        lambda k, tags: {"FrameOfReferenceUID": f"1.2.{k // 4}"},
        "one FrameOfReferenceUID.*got 2",
    ),
    "pixels of another shape": (
        lambda k, tags: {"PixelAspectRatio": [3, 1] if k == 5 else [3, 4]},
        "PixelAspectRatio .* of 0.75 .* got 3 to 1",
    ),
    "an overlay within the values": (
        lambda k, tags: {"BitsStored": 12, "HighBit": 12},
        "HighBit 11, one less than BitsStored, got 12",
    ),
    "no series": (lambda k, tags: {"SeriesInstanceUID": ""}, "with SeriesInstanceUID, got none"),
    "no place": (
        lambda k, tags: {"ImagePositionPatient": None},
        "expected ImagePositionPatient as 3 finite numbers, got None",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_series_that_is_not_a_volume_is_refused(name, tmp_path):
    """A DICOM series with gaps, doubled or tilted slices, of several series, sizes or another
    modality is refused with the reason.
    """
    change, message = BROKEN[name]
    with pytest.raises(Refused, match=message):
        open_series(written(tmp_path / "ct", change=change))


@pytest.mark.parametrize(
    ("step", "digits", "gone"),
    [(0.75, 1, None), (1.25, 1, None), (0.625, 2, None), (0.75, 1, 3), (1.25, 1, 1), (0.3, 1, 3)],
)
def test_places_rounded_to_a_decimal_are_of_slices_in_equal_steps(step, digits, gone, tmp_path):
    """Some scanners round positions to 0.1 mm: steps of 0.7 and 0.8 mm are those of 0.75 mm. A
    missing slice is reported all the same. Also tried: one slice 0.2 mm off its place.
    """

    def places(k, tags):
        k += gone is not None and k >= gone
        return {"ImagePositionPatient": [0.0, 0.0, round(k * step, digits)]}

    def moved(k, tags):
        z = places(k, tags)["ImagePositionPatient"][2]
        return {"ImagePositionPatient": [0.0, 0.0, round(z + 0.2 * (k == 3), digits)]}

    folder = written(tmp_path / "ct", change=places)
    if gone is None:
        _, grid = open_series(folder)
        assert grid.spacing[2] == pytest.approx(step, abs=10**-digits / (COUNT - 1))
        folder = written(tmp_path / "ct", change=moved)
    with pytest.raises(Refused, match="is a slice missing"):
        open_series(folder)


def test_a_missing_or_truncated_slice_is_reported(tmp_path):
    """A folder without DICOM, a single slice, a missing one and a truncated one are reported as
    such.
    """
    with pytest.raises(FileNotFoundError, match="no such folder; expected one with a DICOM CT"):
        open_series(tmp_path / "nowhere")
    with pytest.raises(
        FileNotFoundError, match="expected the files of a DICOM CT series, got none"
    ):
        open_series(tmp_path)
    folder = written(tmp_path / "ct")
    raw = (folder / "5.dcm").read_bytes()
    (folder / "5.dcm").write_bytes(raw[:-20])
    with pytest.raises(Refused, match=r"5\.dcm: has pixels that cannot be read"):
        read_volume(folder)
    (folder / "5.dcm").write_bytes(raw[:90])
    with pytest.raises(Refused, match=r"5\.dcm: cannot be read as DICOM"):
        read_volume(folder)
    (folder / "5.dcm").unlink()
    with pytest.raises(Refused, match="got 6 mm between .* is a slice missing"):
        read_volume(folder)
    for k in range(1, COUNT):
        (folder / f"{k}.dcm").unlink(missing_ok=True)
    with pytest.raises(Refused, match="at least two slices of a series, got one"):
        read_volume(folder)


def bare(raw, form):
    """A DICOM file without its first 132 bytes, or without its file meta information as well."""
    if form == "meta":
        return raw[132:]
    out, dataset = BytesIO(), pydicom.Dataset(pydicom.dcmread(BytesIO(raw)))
    dataset.save_as(out, implicit_vr=form == "implicit", little_endian=True)
    return out.getvalue()


def test_a_file_named_as_a_slice_that_is_not_dicom_is_reported(tmp_path):
    """A last slice of which nothing is left leaves no gap; other files are no slices."""
    folder = written(tmp_path / "ct")
    for path in sorted(folder.iterdir()):
        path.rename(path.with_suffix(""))
    (folder / "notes.txt").write_text("no slice")
    (folder / ".hidden").write_text("no slice")
    with warnings.catch_warnings(action="error"):
        assert read_volume(folder)[0].shape[0] == COUNT
    for name, raw in (("4", b""), ("1.2.840.7", b"no DICOM")):  # slice 6 of 7, and one more
        (folder / name).write_bytes(raw)
    with pytest.warns(UserWarning, match="skipped 2 files that are not DICOM, such as 1.2.840.7"):
        assert read_volume(folder)[0].shape[0] == COUNT - 1


@pytest.mark.parametrize("form", ["meta", "explicit", "implicit"])
@pytest.mark.parametrize("ending", [".dcm", ""])
def test_dicom_without_its_first_bytes_is_recognised_by_its_first_elements(form, ending, tmp_path):
    """Files of older archives: without preamble, or without file meta information. Compressed
    pixels, whose coding only that states, and other files with such bytes are refused.
    """
    folder = written(tmp_path / "ct")
    expected, grid = read_volume(folder)
    for path in sorted(folder.iterdir()):
        raw = bare(path.read_bytes(), form)
        path.unlink()
        path.with_suffix(ending).write_bytes(raw)
    values, there = read_volume(folder)
    assert torch.equal(values, expected) and torch.equal(there.affine, grid.affine)
    (folder / f"x{ending}").write_bytes(b"\x08\0\x05\0CS\x0a\0ISO_IR 100" + bytes(200))
    with pytest.raises(Refused, match="DICOM"):
        read_volume(folder)


def test_objects_of_other_kinds_beside_a_series_are_skipped_with_their_names(tmp_path):
    """Structures, doses, reports, images of PET, a capture of CT and a localizer; not a slice of
    another modality in the same series. Also tried: DICOMDIR.
    """
    folder = written(tmp_path / "ct")
    expected, _ = read_volume(folder)
    image = hu()[0]
    dicom_image(folder / "d.dcm", image, Modality="RTDOSE", SeriesInstanceUID="1.2.1")
    dicom_image(folder / "p.dcm", image, Modality="PT", SeriesInstanceUID="1.2.2")
    dicom_image(folder / "s.dcm", image, Modality="RTSTRUCT", SeriesInstanceUID="1.2.3", Rows=0)
    dicom_image(
        folder / "c.dcm",
        image,
        Modality="CT",
        SeriesInstanceUID="1.2.4",
        SOPClassUID=pydicom.uid.SecondaryCaptureImageStorage,
    )
    dicom_image(
        folder / "l.dcm",
        image,
        Modality="CT",
        SeriesInstanceUID="1.2.5",
        ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"],
    )
    with pytest.warns(UserWarning, match="skipped 5 files .*: CT, PT, RTDOSE, RTSTRUCT, such as c"):
        assert torch.equal(read_volume(folder)[0], expected)
    dicom_image(folder / "m.dcm", image, Modality="MR", SeriesInstanceUID=SERIES)
    with pytest.raises(Refused, match="modality CT, got 'MR'"), pytest.warns(UserWarning):
        read_volume(folder)
