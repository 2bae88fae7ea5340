"""TIFF images of tifffile, Pillow and SimpleITK: every type and tag is applied or refused."""

import struct
import warnings

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.projections.tiff import TIFF_KEYS
from tests.data.projections.conftest import grey, opened


def written(path, values, **options):
    """A TIFF by tifffile, black as 0."""
    tifffile.imwrite(path, values, **{"photometric": "minisblack", "metadata": None, **options})
    return path


TYPES = ["f2", "f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", ">u2", ">f8"]


@pytest.mark.parametrize("kind", TYPES)
def test_every_type_of_numbers_is_read(kind, tmp_path):
    values = (grey() % 100).astype(kind)
    order = {"byteorder": ">"} if kind[0] == ">" else {}
    stack = open_projections(written(tmp_path / "a.tif", values, **order))
    assert np.array_equal(stack.read(0, len(values)).numpy(), values.astype("f4"))
    assert stack.top == (None if "f" in kind else float(np.iinfo(kind).max))


LAYOUTS = {
    "strips": {"rowsperstrip": 4},
    "tiles": {"tile": (16, 16)},
    "deflate": {"compression": "zlib", "predictor": True, "rowsperstrip": 4},
    "LZW": {"compression": "lzw", "predictor": True},
    "PackBits": {"compression": "packbits"},
    "JPEG 2000": {"compression": "jpeg2000", "compressionargs": {"reversible": True}},
    "Zstandard": {"compression": "zstd"},
    "BigTIFF": {"bigtiff": True},
    "ImageJ": {"imagej": True, "metadata": {}},
    "tifffile's shape": {"metadata": {}},
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_and_compression_is_read(layout, tmp_path):
    stack = open_projections(written(tmp_path / "a.tif", grey(), **LAYOUTS[layout]))
    assert np.array_equal(stack.read(0, len(grey())).numpy(), grey().astype("f4"))
    assert np.array_equal(stack.read(7, 9).numpy(), grey()[7:9].astype("f4"))


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_white_as_zero_affects_display_alone(kind, tmp_path):
    """Stored values of every width, as SimpleITK reads them, too."""
    values = (grey()[0] % 250).astype(kind)
    path = written(tmp_path / "a.tif", values, photometric="miniswhite")
    assert np.array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(path))), values)
    assert np.array_equal(open_projections(path).read(0, 1)[0].numpy(), values.astype("f4"))


def packed(path, values, bits):
    """A TIFF whose numbers have these bits, without gaps; rows begin at bytes."""
    places = np.arange(bits)[::-1]
    rows = (values[..., None] >> places & 1).reshape(len(values), -1)
    raw = np.packbits(rows, axis=1).tobytes()
    written(path, np.zeros(values.shape, "u2"), rowsperstrip=values.shape[0])
    with tifffile.TiffFile(path, mode="r+b") as file:
        page = file.pages[0]
        page.tags["BitsPerSample"].overwrite(bits)
        page.tags["StripByteCounts"].overwrite(len(raw))
        file.filehandle.seek(page.dataoffsets[0])
        file.filehandle.write(raw)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_the_greatest_value_of_packed_bits_is_saturation(bits, tmp_path):
    values = np.full((6, 8), 500, "u2")
    values[2, 3], values[4, 5] = 2**bits - 1, 2**bits - 2
    packed(tmp_path / "a.tif", values, bits)
    measured = opened(tmp_path / "a.tif", flat=900.0)
    assert np.array_equal(measured.stack.read(0, 1)[0].numpy(), values)
    with pytest.warns(UserWarning, match="1 pixels of 1 views are saturated"):
        expected = torch.from_numpy(values != 2**bits - 1)
        assert torch.equal(measured.whole().mask[0], expected)


