"""Headers of MetaImage and NRRD as ITK's readers split them: every key is read as ITK reads it, or
the file is refused by the key's name.
"""

import gzip
import warnings
import zlib

import numpy as np
import pytest
import SimpleITK as sitk

from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import read_volume
from tests.data.test_file_keys import LPS, META, NRRD, VALUES, expected, nrrd, places

RAW = VALUES.tobytes()
ZIPPED = zlib.compress(RAW)
PLACED = expected(signs=LPS)


def meta(path, *lines, raw=RAW, data="LOCAL", end="\n", **keys):
    """A MetaImage of `META`, changed by keys ("" removes one), with more lines before DimSize."""
    stated = {**META, **keys}
    head = [f"{k} = {v}" for k, v in stated.items() if v and k not in ("DimSize", "ElementType")]
    tail = [f"{k} = {stated[k]}" for k in ("DimSize", "ElementType") if stated[k]]
    text = end.join([*head, *lines, *tail, f"ElementDataFile = {data}", ""])
    path.write_bytes(text.encode() + (raw if data.lower() == "local" else b""))
    if data.lower() != "local":
        beside = path.parent / data.partition(" ")[0].replace("%d", "1")
        beside.parent.mkdir(exist_ok=True)
        beside.write_bytes(raw)
    return path


ZIP = {"CompressedData": "True", "CompressedDataSize": str(len(ZIPPED)), "raw": ZIPPED}
FOUR = {
    "NDims": "4",
    "ElementSpacing": "1 2 3 7",
    "Offset": "10 20 30 40",
    "TransformMatrix": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
    "CenterOfRotation": "0 0 0 0",
}
READ = {
    "colons": (["DistanceUnits : cm"], {}, expected((100, 200, 300), (10, 20, 30), LPS)),
    "colon and sign": (["DistanceUnits := cm"], {}, expected((100, 200, 300), (10, 20, 30), LPS)),
    "two signs": (
        ["DistanceUnits == um"],
        {"ElementSpacing": "1e3 2e3 3e3", "Offset": "1e4 2e4 3e4"},
        PLACED,
    ),
    "blank lines and ends": (["", "  Name = a: b = c"], {"end": "\r\n"}, PLACED),
    "an empty comment": (["Comment ="], {}, PLACED),
    "metadata of other formats": (["scl_slope = 2", "0028|1053 = 2", "qoffset_x = 7"], {}, PLACED),
    "an identity": (["RescaleSlope = 1", "RescaleIntercept = 0"], {}, PLACED),
    "no turn": (["EulerAngles = 0 0 0", "RotateX = 0.0 0.0", "PatientPosition = HFS"], {}, PLACED),
    "another object": (["TransformType = Rigid", "ObjectSubType = CT"], {}, PLACED),
    "local": ([], {"data": "local"}, PLACED),
    "T": ([], {"BinaryData": "T", "BinaryDataByteOrderMSB": "F"}, PLACED),
    "1": ([], {"BinaryData": "1", "BinaryDataByteOrderMSB": "0"}, PLACED),
    "Orientation": ([], {"TransformMatrix": "", "Orientation": "1 0 0 0 1 0 0 0 1"}, PLACED),
    "ElementOrigin": (["ElementOrigin = 10 20 30.0"], {}, PLACED),
    "ImagePosition": (["ImagePosition = 10 20 30"], {"Offset": ""}, PLACED),
    "ElementSize": (["ElementSize = 1.0 2.0 3.0"], {}, PLACED),
    "ElementSize as a filler": (["ElementSize = 1 1 1"], {}, PLACED),
    "twice": (["ElementSpacing = 1 2 3"], {}, PLACED),
    "axes from": (["AnatomicalOrientation = RAI"], {}, PLACED),
    "axes towards": (["AnatomicalOrientation = LPS"], {}, PLACED),
    "unknown axes": (["AnatomicalOrientation = ???"], {}, PLACED),
    "ElementNBits": (["ElementNBits = 32"], {}, PLACED),
    "a turn": (
        [],
        {"TransformMatrix": "-1 0 0 0 -1 0 0 0 1"},
        expected((-10, -20, 30)),
    ),
    "a fourth axis of one": ([], {**FOUR, "DimSize": "4 3 2 1"}, PLACED),
    "below": ([], {"data": "./in/a.raw"}, PLACED),
    "compressed": ([], ZIP, PLACED),
    "compressed, 1": ([], {**ZIP, "CompressedData": "1"}, PLACED),
    "compressed beside": ([], {**ZIP, "data": "a.zraw"}, PLACED),
    "compressed beside, no size": ([], {**ZIP, "CompressedDataSize": "", "data": "a.zraw"}, PLACED),
    "gzip": (
        [],
        {**ZIP, "raw": gzip.compress(RAW), "CompressedDataSize": str(len(gzip.compress(RAW)))},
        PLACED,
    ),
    "compressed, a header first": (
        ["HeaderSize = 8"],
        {**ZIP, "data": "a.zraw", "raw": bytes(8) + ZIPPED},
        PLACED,
    ),
}


