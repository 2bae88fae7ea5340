"""Keys that no reader knows: those that change values or geometry are refused or named, in one
warning of all files; ordinary ones are read without.

Truth: the names by which tifffile, Pillow, h5py and the definitions of NeXus write them. Tried
beside these: all 667 names in tifffile's registry, 45 tags and 30 descriptions in files, EXIF of a
camera, 15 files of tifffile, Pillow and SimpleITK, and HDF5 as DLS, the ESRF, the APS and netCDF
write it.
"""

import struct
import warnings
import zlib

import h5py
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image as Pillow
from PIL.PngImagePlugin import PngInfo

from mvrecon.core.files.checks import Refused
from mvrecon.training.export import save_views
from tests.data.projections.conftest import array, grey, opened
from tests.data.projections.test_nexus import KEYS, exchange, tomo

GIVEN = {"flat": 60_000.0, "find_bad_pixels": False}


def named(path, **options):
    """The keys that a single warning of the views names; none without a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(path, **{"find_bad_pixels": False, **options})
    assert len(caught) <= 1, [str(one.message) for one in caught]
    parts = [str(one.message).split("does not know: ")[1].split("; ")[0] for one in caught]
    return sorted(parts[0].split(", ")) if parts else []


def tiffs(folder, tags=(), text=None, values=None):
    """A folder of images with these tags and this description."""
    for k, view in enumerate(grey()[:3] if values is None else values):
        options = {"photometric": "minisblack", "metadata": None, "description": text}
        tags = [(*tag[:4], True) for tag in tags]
        tifffile.imwrite(folder / f"{k}.tif", view, extratags=tags, **options)
    return folder


BLOB = bytes(range(40))
TAGS = {
    "of texts": ([(271, "s", 0, "a"), (306, "s", 0, "b"), (315, "s", 0, "c")], []),
    "of colours, texts and GeoTIFF": (
        [(34675, "B", 40, BLOB), (700, "B", 4, b"<x/>"), (33550, "d", 3, (1.0, 1.0, 0.0))],
        ["XMP"],
    ),
    "of cameras": ([(50495, "B", 40, BLOB), (4869, "d", 1, -70.0), (4944, "d", 1, 100.0)], []),
    "of areaDetector": ([(65000, "d", 1, 1e9), (65001, "I", 1, 5), (65010, "s", 0, "Model:x")], []),
    "an offset of areaDetector": (
        [(65010, "s", 0, "Model:x"), (65027, "s", 0, "DataOffset:100")],
        ["areaDetector: DataOffset"],
    ),
    "a private tag": ([(40123, "I", 1, 5)], ["tag 40123"]),
    "NIH Image's calibration": ([(43314, "B", 40, BLOB)], ["NIHImageHeader"]),
    "a matrix and a crop": (
        [(32956, "d", 9, (1.0,) * 9), (50719, "I", 2, (1, 1))],
        ["AffineTransformMat", "DefaultCropOrigin"],
    ),
    "a gamma of 1": ([(42240, "2I", 1, (1, 1)), (50975, "H", 1, 1)], []),
}


@pytest.mark.parametrize("case", TAGS)
def test_tags_that_no_reader_knows_are_named(case, tmp_path):
    """One warning of a folder with its dark and flat fields."""
    tags, expected = TAGS[case]
    assert named(tiffs(tmp_path, tags), **GIVEN) == expected
    for name, value in (("dark", 0), ("flat", 60_000)):
        field = np.full(grey()[0].shape, value, "u2")
        extra = [(*tag, True) for tag in tags]
        tifffile.imwrite(tmp_path / f"{name}.tif", field, metadata=None, extratags=extra)
    assert named(tmp_path) == expected


def test_a_tag_of_one_page_and_of_a_cameras_exif_is_named(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for k, view in enumerate(grey()):
            tags = [(40123, "I", 1, 5, True)] if k == 7 else []
            file.write(view, photometric="minisblack", metadata=None, extratags=tags)
    assert named(tmp_path / "a.tif", **GIVEN) == ["tag 40123"]
    for gamma in (1.0, 2.2):
        exif = Pillow.Exif()
        exif.get_ifd(0x8769).update({42240: gamma, 42080: 3, 37510: b"ASCII\0\0\0a", 41985: 0})
        exif[0x8769] = dict(exif.get_ifd(0x8769))
        Pillow.fromarray(grey()[0]).save(tmp_path / "b.tif", exif=exif)
        options = {"layout": "projections", **GIVEN}
        if gamma == 1:
            assert named(tmp_path / "b.tif", **options) == ["CompositeImage", "UserComment"]
            continue
        with pytest.raises(Refused, match="Gamma"):
            opened(tmp_path / "b.tif", **options)


TEXTS = {
    "a scan of a shell, 0.5 mm of aluminium": ["a scan of a shell, 0.5 mm of aluminium"],
    "slope=1\nintercept=0.0": [],
    "normalised, intensity scale 0.001 offset 0": ["normalised, intensity scale 0.001 offset 0"],
    "1 2 3\n-- 12:03:04\n\nDate: 2020-05-01\nSoftwareVersion=8.3\nAuthor: a": [],
    "date=1\nslope=2": ["slope"],
    "Rescale Slope: 2\nRescale Intercept: -1000": ["Rescale Slope", "Rescale Intercept"],
    "gain=1 offset=5": ["gain=1 offset=5"],
    "Exposure=2;Bias=100;": ["Bias", "Exposure"],
    "Rotate=90\nValues x 1000\nInverse=1": ["Rotate", "Values x 1000", "Inverse"],
    "AcquireTime: 0.5\nExposure time: 100 ms": ["AcquireTime", "Exposure time"],
    "Detector:slope=2\nPixel: offset=100\nLens: gain=1": [
        *("Detector:slope=2", "Pixel: offset=100", "Lens: gain=1"),
    ],
    '{"camera": {"scale": [0.01, 1]}, "offset": [0, 0], "gain": {"value": 2}}': [
        "camera.scale",
        "gain.value",
    ],
    "Slope\t2\nIntercept\t0": ["Slope"],
    "<a><slope>0.5</slope><b offset='3'/></a>": ["slope", "b offset"],
    "<e><name>slope</name><value>2</value></e>": ["name = slope", "value"],
    "1.5 mm of aluminium\ndivided by the ring's current": [
        *("1.5 mm of aluminium", "divided by the ring's current"),
    ],
    "Normalization: none\nGain: 1\nReverseX=0\nGamma: 1.0\nflipped: off": [],
    "ImageJ=1.54f\nunit=micron\nvunit=Gray Value\nmin=0.0\nmax=9\nloop=false\nzorigin=2": [],
    "ImageJ=1.54f\nimages=1\ngain=3": ["gain"],
    "SCIFIO=0.37\nscales=0.5,0.5\nunits=micron,micron\nimages=1": [],
    '<MetaData><prop id="autoscale-state" value="on"/></MetaData>': [],
    "a" * 10**6: ["a" * 80 + "..."],
    "a" * 10**6 + "gain": ["..." + "a" * 76 + "gain"],
    "a=2\nb: 100": ["a", "b"],
    '[Acquisition],NrExposure="2",AcqMode="5",[Grabber],CCDGain=3,Lens=0': [
        *("Acquisition", "NrExposure", "AcqMode", "Grabber", "CCDGain"),
    ],
    '{"x": {"scale": 2}, "y": {"scale": 1}}': ["x.scale"],
    '[{"scale": 1}, {"scale": 2}]': ["scale = 2"],
    "<a><b><gain>2</gain></b><c><gain>1</gain></c></a>": ["gain"],
    # Known texts that state more, or whose names are longer than known ones.
    "Date: 2020-01-01 Gain: 4": ["Date: 2020-01-01 Gain: 4"],
    "Title: scaled by 2\nAuthor: me": ["Title: scaled by 2"],
    "software_gain=2\nhostgain=3": ["software_gain", "hostgain"],
    '{"date": {"gain": 2}}': ["date.gain"],
    "FileName: D:\\a_1.tif\nTime: 2020-01-01T12:00:00Z\nAcquired: 12:30:05.5": [],
    "time: 0.1\nTime of a frame: 0.5 s": ["time", "Time of a frame"],
    # Names of detectors of Dectris in another text.
    "# Flat_field corrected\n# Tau = 2 s": ["Flat_field corrected", "Tau"],
    # Numbers and lists below their name, as JSON is indented.
    '{\n "gain":\n  2,\n "matrix": [\n  [\n   1,\n   2\n  ]\n ]\n}': ["gain", "matrix"],
    # Names that differ in case alone.
    "Gain=2\ngain=0": ["Gain"],
    # Comments, marks at the start of lines, and lines of a letter.
    "<?xml version='1.0'?><a><!-- scaled by 2 --></a>": ["scaled by 2"],
    "<a><gain>1</gain></a>": [],
    "!inverted\n// bias=5\nx 0.001": ["inverted", "bias", "x 0.001"],
    # What is cut off has no word of an effect.
    "x" * 300 + " multiplied by 5": ["..." + "x" * 64 + " multiplied by 5"],
    "bias=2\0scale=3\0": ["bias", "scale"],
    # Texts around OME's description, and of its authors.
    "bias=5\n<OME><Image><Description>gain=2</Description><Pixels/></Image></OME>": [
        *("bias", "gain"),
    ],
}


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text[:30])
def test_what_a_description_states_is_named(text, tmp_path):
    expected = ", ".join(f"ImageDescription: {name}" for name in TEXTS[text])
    found = named(tiffs(tmp_path, text=text), **GIVEN)
    assert found == sorted(expected.split(", ") if expected else [])


def test_texts_of_other_tags_are_named(tmp_path):
    """The second description that tifffile writes, ImageJ's Info, and GDAL's items."""
    scale, own = tmp_path / "a.tif", {"photometric": "minisblack"}
    tifffile.imwrite(scale, grey(), description="a text", metadata={"scale": 2}, **own)
    assert named(scale, **GIVEN) == ["ImageDescription: a text", "ImageDescription: scale"]
    tifffile.imwrite(scale, grey(), imagej=True, metadata={"Info": "Scale: 2"})
    assert named(scale, **GIVEN) == ["IJMetadata: Scale"]
    tifffile.imwrite(scale, grey(), imagej=True, metadata={"Labels": ["a"] * len(grey())})
    assert named(scale, **GIVEN) == []
    item = '<GDALMetadata><Item name="unit">1/cm</Item></GDALMetadata>'
    tag = [(42112, "s", 0, item, True)]
    tifffile.imwrite(scale, grey(), metadata=None, extratags=tag, **own)
    assert named(scale, **GIVEN) == ['GDAL_METADATA: Item name="unit" = 1/cm']


def test_names_with_words_of_an_effect_come_first(tmp_path):
    text = "\n".join(f"{a}{b}: 1" for a in "abc" for b in "defg") + "\ncamera scale: 2"
    with pytest.warns(UserWarning, match="know: ImageDescription: camera scale, .* 4 others; if"):
        opened(tiffs(tmp_path, text=text), **GIVEN)


def test_the_scale_that_cil_stores_beside_compressed_images_is_refused(tmp_path):
    """As its TIFFWriter writes it."""
    (tiffs(tmp_path) / "scaleoffset.json").write_text('{"scale": 21.2, "offset": 0.5}')
    with pytest.raises(Refused, match="scaleoffset.json: expected images with their own values"):
        opened(tmp_path, **GIVEN)


def test_the_texts_of_a_detector_of_dectris_are_known(tmp_path):
    text = (
        "# Pixel_size 172e-6 m x 172e-6 m\n# Exposure_time 1.0 s\n# Tau = 0 s\n"
        "# Gain_setting high gain (vrf = -0.2)\n# Detector_Voffset 0.0000 m\n"
        "# Threshold_setting 7 keV\n# Count_cutoff 104857 counts\n"
    )
    assert named(tiffs(tmp_path, text=text, values=grey()[:3].astype("i4")), **GIVEN) == []
    tiffs(tmp_path, text=text + "# Pedestal_offset 12\n", values=grey()[:3].astype("i4"))
    assert named(tmp_path, **GIVEN) == ["ImageDescription: Pedestal_offset"]


CHUNKS = {
    "ordinary": (
        [(b"pHYs", bytes(9)), (b"iDOT", bytes(28))],
        [("date:create", "2020-05-01T12:00:00"), ("Software", "a"), ("Title", "b")],
        [],
    ),
    "private": ([(b"prVt", b"a"), (b"orNT", b"\3")], [], ["orNT", "prVt"]),
    "a scale": (
        [],
        [("Scale", "0.5"), ("Comment", "a=1\nslope=2")],
        ["text: Comment: a=1", "text: Scale", "text: slope"],
    ),
    "a scale of 1": ([], [("Scale", "1"), ("Software", "a")], []),
}


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("case", CHUNKS)
def test_chunks_and_texts_of_png_that_no_reader_knows_are_named(case, packed, tmp_path):
    chunks, texts, expected = CHUNKS[case]
    for k in range(3):
        about, path = PngInfo(), tmp_path / f"{k}.png"
        for key, text in texts:
            about.add_text(key, text, zip=packed)
        Pillow.fromarray(grey()[k]).save(path, pnginfo=about)
        heads = [struct.pack(">I", len(body)) + name + body for name, body in chunks]
        more = b"".join(head + struct.pack(">I", zlib.crc32(head[4:])) for head in heads)
        path.write_bytes(path.read_bytes()[:33] + more + path.read_bytes()[33:])
    assert named(tmp_path, **GIVEN) == expected


def test_exif_and_its_texts_in_png_are_named(tmp_path):
    """Entries of cameras are known; those that TIFF refuses but PNG does not are named."""
    for entries, expected in (
        ({271: "a", 531: 1, 50714: 64}, ["eXIf: BlackLevel"]),
        ({270: "gain=2", 37510: "a"}, ["eXIf: UserComment", "text: ImageDescription: gain=2"]),
    ):
        for k in range(3):
            exif = Pillow.Exif()
            exif.update(entries)
            Pillow.fromarray(grey()[k]).save(tmp_path / f"{k}.png", exif=exif)
        assert named(tmp_path, **GIVEN) == expected


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({33434: 0.02}, "values of ExposureTime, 10 or 20"),
        ({34855: 200}, "values of ISOSpeedRatings"),
        ({42240: 2.2}, "eXIf: Gamma 1, got 2.2"),
        ({42240: 1.0}, None),
    ],
)
def test_exif_of_png_is_compared_as_that_of_tiff(entries, message, tmp_path):
    for k in range(3):
        exif = Pillow.Exif()
        camera = {33434: 0.01, 34855: 100, 33437: 8.0, **(entries if k == 1 else {})}
        exif.get_ifd(0x8769).update(camera)
        exif[0x8769] = dict(exif.get_ifd(0x8769))
        Pillow.fromarray(grey()[k]).save(tmp_path / f"{k}.png", exif=exif)
    if message is None:
        assert named(tmp_path, **GIVEN) == []
    elif message.startswith("eXIf"):
        with pytest.raises(Refused, match=message):
            opened(tmp_path, **GIVEN)
    else:
        with pytest.warns(UserWarning, match=message):
            opened(tmp_path, **GIVEN)


FRAMES = "entry/instrument/detector/data"
ATTRIBUTES = {
    "ordinary": (
        {
            **{"NX_class": "a", "long_name": "b", "target": "/c", "signal": 1, "CLASS": "IMAGE"},
            **{"interpretation": "image", "IMAGE_SUBCLASS": "IMAGE_GRAYSCALE", "PALETTE": 1},
            **{
                "flip": False,
                "mirrored": 0,
                "DISPLAY_ORIGIN": "UL",
                "MATLAB_empty": 1,
                "coordinates": "a b",
            },
        },
        [],
    ),
    "other": ({"flatfield_corrected": True, "log": 1}, ["data@flatfield_corrected", "data@log"]),
    "a range": ({"min": -1.0, "max": 5.0}, ["data@max", "data@min"]),
    "rows upwards": ({"DISPLAY_ORIGIN": "LL"}, "DISPLAY_ORIGIN UL, got 'll'"),
    "indices of colours": ({"IMAGE_SUBCLASS": np.bytes_("IMAGE_INDEXED")}, "IMAGE_SUBCLASS"),
    "a valid range": ({"valid_range": [0, 100]}, "valid_range"),
}


@pytest.mark.parametrize("case", ATTRIBUTES)
def test_attributes_of_frames_that_no_reader_knows_are_named(case, tmp_path):
    """Of NXtomo, of Data Exchange, and of any data set."""
    attributes, expected = ATTRIBUTES[case]
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["data"] = grey()
    for path, place, options in (
        (tomo(tmp_path / "a.nxs"), FRAMES, {}),
        (exchange(tmp_path / "b.h5"), "exchange/data", {}),
        (tmp_path / "c.h5", "data", {"dataset": "data", **GIVEN}),
    ):
        with h5py.File(path, "a") as file:
            file[place].attrs.update(attributes)
        if isinstance(expected, list):
            assert named(path, **options) == expected
            continue
        with pytest.raises(Refused, match=f"(?i){expected}"):
            opened(path, **options)


def test_attributes_of_groups_that_no_reader_knows_are_named(tmp_path):
    """Of all groups that contain the frames, the angles or the fields, each once, as programs
    without NeXus describe a scan; not those of NeXus. Tried beside these: a direction of the
    angles, a mean grey value, and a pixel size.
    """
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["scan/raw"], file["air/flat"] = grey(), np.full((2, *grey().shape[1:]), 60_000)
        file["turns/angles"] = np.linspace(0, 180, len(grey()))
        file.attrs.update(creator="me", file_time="2020", HDF5_Version="1.14", log_applied=True)
        file["scan"].attrs.update(NX_class="NXentry", default="data", polarity="inverted", dose=0)
        file["air"].attrs.update(averaged=16)
        file["turns"].attrs.update(direction="clockwise")
        file.create_group("notes").attrs.update(weather="fair")
    found = {"dataset": "scan/raw", "angles": "turns/angles"}
    expected = ["/@log_applied", "scan@polarity", "turns@direction"]
    assert sorted(named(tmp_path / "a.h5", **found, **GIVEN)) == expected
    with pytest.warns(UserWarning) as caught:
        opened(tmp_path / "a.h5", **found, flat="air/flat", find_bad_pixels=False)
    assert "know: air@averaged; if" in str(caught[1].message)


def test_attributes_that_are_zero_are_not_named(tmp_path):
    path = tomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        file[FRAMES].attrs.update(normalised=0, log=False, shift=[0, 0], bits=12)
        file["entry/sample/rotation_angle"].attrs.update(initial_angle=0.0)
    assert named(path) == ["data@bits"]


@pytest.mark.parametrize("flat", ["flat_field", "/flat_field", "{path}:/flat_field"])
def test_data_sets_that_options_name_are_known(flat, tmp_path):
    """The same are named where no option uses them."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["raw"], file["flat_field"] = grey(), np.full(grey()[0].shape, 6e4)
        file["angles"], file["doses"] = np.linspace(0, 360, 12, endpoint=False), np.full(12, 2.0)
    used = {"angles": "angles", "flat": flat.format(path=path), "exposure": "/doses"}
    assert named(path, dataset="raw", **used) == []
    assert named(path, dataset="/raw", **GIVEN) == ["angles", "doses", "flat_field"]