OPCODES = (51008, 51009, 51022)
TAGS = {
    "Orientation": (274, "H", 1, 6),
    "NewSubfileType": (254, "I", 1, 1),
    "GrayResponseCurve": (291, "H", 4, (4, 3, 2, 1)),
    "TransferFunction": (301, "H", 4, (0, 1, 4, 9)),
    "LinearizationTable": (50712, "H", 4, (0, 1, 4, 9)),
    "BlackLevel": (50714, "I", 1, 100),
    "BlackLevelDeltaH": (50715, "2i", 2, (1, 1, 2, 1)),
    "BlackLevelDeltaV": (50716, "2i", 2, (1, 1, 2, 1)),
    "ReferenceBlackWhite": (532, "2I", 2, (10, 1, 200, 1)),
    "ActiveArea": (50829, "I", 4, (0, 0, 4, 4)),
    "DefaultScale": (50718, "2I", 2, (2, 1, 1, 1)),
    "WhiteLevel": (50717, "I", 1, 4000),
    "Decode": (433, "d", 2, (0.0, 5.0)),
    "Gamma": (42240, "2I", 1, (22, 10)),
    **{
        f"OpcodeList{k}": (code, "B", 4, (0, 0, 0, 1))
        for k, code in zip("123", OPCODES, strict=True)
    },
    "BestQualityScale": (50780, "2I", 1, (2, 1)),
    "RowInterleaveFactor": (50975, "H", 1, 2),
    "ColumnInterleaveFactor": (52547, "H", 1, 2),
    "SubTileBlockSize": (50974, "H", 2, (2, 2)),
    "StripRowCounts": (559, "I", 2, (2, 4)),
    "Indexed": (346, "H", 1, 1),
    "OPIProxy": (351, "H", 1, 1),
    "DataType": (32996, "H", 1, 3),
    "AdventScale": (33589, "d", 1, 2.0),
    "StoNits": (37439, "d", 1, 2.0),
    "SubfileType": (255, "H", 1, 2),
    "MDFileTag": (33445, "I", 1, 2),
    "MDScalePixel": (33446, "2I", 1, (1, 1000)),
    "GDAL_METADATA": (42112, "s", 0, '<Item name="OFFSET" sample="0" role="offset">5</Item>'),
    "GDAL_NODATA": (42113, "s", 0, "0"),
}
OPTIONS = {
    "SamplesPerPixel": {"photometric": "rgb"},
    "PhotometricInterpretation": {
        "photometric": "palette",
        "colormap": np.zeros((3, 256), "u2"),
    },
    "ImageDescription: cf": {"description": "ImageJ=1.54f\nimages=1\ncf=0\nc0=-1024.0\nc1=1.0\n"},
}


@pytest.mark.parametrize(
    "key", sorted({key.name for key in TIFF_KEYS if key.use == "refused"} - {"scaleoffset.json"})
)
def test_every_tag_to_refuse_is_refused_by_name(key, tmp_path):
    """A TIFF with a tag that changes its values or their order is refused with the tag."""
    values = (grey()[0] % 250).astype("u1")
    values = np.stack([values] * 3, axis=-1) if key == "SamplesPerPixel" else values
    options = OPTIONS.get(key) or {"extratags": [(*TAGS[key], True)]}
    with pytest.raises(Refused, match=key):
        open_projections(written(tmp_path / "a.tif", values, **options))


@pytest.mark.parametrize("mark", ['"', "'"])
def test_only_items_of_gdal_that_scale_values_are_refused(mark, tmp_path):
    """GDAL writes both items if one of them is set, and others beside them."""
    text = '<Item name="SCALE" sample="0" role="scale">{}</Item><Item name="OFFSET" sample="0" '
    text += 'role="offset">{}</Item><Item name="scale">3</Item><Item role="unittype">m</Item>'
    for scale, offset, got in ((0.5, 0, "scale 0.5"), (1, -5, "offset -5"), (2, 1, "offset 1")):
        text_of = text.format(scale, offset).replace('"', mark).replace("role=", "role = ")
        tags = [(42112, "s", 0, f"<GDALMetadata>{text_of}</GDALMetadata>", True)]
        with pytest.raises(Refused, match=f"no GDAL_METADATA, got .*{got}"):
            open_projections(written(tmp_path / "a.tif", grey()[0], extratags=tags))
    for scale, offset in ((1, 0), ("1.0", "0.000")):
        tags = [(42112, "s", 0, text.format(scale, offset).replace('"', mark), True)]
        stack = open_projections(written(tmp_path / "a.tif", grey()[0], extratags=tags))
        assert np.array_equal(stack.read(0, 1)[0], grey()[0])