@pytest.mark.parametrize("case", READ)
def test_a_metaimage_is_read_as_itk_reads_it(case, tmp_path):
    """Separators, line ends, repeated keys and other names of a key, as MetaIO reads them."""
    lines, keys, wanted = READ[case]
    assert places(meta(tmp_path / "a.mha", *lines, **keys)) == wanted


REFUSED = {
    "a slope after a colon": (
        "ElementToIntensityFunctionSlope",
        ["ElementToIntensityFunctionSlope : 2"],
        {},
    ),
    "an offset after a colon": (
        "ElementToIntensityFunctionOffset",
        ["ElementToIntensityFunctionOffset:5"],
        {},
    ),
    "an unknown unit after a colon": ("DistanceUnits", ["DistanceUnits : inch"], {}),
    "lower case": ("ElementSpacing", ["elementspacing = 2 2 2"], {"ElementSpacing": ""}),
    "a blank inside": ("DistanceUnits", ["Distance Units = cm"], {}),
    "an underscore inside": ("ElementSpacing", ["Element_Spacing = 2 2 2"], {}),
    "upper case": ("HeaderSize", ["HEADERSIZE = 8"], {"data": "a.raw", "raw": bytes(8) + RAW}),
    "an unknown slope": ("RescaleSlope", ["RescaleSlope = 2"], {}),
    "an unknown spacing": ("PixelSpacing", ["PixelSpacing = 2 2"], {}),
    "an unknown unit": ("Units", ["Units = cm"], {}),
    "two spacings": ("ElementSpacing", ["ElementSpacing = 1 2 4"], {}),
    "two units": ("DistanceUnits", ["DistanceUnits = mm", "DistanceUnits = cm"], {}),
    "a size of 0": ("ElementSize", ["ElementSize = 0 2 3"], {"ElementSpacing": ""}),
    "two sizes": ("ElementSize", ["ElementSize = 1 2 3", "ElementSize = 1 2 4"], {}),
    "ImagePosition": ("ImagePosition", ["ImagePosition = 1 2 4"], {}),
    "ElementOrigin": ("ElementOrigin", ["ElementOrigin = 1 2 4"], {}),
    "ElementOrigin alone": ("ElementOrigin", ["ElementOrigin = 1 2 4"], {"Offset": ""}),
    "ElementDirection": ("ElementDirection", ["ElementDirection = 0 1 0 1 0 0 0 0 1"], {}),
    "a scaled matrix": ("TransformMatrix", [], {"TransformMatrix": "2 0 0 0 1 0 0 0 1"}),
    "a short matrix": ("TransformMatrix", [], {"TransformMatrix": "1 0 0 1"}),
    "one spacing": ("ElementSpacing", [], {"ElementSpacing": "1"}),
    "four spacings": ("ElementSpacing", [], {"ElementSpacing": "1 2 3 4"}),
    "a spacing on the next line": ("'3'", ["3"], {"ElementSpacing": "1 2"}),
    "no spacing": ("ElementSpacing", ["ElementSpacing ="], {"ElementSpacing": ""}),
    "a spacing with a unit": ("ElementSpacing", [], {"ElementSpacing": "1mm 2mm 3mm"}),
    "a decimal comma": ("ElementSpacing", [], {"ElementSpacing": "1,5 2 3"}),
    "a spacing of nan": ("ElementSpacing", [], {"ElementSpacing": "nan 2 3"}),
    "a spacing of 0": ("ElementSpacing", [], {"ElementSpacing": "0 2 3"}),
    "an infinite offset": ("Offset", [], {"Offset": "inf 2 3"}),
    "a huge offset": ("Offset", [], {"Offset": "1e999 2 3"}),
    "four axes": ("three axes", [], {**FOUR, "DimSize": "4 3 1 2"}),
    "a mixed fourth axis": (
        "TransformMatrix",
        [],
        {**FOUR, "DimSize": "4 3 2 1", "TransformMatrix": "1 0 0 0 0 1 0 0 0 0 0 1 0 0 1 0"},
    ),
    "six axes": ("three axes", [], {"NDims": "6"}),
    "a fourth size": ("DimSize", [], {"DimSize": "4 3 2 7"}),
    "a size too few": ("DimSize", [], {"DimSize": "4 3"}),
    "two dimensions": ("2 finite numbers for DimSize", [], {"NDims": "2"}),
    "one dimension": ("NDims", [], {"NDims": "1"}),
    "no binary data": ("BinaryData", [], {"BinaryData": "Yes"}),
    "an unknown byte order": ("BinaryDataByteOrderMSB", [], {"BinaryDataByteOrderMSB": "Little"}),
    "two byte orders": ("ElementByteOrderMSB", ["ElementByteOrderMSB = T"], {}),
    "bits of another type": ("ElementNBits", ["ElementNBits = 16"], {}),
    "an unknown type": ("ElementType", [], {"ElementType": "MET_HALF"}),
    "an array": ("ElementType", [], {"ElementType": "MET_FLOAT_ARRAY"}),
    **{
        f"an unknown {line}": (line.partition(" ")[0], [line], {})
        for line in ("Unit = m", "VoxelSize = 9 9 9", "PixelSize = 9 9 9", "DataOffset = 4")
    },
    **{
        f"another {line}": (line.partition(" ")[0], [line], {})
        for line in ("Multiplier = 2", "Bias = 5", "Skip = 4", "Endianness = big", "FlipX = 1")
    },
    **{
        f"a turn by {line}": (line.partition(" ")[0], [line], {})
        for line in (
            *("EulerAngles = 0 0 30", "RotationAngle = 30", "Euler1 = 0.5", "GantryTilt = 5"),
            *("DirectionCosines = 0 1 0 1 0 0 0 0 1", "ImageOrientationPatient = 1 0 0 0 1 0"),
            *("Transform = 0 1 0 1 0 0 0 0 1", "AffineMatrix = 1", "Quaternion = 1 0 0 0"),
            *("Translation = 1 2 3", "VolumeOrigin = 1 2 3", "ImagePositionPatient = 1 2 3"),
            *("SwappedAxes = xz", "Order = zyx"),
        )
    },
    "a line without a sign": ("no sign", ["no sign"], {}),
    "a list": ("ElementDataFile", [], {"data": "LIST"}),
    "a pattern": ("ElementDataFile", [], {"data": "a%d.raw 1 2 1"}),
    "axes by name alone": (
        "AnatomicalOrientation",
        ["AnatomicalOrientation = ASL"],
        {"TransformMatrix": ""},
    ),
    "values of another type": ("HeaderSize", [], {"ElementType": "MET_SHORT"}),
    "values after a header": ("HeaderSize", [], {"data": "a.raw", "raw": bytes(8) + RAW}),
    "no size of compressed values": ("CompressedDataSize", [], {**ZIP, "CompressedDataSize": ""}),
    "a small size of compressed values": (
        "CompressedDataSize",
        [],
        {**ZIP, "CompressedDataSize": "40"},
    ),
    "a large size of compressed values": (
        "CompressedDataSize",
        [],
        {**ZIP, "CompressedDataSize": "9999"},
    ),
    "few compressed values": (
        "HeaderSize",
        [],
        {**ZIP, "raw": (few := zlib.compress(RAW[:48])), "CompressedDataSize": str(len(few))},
    ),
    "compressed values cut short": ("a.mha", [], {**ZIP, "raw": ZIPPED[:-5]}),
    "values that are not compressed": ("a.mha", [], {**ZIP, "raw": RAW}),
    "compressed values that are not said to be": ("HeaderSize", [], {"raw": ZIPPED}),
    "compressed, unsure": ("CompressedData", [], {**ZIP, "CompressedData": "yes"}),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_metaimage_that_itk_would_misread_is_refused_by_name(case, tmp_path):
    """ITK reads each of these in silence as other values or places, or fails without the key."""
    key, lines, keys = REFUSED[case]
    with pytest.raises(Refused, match=key):
        read_volume(meta(tmp_path / "a.mha", *lines, **keys))


def test_an_anatomical_orientation_that_contradicts_the_matrix_is_reported(tmp_path):
    with pytest.warns(UserWarning, match="AnatomicalOrientation RAI .* got RPI"):
        path = meta(tmp_path / "a.mha", "AnatomicalOrientation = RPI")
        assert places(path) == PLACED


@pytest.mark.parametrize("turn", [(1, 0, 0, 0, 1, 0, 0, 0, 1), (0, 0, 1, -1, 0, 0, 0, 1, 0)])
@pytest.mark.parametrize("ending", ["mha", "nrrd"])
@pytest.mark.parametrize("packed", [True, False])
def test_images_of_itk_in_any_direction_are_read_without_a_word(packed, ending, turn, tmp_path):
    """Whatever ITK writes, with metadata of other formats, is read as ITK reads it."""
    image = sitk.GetImageFromArray(VALUES)
    image.SetDirection(turn)
    image.SetSpacing((1, 2, 3))
    image.SetOrigin((10, 20, 30))
    for key in ("scl_slope", "0028|1053", "ITK_original_spacing", "Space", "Comment"):
        image.SetMetaData(key, "2")
    sitk.WriteImage(image, str(tmp_path / f"a.{ending}"), packed)
    found = places(tmp_path / f"a.{ending}")
    for (k, j, i), value in np.ndenumerate(VALUES):
        x, y, z = image.TransformIndexToPhysicalPoint((i, j, k))
        assert found[-x, -y, z] == value


@pytest.mark.parametrize(
    ("write", "line", "key"),
    [
        (meta, "FooBar = 3", "FooBar"),
        (meta, "0028-1053 = 2", "0028-1053"),
        (meta, "private|key = 2", "private.key"),
        (meta, "Density = 2", "Density"),
        (meta, "modalitY = CT", "modalitY"),
        (nrrd, "FooBar:=3", "FooBar"),
        (nrrd, "old min:=0", "old min"),
        (nrrd, "Space Directions:=(2,0,0)", "Space Directions"),
        (nrrd, "reconstruction kernel:=bone", "reconstruction kernel"),
    ],
)
def test_other_unknown_keys_are_named(write, line, key, tmp_path):
    """Of MetaImage, and of the key/value pairs of NRRD, whatever their names."""
    path = tmp_path / ("a.mha" if write is meta else "a.nrrd")
    if write is meta:
        meta(path, line)
    else:
        path.write_bytes(nrrd(path).read_bytes().replace(b"0005\n", f"0005\n{line}\n".encode()))
    with pytest.warns(UserWarning, match=f"know: {key}") as found:
        assert places(path) == (PLACED if write is meta else expected())
    assert len(found) == 1


@pytest.mark.parametrize("line", ["rescale slope:=2", "voxel size:=2", "space_origins:=(1,2,3)"])
def test_pairs_of_nrrd_that_may_change_what_is_read_are_refused(line, tmp_path):
    """As keys of MetaImage, into which ITK copies them. So are the units and the quantization of an
    NRRD, which ITK copies without applying them.
    """
    path = nrrd(tmp_path / "a.nrrd")
    path.write_bytes(path.read_bytes().replace(b"0005\n", f"0005\n{line}\n".encode()))
    with pytest.raises(Refused, match=line.partition(":=")[0]):
        read_volume(path)
    for key in ("NRRD_space units[0] = cm", "NRRD_units[1] = cm", "NRRD_old min = 0"):
        with pytest.raises(Refused, match=key.partition(" = ")[0].replace("[", ".")):
            read_volume(meta(tmp_path / "a.mha", key))
    with warnings.catch_warnings(action="error"):
        lines = ["NRRD_space units[0] = mm", "NRRD_old min = nan", "SpacingUnits = mm"]
        assert places(meta(tmp_path / "a.mha", *lines)) == PLACED


@pytest.mark.parametrize("ending", ["mha", "mhd", "nrrd"])
@pytest.mark.parametrize("source", ["nii", "dcm", "nrrd", "mnc", "tif", "mha"])
def test_images_that_itk_converts_are_read_without_a_warning(source, ending, tmp_path):
    """With the keys of other formats that ITK copies, also where it converts them twice, and
    with pairs of 3D Slicer. Not VTK's: ITK's writer of these changes the process's locale.
    """
    image = sitk.GetImageFromArray(VALUES.astype("u2" if source in ("tif", "dcm") else "f4"))
    image.SetMetaData("0028|1053", "2")
    original, middle = tmp_path / f"a.{source}", tmp_path / f"b.{ending}"
    sitk.WriteImage(image[:, :, :1] if source == "dcm" else image, str(original))
    if source == "nrrd":
        fields = 'kinds: domain domain domain\nlabels: "a" "b" "c"\nthicknesses: 1 1 1\n'
        pairs = "Segmentation_ReferenceImageExtentOffset:=1 2 3\nDICOM.instanceUIDs:=1.2\n"
        text = original.read_bytes().replace(b"kinds: domain domain domain\n", fields.encode())
        original.write_bytes(text.replace(b"encoding", f"{pairs}encoding".encode(), 1))
    sitk.WriteImage(sitk.ReadImage(str(original)), str(middle))
    with warnings.catch_warnings(action="error"):
        read_volume(middle)
        for last in ("c.mha", "c.nrrd"):
            sitk.WriteImage(sitk.ReadImage(str(middle)), str(tmp_path / last))
            read_volume(tmp_path / last)


@pytest.mark.parametrize("line", [" " * 60_000, "dim" * 20_000, f"{'dim' * 20_000} = 2"])
@pytest.mark.parametrize("place", ["ObjectType", "ElementDataFile", ""])
def test_long_lines_are_read_without_a_wait(place, line, tmp_path):
    """Blanks, and a name with the beginning of a word of effect, anywhere in a header; messages
    show the beginning.
    """
    path = meta(tmp_path / "a.mhd", data="a.raw")
    text = path.read_text()
    path.write_text(text.replace(place, f"{line}\n{place}", 1) if place else text + line)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            assert places(path) == PLACED
        except Refused as error:
            assert len(str(error)) < 2000
    assert all(len(str(one.message)) < 2000 for one in found)


@pytest.mark.parametrize("size", ["1 2 4", "2 2 2", "0.5 1 1"])
def test_the_spacing_decides_where_the_size_of_a_voxel_differs(size, tmp_path):
    """As in ITK; a voxel may be smaller or larger than the distance to the next, as a slice is."""
    path = meta(tmp_path / "a.mha", f"ElementSize = {size}")
    with pytest.warns(UserWarning, match=f"got {size}; ElementSpacing decides"):
        assert places(path) == PLACED


@pytest.mark.parametrize("end", ["", " ", "\r", "\r\n", "\n\n"])
def test_a_header_may_end_behind_its_last_key(end, tmp_path):
    """As in files written by hand, and as ITK reads it; not within another key, or before values
    in the same file.
    """
    path = meta(tmp_path / "a.mhd", data="a.raw")
    whole = path.read_text().removesuffix("\n")
    path.write_bytes(f"{whole}{end}".encode())
    assert places(path) == PLACED
    path.write_text(whole.partition("\nElementDataFile")[0])
    with pytest.raises(Refused, match="ElementDataFile last"):
        read_volume(path)
    path = meta(tmp_path / "b.mha", raw=b"")
    path.write_text(path.read_text().removesuffix("\n"))
    with pytest.raises(Refused):
        read_volume(path)


def test_keys_behind_the_file_of_the_values_are_not_ignored_in_silence(tmp_path):
    """ITK reads no further than ElementDataFile."""
    for line, key in (
        ("ElementSpacing = 2 2 2", "ElementSpacing"),
        ("ElementToIntensityFunctionSlope: 2", "ElementToIntensityFunctionSlope"),
        ("RescaleSlope = 2", "RescaleSlope"),
    ):
        path = meta(tmp_path / "a.mhd", data="a.raw")
        path.write_text(f"{path.read_text()}{line}\n")
        with pytest.raises(Refused, match=key):
            read_volume(path)
    path = meta(tmp_path / "a.mhd", data="a.raw")
    own = path.read_text()
    path.write_text(f"{own}ElementMin = 0\nElementMax = 9")
    with warnings.catch_warnings(action="error"):
        assert places(path) == PLACED
    path.write_text(f"{own}\nFooBar = 0")
    with pytest.warns(UserWarning, match="FooBar"):
        assert places(path) == PLACED


def turned(degrees, axis, left_handed):
    """Directions of axes turned about one of the world's, of which one may be reversed."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turn @ np.diag([1, -1 if left_handed else 1, 1])


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 2, 3)])
@pytest.mark.parametrize("left_handed", [False, True])
def test_oblique_images_of_itk_are_read_without_a_word(left_handed, axis, tmp_path):
    """ITK names their axes by sides, two of which are as near at 45 degrees."""
    for degrees in (*range(0, 360, 15), 44.999, 45.001, 54.7356, 70.5288):
        image = sitk.GetImageFromArray(VALUES)
        image.SetDirection(turned(degrees, axis, left_handed).ravel().tolist())
        sitk.WriteImage(image, str(tmp_path / "a.mha"))
        places(tmp_path / "a.mha")


@pytest.mark.parametrize("name", ["LPI", "RPS", "PLS", "SPL", "LLS", "RAS", "LSA"])
def test_a_name_of_slightly_oblique_axes_is_checked(name, tmp_path):
    """Of axes that are up to 12 degrees off, as of a tilted gantry."""
    for axis in ((0, 0, 1), (1, 0, 0), (1, 2, 3)):
        words = " ".join(f"{x:.17g}" for x in turned(12, axis, False).T.ravel())
        path = meta(tmp_path / "a.mha", f"AnatomicalOrientation = {name}", TransformMatrix=words)
        with pytest.warns(UserWarning, match=f"AnatomicalOrientation RAI .* got {name}"):
            places(path)


NO_SPACE = {"space": "", "space_directions": "", "space_origin": ""}
NRRD_READ = {
    "a pair named as a field": ({"old_min:=": "0"}, expected()),
    "a pair of nan": ({"old_min:=": "nan"}, expected()),
    "a pair before units": (
        {"space_units:=": '"m" "m" "m"', "space_units": '"cm" "cm" "cm"'},
        expected((100, 200, 300), (10, 20, 30)),
    ),
    "a pair with a blank": (
        {"space_units:=a": "b", "space_units": '"cm" "cm" "cm"'},
        expected((100, 200, 300), (10, 20, 30)),
    ),
    "a pair after units": (
        {"space_units": '"cm" "cm" "cm"', "space_units:=": '"m" "m" "m"'},
        expected((100, 200, 300), (10, 20, 30)),
    ),
    "upper case": (
        {"space_directions": "", "Space_Directions": NRRD["space directions"]},
        expected(),
    ),
    "no blanks": (
        {"space_directions": "", "spacedirections": NRRD["space directions"]},
        expected(),
    ),
    "no spacings": ({"spacings": "nan nan nan"}, expected()),
    "kinds": ({"kinds": "space domain ???"}, expected()),
    "Hounsfield units": ({"sample_units": "HU"}, expected()),
    "quoted units of values": ({"sample_units": '"HU"'}, expected()),
    "Fiji's microns": (
        {"space_origin": "(0,0,0)", "space_units": '"microns" "microns" "microns"'},
        expected((0, 0, 0), (1e-3, 2e-3, 3e-3)),
    ),
    "Fiji's sign of micro": (
        {"space_origin": "(0,0,0)", "space_units": '"µm" "um" "micron"'},
        expected((0, 0, 0), (1e-3, 2e-3, 3e-3)),
    ),
    "words for millimetres": (
        {"space_units": '"millimeter" "Millimetres" "mm"'},
        expected(),
    ),
    "space dimension": (
        {
            "space": "",
            "space_directions": "",
            "space_origin": "",
            "space_dimension": "3",
            "Space_Directions": "(1,0,0) (0,2,0) (0,0,3)",
            "Space_Origin": "(10,20,30)",
        },
        PLACED,
    ),
    "other forms of numbers": ({"space_origin": "(10.000,+20,3e1)"}, expected()),
    "a fourth axis of one": (
        {
            "dimension": "4",
            "sizes": "4 3 2 1",
            "space": "",
            "space_directions": "",
            "space_origin": "",
            "space_dimension": "4",
            "Space_Directions": "(1,0,0,0) (0,2,0,0) (0,0,3,0) (0,0,0,7)",
            "Space_Origin": "(10,20,30,40)",
        },
        PLACED,
    ),
    "a list of one": (
        {
            "dimension": "4",
            "sizes": "1 4 3 2",
            "kinds": "list domain domain domain",
            "space_directions": "none (1,0,0) (0,2,0) (0,0,3)",
        },
        expected(),
    ),
    "axis mins of cells": (
        {**NO_SPACE, "spacings": "1 2 3", "axis_mins": "9.5 19 28.5"},
        PLACED,
    ),
    "axis mins of nodes": (
        {
            **NO_SPACE,
            "spacings": "1 2 3",
            "axis_mins": "10 20 30",
            "centerings": "node node node",
        },
        PLACED,
    ),
    "axis mins of 0": (
        {**NO_SPACE, "spacings": "1 2 3", "axis_mins": "0 0 0", "centers": "node node node"},
        expected((0, 0, 0), signs=LPS),
    ),
    "byte skip": ({"byte_skip": "4"}, expected()),
    "line skip": ({"line_skip": "2"}, expected()),
    "both skips": ({"line_skip": "2", "byte_skip": "4"}, expected()),
    "skip to the end": ({"byte_skip": "-1"}, expected()),
    "hex": ({"encoding": "hex"}, expected()),
    "ascii": ({"encoding": "ascii"}, expected()),
    "gzip": ({"encoding": "gzip"}, expected()),
    "gzip and skips": ({"encoding": "gz", "line_skip": "2", "byte_skip": "4"}, expected()),
    "big endian": ({"endian": "big"}, expected()),
}


def encoded(keys):
    """Values as an NRRD's keys encode them, after lines and bytes to skip."""
    kind = ">f4" if keys.get("endian") == "big" else "<f4"
    values = VALUES.astype(kind).tobytes()
    values = bytes(max(0, int(keys.get("byte_skip", 0)))) + values
    values = {
        "hex": lambda: values.hex().encode(),
        "ascii": lambda: " ".join(map(str, VALUES.ravel())).encode(),
        "gzip": lambda: gzip.compress(values),
        "gz": lambda: gzip.compress(values),
    }.get(keys.get("encoding", "raw"), lambda: values)()
    first = b"some\nlines\n" if "line_skip" in keys else b""
    return (b"junk" if keys.get("byte_skip") == "-1" else first) + values


def written(path, **keys):
    """An NRRD; a name that ends in := is that of a key/value pair."""
    head = nrrd(path, **keys).read_bytes().partition(b"\n\n")[0].replace(b":=: ", b":=")
    path.write_bytes(head + b"\n\n" + encoded(keys))
    return path


@pytest.mark.parametrize("case", NRRD_READ)
def test_an_nrrd_is_read_by_its_definition(case, tmp_path):
    """Fields, key/value pairs (key:=value), skips and encodings of NRRD."""
    keys, wanted = NRRD_READ[case]
    assert places(written(tmp_path / "a.nrrd", **keys)) == wanted


NRRD_REFUSED = {
    "spacings of nan": ("spacings", {**NO_SPACE, "spacings": "nan nan nan"}),
    "one spacing of nan": ("spacings", {**NO_SPACE, "spacings": "1 nan 3"}),
    "infinite spacings": ("spacings", {**NO_SPACE, "spacings": "inf 2 3"}),
    "spacings of 0": ("spacings", {**NO_SPACE, "spacings": "0 2 3"}),
    "spacings with units": ("spacings", {**NO_SPACE, "spacings": "1mm 2mm 3mm"}),
    "a decimal comma": ("spacings", {**NO_SPACE, "spacings": "1,5 2 3"}),
    "two spacings": ("spacings", {**NO_SPACE, "spacings": "1 2"}),
    "spacings beside directions": ("spacings", {"spacings": "1 2 3"}),
    "no third direction": ("space directions", {"space_directions": "(1,0,0) (0,2,0) none"}),
    "a direction of nan": (
        "space directions",
        {"space_directions": "(nan,nan,nan) (0,2,0) (0,0,3)"},
    ),
    "a short direction": ("space directions", {"space_directions": "(1,0) (0,2,0) (0,0,3)"}),
    "a fourth direction": (
        "space directions",
        {"space_directions": "(1,0,0) (0,2,0) (0,0,3) (1,1,1)"},
    ),
    "an origin of nan": ("space origin", {"space_origin": "(nan,nan,nan)"}),
    "an infinite origin": ("space origin", {"space_origin": "(inf,0,0)"}),
    "two origins": ("space origin", {"space_origin": "(1,2,3) (4,5,6)"}),
    "an origin and more": ("space origin", {"space_origin": "(1,2,3) 5"}),
    "time": ("kinds", {"kinds": "space space time"}),
    "unknown units": ("space units", {"space_units": '"in" "in" "in"'}),
    "two units": ("space units", {"space_units": '"mm" "mm" "cm"'}),
    "units without quotes": ("units", {"space_units": "cm cm cm"}),
    "a space and its dimension": ("space dimension", {"space_dimension": "3"}),
    "axis mins": ("axis mins", {**NO_SPACE, "spacings": "1 2 3", "axis_mins": "10 nan nan"}),
    "axis mins without spacings": ("axis mins", {**NO_SPACE, "axis_mins": "1 2 3"}),
    "axis mins beside directions": ("axis mins", {"axis_mins": "1 2 3"}),
    "two lists": (
        "three axes",
        {
            "dimension": "4",
            "sizes": "2 2 3 2",
            "kinds": "list domain domain domain",
            "space_directions": "none (1,0,0) (0,2,0) (0,0,3)",
        },
    ),
    "a list of files": ("data file", {"data_file": "LIST"}),
    "a pattern of files": ("datafile|data file", {"datafile": "a%d.raw 1 2 1"}),
    "values of another type": ("byte skip", {"type": "short"}),
    "too many lines": ("a.nrrd", {"line_skip": "-1"}),
    "a negative skip": ("byte skip", {"byte_skip": "-2"}),
    "a skip to the end of gzip": ("byte skip", {"byte_skip": "-1", "encoding": "gzip"}),
    "an unknown field": ("a.nrrd", {"voxel_size": "2"}),
    "a field twice": ("type", {"Type": "float"}),
    "units of values": ("sample units", {"sample_units": "1/cm"}),
}


@pytest.mark.parametrize("case", NRRD_REFUSED)
def test_an_nrrd_that_itk_would_misread_is_refused_by_name(case, tmp_path):
    """ITK ignores most of these, and takes 1 mm or a first voxel at 0."""
    key, keys = NRRD_REFUSED[case]
    with pytest.raises(Refused, match=key):
        read_volume(written(tmp_path / "a.nrrd", **keys))


@pytest.mark.parametrize("encoding", ["raw", "hex", "ascii", "gzip"])
def test_an_nrrd_with_more_values_than_it_declares_is_refused(encoding, tmp_path):
    """Its first values may be a header that the file does not state."""
    keys = {"encoding": encoding}
    path = written(tmp_path / "a.nrrd", **keys)
    text = path.read_bytes().replace(b"sizes: 4 3 2", b"sizes: 4 3 1")
    path.write_bytes(text)
    with pytest.raises(Refused, match="expected 48 bytes of values"):
        read_volume(path)


@pytest.mark.parametrize("key", ["dimension", "line_skip", "byte_skip"])
@pytest.mark.parametrize("text", ["\xff", "3.5", "1e1", "1_0", "\u0663", "3 3", "0x3", "9" * 20])
def test_a_number_of_nrrd_that_is_not_whole_is_refused_by_name(key, text, tmp_path):
    """Also those that Python alone reads: 1_0 and the digits of other scripts."""
    with pytest.raises(
        Refused, match=rf"a\.nrrd: expected a whole number as {key.replace('_', ' ')}"
    ):
        read_volume(nrrd(tmp_path / "a.nrrd", **{key: text}))


def test_more_lines_to_skip_than_there_are_are_refused(tmp_path):
    with pytest.raises(Refused, match=r"a\.nrrd: expected 99999 lines to skip, got fewer"):
        read_volume(nrrd(tmp_path / "a.nrrd", line_skip="99999"))