def test_axes_of_frames_are_known(tmp_path):
    """As xarray and netCDF store them: a field for each axis, of its own name."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        frames = file.create_dataset("raw", data=grey())
        for axis, (name, size) in enumerate(zip(("view", "y", "x"), grey().shape, strict=True)):
            file[name] = np.arange(1.0, size + 1)
            file[name].make_scale(name)
            frames.dims[axis].attach_scale(file[name])
        file["width"] = np.arange(8.0)
    assert named(tmp_path / "a.h5", dataset="raw", **GIVEN) == ["width"]


FIELDS = {
    "ordinary": (
        {
            **{"half_acquisition": True, "real_x_pixel_size": 5e-6},
            **{"x_rotation_axis_pixel_position": 3.2, "y_rotation_axis_pixel_position": 1.0},
            **{
                "detector_number": 1,
                "binning_x": 1,
                "x_pixel_offset": np.arange(8.0),
                "distance": 1.0,
            },
            **{"calibration_date": "2020", "polar_angle": 0.0, "gain": 1.0, "bias": 0},
            **{"efficiency": 0.9, "frame_start_number": 1, "flip_rows": False, "depends_on": "."},
        },
        [],
    ),
    "scales": ({"gain": 2.0, "black_offset": 100}, ["black_offset", "gain"]),
    "geometry": ({"polar_angle": 12.0, "flip_rows": True}, ["flip_rows", "polar_angle"]),
    "turned": ({"image_rotation": 90, "tilt_angle": 2.0}, ["image_rotation", "tilt_angle"]),
    "corrections": (
        {"background_subtracted": True, "normalised": 1, "distortion": np.ones((2, 2))},
        ["background_subtracted", "distortion", "normalised"],
    ),
    "what detectors apply": (
        {"flatfield_applied": True, "countrate_correction_applied": True, "dark_corrected": 0},
        [],
    ),
    "images and tables": (
        {"mask": np.ones((2, 2)), "sample_shifts": np.ones((9, 2)), "preview": np.ones((2, 2))},
        ["mask", "preview", "sample_shifts"],
    ),
    "rows and columns of MATLAB": (
        {"monitor": np.ones((1, 9)), "gain": [[1.0]], "magnification": [[4.0]]},
        ["magnification", "monitor"],
    ),
    "of each view": ({"shake": np.ones((9, 3)), "poses": np.ones((9, 3, 4))}, ["poses", "shake"]),
    "another axis": ({"time_of_flight": np.arange(9.0)}, ["time_of_flight"]),
    "names without such a word": (
        {"is_fft_shifted": True, "binning_x": 2, "magnification": 4.0, "rotation": 90, "skew": 0},
        ["binning_x", "is_fft_shifted", "magnification", "rotation"],
    ),
}


@pytest.mark.parametrize("case", FIELDS)
def test_fields_of_a_detector_that_may_change_its_frames_are_named(case, tmp_path):
    sets, expected = FIELDS[case]
    path = tomo(tmp_path / "a.nxs", **{f"instrument__detector__{k}": v for k, v in sets.items()})
    assert named(path) == expected


def test_other_names_of_a_scan_in_hdf5_are_named(tmp_path):
    """Of angles, of the sample, of the parts of virtual frames, and of sinograms by any name."""
    assert named(tomo(tmp_path / "t.nxs", sample__tilt=2.0, sample__mass=3.0)) == ["tilt"]
    path = tomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        file["entry/sample/rotation_angle"].attrs.update(direction="cw", long_name="theta")
    assert named(path) == ["rotation_angle@direction"]
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["raw"] = grey()
        file["raw"].attrs["inverted"] = True
    options = {"dataset": "raw", "layout": "sinogram", **GIVEN}
    assert named(tmp_path / "b.h5", **options) == ["raw@inverted"]


def test_keys_beside_a_link_to_frames_are_named(tmp_path):
    """As those beside the frames, and links among them, also to what is not there."""
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["entry/data"], file["entry/skew"] = grey(), 2.0
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["scan/raw"] = h5py.ExternalLink("raw.h5", "/entry/data")
        file["scan/turned"], file["stage/height"] = True, 4.0
        file["scan/height"], file["scan/lost"] = (h5py.SoftLink(f"/stage/{n}") for n in "ab")
        file["scan/type"] = np.dtype("f4")
    found = named(tmp_path / "a.h5", dataset="scan/raw", **GIVEN)
    assert sorted(found) == ["height", "lost", "skew", "turned"]


def test_frames_of_matlab_are_warned_of(tmp_path):
    """MATLAB writes its axes in reverse order: (v, u, m) become [m u v], and (u, v, m) [m v u]."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["raw"], file["air"] = grey(), np.full((2, *grey().shape[1:]), 60_000)
        for name in file:
            file[name].attrs["MATLAB_class"] = np.bytes_("uint16")
    with pytest.warns(UserWarning, match="raw: MATLAB reverses the order of axes") as caught:
        opened(tmp_path / "a.h5", dataset="raw", flat="air", find_bad_pixels=False)
    assert len(caught) == 1