def test_what_differs_between_pages_is_named(tmp_path):
    """A description of the first page alone, as stacks of a detector's images have it."""
    path, text = tmp_path / "a.tif", "# Pixel_size 172e-6 m x 172e-6 m\n# Exposure_time 1 s\n"
    tifffile.imwrite(path, grey()[:2].astype("i4"), description=text, metadata=None)
    with pytest.raises(Refused, match=r"pixel_mm \(0.172.*\) on every page, got None on page 1"):
        open_projections(path)


@pytest.mark.parametrize("last", [1, 2])
def test_images_of_several_exposure_times_are_warned_of(last, tmp_path):
    """As cameras write it in EXIF's tags."""
    for k, time in enumerate((1, 1, last)):
        exposed = (33434, "2I", 1, (time, 100), True)
        written(tmp_path / f"{k}.tif", grey()[k], extratags=[exposed])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        open_projections(tmp_path)
    assert any("values of ExposureTime" in str(one.message) for one in caught) is (last > 1)


@pytest.mark.parametrize(
    ("name", "tag"), [("ISOSpeedRatings", (34855, "H")), ("FNumber", (33437, "2I"))]
)
def test_flat_fields_of_another_gain_of_the_camera_are_warned_of(name, tag, tmp_path):
    """In EXIF's tags, as cameras write them."""
    for file, value in (("view", 4), ("same", 4), ("other", 8)):
        value = (value, 1) if tag[1] == "2I" else value
        written(tmp_path / f"{file}.tif", grey()[0], extratags=[(*tag, 1, value, True)])
    options = {"layout": "projections", "find_bad_pixels": False}
    with warnings.catch_warnings(action="error"):
        opened(tmp_path / "view.tif", flat=str(tmp_path / "same.tif"), **options)
    with pytest.warns(UserWarning, match=f"the flat field has the {name} .*8.*, its views have"):
        opened(tmp_path / "view.tif", flat=str(tmp_path / "other.tif"), **options)


@pytest.mark.parametrize("kind", ["u2", "i2"])
def test_sixteen_bits_with_a_sign_of_imagej_are_read_with_their_sign(kind, tmp_path):
    """ImageJ stores them 2^15 greater, with a description; other programs keep that beside numbers
    with a sign. Another line, or that of another type, is refused.
    """
    text = "ImageJ=1.54f\nimages={}\ncf={}\nc0=-32768.0\nc1=1.0\nvunit=Gray Value\n"
    values, count = grey().astype("i4") - 30_000, len(grey())
    path, lift = tmp_path / "a.tif", 2**15 if kind == "u2" else 0
    written(path, (values + lift).astype(kind), description=text.format(count, 0))
    stack = open_projections(path)
    assert np.array_equal(stack.read(0, count).numpy(), values.astype("f4"))
    assert (stack.dtype, stack.top) == (np.dtype("i2"), 2**15 - 1)
    for numbers, line in ((values.astype("f4"), 0), (values.astype(kind), 21)):
        with pytest.raises(Refused, match="cf"):
            open_projections(written(path, numbers, description=text.format(count, line)))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("options", [{"imagej": True, "metadata": {}}, {"metadata": {}}])
def test_images_behind_a_single_page_are_read(order, options, tmp_path):
    """ImageJ stores stacks above 4 GiB behind one page, whose description has their number, as
    tifffile does on request; cut short, they are refused.
    """
    path = tmp_path / "a.tif"
    order = {} if "imagej" in options else {"byteorder": order}
    written(path, grey(), truncate=True, **options, **order)
    stack = open_projections(path)
    assert np.array_equal(stack.read(0, 12), grey()) and np.array_equal(
        stack.read(5, 7), grey()[5:7]
    )
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(Refused, match="states images, 12, got 1"):
        open_projections(path)


@pytest.mark.parametrize("layout", ["strips", "tiles", "deflate", "LZW", "PackBits", "ImageJ"])
def test_a_truncated_tiff_of_any_layout_is_refused(layout, tmp_path):
    """Cut anywhere, no page is lost and no pixel is zero in its place; tifffile ends a file with
    16 bytes that no tag refers to.
    """
    path = written(tmp_path / "a.tif", grey(), **LAYOUTS[layout])
    whole = path.read_bytes()
    for size in [*range(0, 300, 29), *range(300, len(whole) - 16, len(whole) // 11)]:
        path.write_bytes(whole[:size])
        with pytest.raises(Refused, match="a.tif: "):
            open_projections(path).read(0, len(grey()))


def test_a_strip_without_data_is_refused(tmp_path):
    """A strip that was never written, which tifffile reads as zeros."""
    path = written(tmp_path / "a.tif", grey()[0], rowsperstrip=2)
    with tifffile.TiffFile(path, mode="r+b") as file:
        counts = list(file.pages[0].databytecounts)
        file.pages[0].tags["StripByteCounts"].overwrite([counts[0], 0, *counts[2:]])
    with pytest.raises(Refused, match="expected 3 strips or tiles .* got 2 with data"):
        open_projections(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"description": "ImageJ=1.54f\r\n cf = 0 \r\nc0=5\r\n", "metadata": None}, "cf"),
        ({"imagej": True, "shape": (6, 2), "axes": "TZYX"}, "slices 2 and frames 6"),
        ({"imagej": True, "shape": (6, 2), "axes": "ZCYX"}, "channels 2 and slices 6"),
        ({"ome": True, "shape": (6, 2), "axes": "TCYX"}, "SizeC 2 and SizeT 6"),
        ({"ome": True, "more": b'SizeZ="99"'}, "SizeZ 99, got 12"),
        ({"first": True, "extratags": [(33629, 5, 3, (1,) * 6, False)]}, "images, 3, got 1"),
    ],
)
def test_a_stack_of_two_axes_or_of_several_files_is_refused(options, message, tmp_path):
    """The order of its pages is not that of the views."""
    options = {**options}
    shape, more = options.pop("shape", (12,)), options.pop("more", b"")
    axes, first = options.pop("axes", "ZYX"), options.pop("first", False)
    path, values = tmp_path / "a.tif", grey()[:12].reshape(*shape, *grey().shape[1:])
    values, metadata = (values[0], None) if first else (values, {"axes": axes})
    tifffile.imwrite(path, values, **{"metadata": metadata, **options})
    path.write_bytes(path.read_bytes().replace(b'SizeZ="12"', more or b'SizeZ="12"'))
    with pytest.raises(Refused, match=message):
        open_projections(path)


SCIFIO = "SCIFIO=0.37.3\naxes=X,Y,Channel,Time\nimages=12\nchannels={}\nslices=1\nframes={}\n"


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"SizeZ": 12}, None),
        ({"SizeZ": 6, "SizeC": 2}, "SizeC 2 and SizeZ 6"),
        ({}, "states, 1, got 12"),
        ({"SizeZ": 12, "SizeX": 6, "SizeY": 8}, "8 x 6 pixels by OME's SizeY and SizeX, got 6 x 8"),
        ("SCIFIO", "channels 2 and frames 6"),
    ],
)
@pytest.mark.parametrize("equals", ['{}="{}"', "{}='{}'", '{} = "{}"'])
def test_axes_are_read_however_they_are_quoted(equals, sizes, message, tmp_path):
    """Also with other numbers in what OME quotes of another program."""
    if sizes == "SCIFIO":
        text = SCIFIO.format(2, 6)
    else:
        pixels = " ".join(equals.format(*item) for item in sizes.items())
        other = '<OriginalMetadata><x SizeC="2" SizeT="3"/></OriginalMetadata>'
        text = f"<OME><Image><Pixels {pixels}><TiffData/></Pixels></Image>{other}</OME>"
    path = written(tmp_path / "a.tif", grey(), description=text)
    if message is None:
        assert np.array_equal(open_projections(path).read(0, 12), grey())
    else:
        with pytest.raises(Refused, match=message):
            open_projections(path)