@pytest.mark.parametrize("angle", [0.0, 180.0])
def test_a_detector_that_depends_on_a_rotation_elsewhere_is_warned_of(angle, tmp_path):
    """By the chain of its field depends_on, as newer files of NeXus state it."""
    stage = {"instrument__detector__depends_on": "/entry/stage/tilt", "stage__tilt": angle}
    path = tomo(tmp_path / "a.nxs", **stage)
    with h5py.File(path, "a") as file:
        file["entry/stage/tilt"].attrs.update(transformation_type="rotation", depends_on=".")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert opened(path).n_views == (KEYS == 0).sum()
    assert any("detector is turned" in str(one.message) for one in caught) is (angle != 0)


def frames_in(path, values, unit, name="units"):
    """Frames of another program, whose unit is of this attribute."""
    with h5py.File(path, "w") as file:
        file.create_dataset("raw", data=values).attrs[name] = unit
    return path


@pytest.mark.parametrize("name", ["units", "unit"])
@pytest.mark.parametrize("unit", ["", "counts", "ADU", "counts/s", "1/s", "analog-digital units"])
def test_units_of_intensities_are_read(unit, name, tmp_path):
    """Tried as well: a.u., photons, e-, V, grey value."""
    assert named(frames_in(tmp_path / "a.h5", grey(), unit, name), dataset="raw", **GIVEN) == []