@pytest.mark.parametrize(
    ("tag", "value", "message"),
    [
        ("BitsPerSample", 12, "73 bytes of pixels of 12 packed bits .* got 96"),
        ("BitsPerSample", 24, "8, 16 or 32 bits, got 24"),
        ("Predictor", 2, "no Predictor without LZW"),
    ],
)
def test_pixels_that_programs_read_differently_are_refused(tag, value, message, tmp_path):
    """Words of 16 bits whose tag states their 12 significant bits, as some cameras write them,
    which are no packed bits; 24 bits, which tifffile reads as big-endian always; and differences of
    pixels without compression, which libtiff never applies.
    """
    values = grey()[0] if value != 24 else grey()[0, :, :4].astype("u4")
    path = written(tmp_path / "a.tif", values, extratags=[(40123, "H", 1, 1, True)])
    predictor = path.read_bytes().replace(struct.pack("<HH", 40123, 3), struct.pack("<HH", 317, 3))
    path.write_bytes(predictor)
    with tifffile.TiffFile(path, mode="r+b") as file:
        file.pages[0].tags[tag].overwrite(value)
    with pytest.raises(Refused, match=message):
        open_projections(path)


@pytest.mark.parametrize("options", [{"imagej": True}, {"ome": True}, {"ome": True, "axis": "C"}])
def test_a_stack_of_one_axis_is_read_in_its_order(options, tmp_path):
    """With ImageJ's and OME's pixel sizes, which the camera has."""
    options = {**options}
    metadata = {"axes": f"{options.pop('axis', 'Z')}YX", "PhysicalSizeX": 0.2}
    tifffile.imwrite(tmp_path / "a.tif", grey(), metadata=metadata, resolution=(9, 9), **options)
    assert np.array_equal(open_projections(tmp_path / "a.tif").read(0, len(grey())), grey())


@pytest.mark.parametrize("reverse", [False, True])
def test_pages_of_ome_are_in_the_order_of_its_description(reverse, tmp_path):
    """TiffData may state another image for a page than the page's own number."""
    axes = 'DimensionOrder="XYZCT" Type="uint16" SizeX="8" SizeY="6" SizeC="1" SizeT="1"'
    places = [(page, 11 - page if reverse else page) for page in range(12)]
    planes = "".join(f'<TiffData IFD="{page}" FirstZ="{z}" PlaneCount="1"/>' for page, z in places)
    head = f'<OME><Image ID="Image:0"><Pixels ID="Pixels:0" {axes} SizeZ="12">'
    text = f"{head}{planes}</Pixels></Image></OME>"
    tifffile.imwrite(tmp_path / "a.tif", grey(), description=text, metadata=None)
    if reverse:
        with pytest.raises(Refused, match="order of TiffData"):
            open_projections(tmp_path / "a.tif")
    else:
        assert np.array_equal(open_projections(tmp_path / "a.tif").read(0, 12), grey())


@pytest.mark.parametrize("pages", [(0, 1, 2), (2, 1, 0)])
def test_pages_of_several_images_of_ome_are_in_their_order(pages, tmp_path):
    image = '<Image><Pixels SizeX="8" SizeY="6"><TiffData IFD="{}"/></Pixels></Image>'
    text = f"<OME>{''.join(map(image.format, pages))}</OME>"
    path = written(tmp_path / "a.tif", grey()[:3], description=text)
    if pages == (0, 1, 2):
        assert np.array_equal(open_projections(path).read(0, 3), grey()[:3])
    else:
        with pytest.raises(Refused, match="order of TiffData"):
            open_projections(path)


def test_pages_that_are_not_in_the_order_of_their_numbers_are_refused(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for number, page in zip((2, 0, 1), grey(), strict=False):
            tag = (297, "H", 2, (number, 3), True)
            file.write(page, photometric="minisblack", metadata=None, extratags=[tag])
    with pytest.raises(Refused, match="PageNumber"):
        open_projections(tmp_path / "a.tif")


def test_an_array_of_two_axes_of_images_is_refused(tmp_path):
    """As tifffile describes it; further axes of one image change nothing."""
    values = grey().reshape(6, 2, 6, 8)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack")
    with pytest.raises(Refused, match="images along one axis, got 6 x 2 by tifffile's shape"):
        open_projections(tmp_path / "a.tif")
    tifffile.imwrite(tmp_path / "b.tif", values.reshape(12, 1, 6, 8), photometric="minisblack")
    assert np.array_equal(
        open_projections(tmp_path / "b.tif").read(0, 12), values.reshape(12, 6, 8)
    )