@pytest.mark.parametrize(
    "unit", ["-ln(I/I0)", "absorbance", "log10(I0/I)", "1/m", "cm^-1", "optical density"]
)
def test_units_of_line_integrals_are_refused_as_intensities(unit, tmp_path):
    """Also without flat fields in the file: the logarithm would be taken twice."""
    path = frames_in(tmp_path / "a.h5", grey().astype("f4"), unit)
    for options in ({"kind": "intensities", **GIVEN}, {"kind": "counts"}):
        with pytest.raises(Refused, match="expected units of"):
            opened(path, dataset="raw", **options)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        *((unit, False) for unit in ("", "1", "-ln(I/I0)", "attenuation", "dimensionless")),
        *((unit, True) for unit in ("log10(I0/I)", "optical density", "1/cm", "%", "mm", "counts")),
    ],
)
def test_units_of_line_integrals_that_need_a_factor_are_named(unit, factor, tmp_path):
    path = frames_in(tmp_path / "a.h5", grey().astype("f4") / 60_000, unit)
    expected = [f"units={unit}"] if factor else []
    assert named(path, dataset="raw", kind="integrals") == expected


@pytest.mark.parametrize(("unit", "names"), [("counts", []), ("counts/s", ["flat@units=counts/s"])])
def test_fields_in_other_units_than_the_views_are_named(unit, names, tmp_path):
    path = exchange(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["exchange/data"].attrs["units"] = "counts"
        file["exchange/data_white"].attrs["units"] = unit
    assert named(path) == names


@pytest.mark.parametrize("unit", ["ADU", "counts/s", "mm", "", "arbitrary units of light"])
def test_a_unit_of_views_that_mvrecon_cannot_interpret_is_refused(unit, tmp_path):
    """At reading, also of counts by their dose, and at writing."""
    for about in ({"unit": unit}, {"unit": "counts", "dose": 2.0, "unit_per_dose": unit}):
        with h5py.File(tmp_path / "views.h5", "w") as file:
            file.create_dataset("views", data=grey().astype("f4")).attrs.update(about)
        with pytest.raises(Refused, match=f"unit of views .* got '{unit}'"):
            opened(tmp_path / "views.h5")
    with pytest.raises(Refused, match=f"got '{unit}'"):
        save_views(tmp_path, "a", torch.ones(3, 4, 5), unit)


@pytest.mark.parametrize("unit", ["1/mm * mm", "1/mm", "1", "activity * mm", "spect of activity"])
def test_units_of_views_that_are_written_are_read(unit, tmp_path):
    stored = save_views(tmp_path, "a", torch.ones(3, 4, 5), unit)
    assert opened(stored / "views.h5").stack.unit == unit


def mha(path, **keys):
    """Views in a MetaImage with further keys."""
    array(path, grey())
    head, between, rest = path.read_bytes().partition(b"ElementDataFile")
    own = "".join(f"{name} = {value}\n" for name, value in keys.items())
    path.write_bytes(head + own.encode() + between + rest)
    return path


def nrrd(path, *lines, values=None):
    """Views in an NRRD with further lines of its header."""
    values = grey() if values is None else values
    kind = {"u2": "uint16", "f4": "float"}[values.dtype.str[1:]]
    sizes = " ".join(map(str, values.shape[::-1]))
    head = ["NRRD0004", f"type: {kind}", "dimension: 3", f"sizes: {sizes}", "encoding: raw"]
    text = "\n".join([*head, "endian: little", *lines, "", ""])
    path.write_bytes(text.encode() + values.tobytes())
    return path


TEXTS_OF_ITK = {
    "values multiplied by 1000": ["values multiplied by 1000"],
    "slope = 2; knee": ["slope"],
    "-log(I/I0)": ["-log(I/I0)"],
    "RTK's projections of a phantom, 0.5 mm of aluminium": [],
    "http://teem.sourceforge.net/nrrd/format.html": [],
    "This NRRD file was generated by pynrrd": [],
}


@pytest.mark.parametrize("text", TEXTS_OF_ITK)
def test_texts_of_meta_image_and_nrrd_are_searched_as_those_of_other_formats(text, tmp_path):
    for name in ("Comment", "Name", "0020|4000"):
        found = named(mha(tmp_path / "a.mha", **{name: text}), **GIVEN)
        assert found == [f"{name}: {entry}" for entry in TEXTS_OF_ITK[text]]
    for name, line in (("content", "content: "), ("#", "#"), ("0008|2111", "0008|2111:=")):
        found = named(nrrd(tmp_path / "a.nrrd", line + text), **GIVEN)
        assert found == [f"{name}: {entry}" for entry in TEXTS_OF_ITK[text]]


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [("0028|1040", "LIN ", "LOG "), ("0028|1041", "1 ", "-1"), ("0028|1054", "US", "OD")],
)
def test_relations_that_itk_copies_from_dicom_without_applying_them_are_refused(
    name, good, bad, tmp_path
):
    """PixelIntensityRelationship, its sign and RescaleType, as of a .mha written from an XA."""
    assert named(mha(tmp_path / "a.mha", **{name: good}), **GIVEN) == []
    assert named(nrrd(tmp_path / "a.nrrd", f"{name}:={good}"), **GIVEN) == []
    for path in (
        mha(tmp_path / "a.mha", **{name: bad}),
        nrrd(tmp_path / "a.nrrd", f"{name}:={bad}"),
    ):
        with pytest.raises(Refused, match=name.replace("|", r"\|")):
            opened(path, **GIVEN)


@pytest.mark.parametrize(
    "lines",
    [
        ("spacings: 0.4 0.5 nan",),
        ("spacings: 0.4 0.5 1", 'units: "mm" "mm" "deg"'),
        ("spacings: 0.04 0.05 1", 'units: "cm" "cm" "s"'),
        ("spacings: 0.4 0.5 1", "kinds: domain domain time"),
        ("spacings: 0.4 0.5 nan", "axis mins: 0 0 nan", "centerings: node node node"),
    ],
)
def test_the_axis_of_views_of_an_nrrd_has_no_length(lines, tmp_path):
    """Its spacing, unit and kind do not count; that of the pixels does."""
    path = nrrd(tmp_path / "a.nrrd", *lines)
    assert named(path, **GIVEN) == []
    stack = opened(path, **GIVEN).stack
    assert stack.pixel_mm == pytest.approx((0.5, 0.4))
    assert np.array_equal(stack.read(0, len(grey())), grey().astype("f4"))
    for other in ("spacings: nan 0.5 1", "kinds: time domain domain", "spacings: 0.4 0 1"):
        with pytest.raises(Refused):
            opened(nrrd(tmp_path / "a.nrrd", other), **GIVEN)


def test_units_of_an_nrrd_are_compared_with_the_kind_of_views(tmp_path):
    """Those of grey values need no conversion; attenuation and logarithms are no grey values."""
    path = tmp_path / "a.nrrd"
    for unit in ("ADU", "grey values", "photons", "unknown"):
        assert named(nrrd(path, f"sample units: {unit}"), **GIVEN) == []
    for unit in ("HU", "1/mm", "optical density", "-ln(I/I0)"):
        with pytest.raises(Refused, match="expected units of intensities"):
            opened(nrrd(path, f"sample units: {unit}"), **GIVEN)
    floats = (grey() / 1e4).astype("f4")
    for unit, unknown in (("line integrals", 0), ("-ln(I/I0)", 0), ("log10(I0/I)", 1), ("1/cm", 1)):
        found = named(nrrd(path, f"sample units: {unit}", values=floats), kind="integrals")
        assert found == [f"units={unit}"] * unknown


def test_a_flat_field_of_other_pixels_of_a_meta_image_is_refused(tmp_path):
    """Their size, or the place of the first."""
    size = "ElementSpacing = 1 1 1"
    views = array(tmp_path / "a.mha", grey())
    views.write_bytes(views.read_bytes().replace(size.encode(), b"ElementSpacing = 0.4 0.4 1"))
    for spacing, offset in (("0.8 0.8 1", "0 0 0"), ("0.4 0.4 1", "2 0 0")):
        flat = array(tmp_path / "flat.mha", np.full((1, *grey()[0].shape), 60_000, "u2"))
        text = flat.read_bytes().replace(size.encode(), f"ElementSpacing = {spacing}".encode())
        flat.write_bytes(text.replace(b"Offset = 0 0 0", f"Offset = {offset}".encode()))
        with pytest.raises(Refused, match="of the views"):
            opened(views, flat=flat, find_bad_pixels=False)


def test_a_flat_field_of_sinograms_in_a_meta_image_is_compared_in_no_place(tmp_path):
    """The rows of a sinogram are angles, which have no size."""
    views, flat = tmp_path / "a.mha", np.full(grey()[0].shape, 60_000, "u2")
    array(views, np.ascontiguousarray(grey().swapaxes(0, 1)))
    views.write_bytes(views.read_bytes().replace(b"Spacing = 1 1 1", b"Spacing = 0.4 1 0.4"))
    array(tmp_path / "flat.mha", flat[None])
    text = (tmp_path / "flat.mha").read_bytes()
    (tmp_path / "flat.mha").write_bytes(text.replace(b"Spacing = 1 1 1", b"Spacing = 0.4 0.4 1"))
    options = {"flat": tmp_path / "flat.mha", "layout": "sinogram", "find_bad_pixels": False}
    stack = opened(views, **options).stack
    assert np.array_equal(stack.read(0, len(grey())), grey().astype("f4"))
