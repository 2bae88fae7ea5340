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
from tests.data.projections.conftest import grey, opened
from tests.data.projections.test_nexus import KEYS, exchange, tomo

GIVEN = {"flat": 60_000.0, "find_bad_pixels": False}


def named(path, **options):
    """The keys that a single warning of the views names; none without a warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(path, **{"find_bad_pixels": False, **options})
    assert len(caught) <= 1, [str(one.message) for one in caught]
    parts = [str(one.message).split("does not know: ")[1].split("; ")[0] for one in caught]
    return parts[0].split(", ") if parts else []


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
        [],
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
            assert named(tmp_path / "b.tif", **options) == ["CompositeImage"]
            continue
        with pytest.raises(Refused, match="Gamma"):
            opened(tmp_path / "b.tif", **options)


TEXTS = {
    "a scan of a shell, 0.5 mm of aluminium": [],
    "slope=1\nintercept=0.0": [],
    "normalised, intensity scale 0.001 offset 0": ["intensity scale"],
    "scan 12 of 3 bones, gain 1, 0.5 mm of aluminium\nscale 1 offset 0.0": [],
    "date=1\nslope=2": ["slope"],
    "Rescale Slope: 2\nRescale Intercept: -1000": ["Rescale Intercept", "Rescale Slope"],
    "gain=1 offset=5": ["offset"],
    "Exposure=2;Bias=100;": ["Bias"],
    "Detector:slope=2\nPixel: offset=100\nLens: gain=1": ["offset", "slope"],
    '{"camera": {"scale": [0.01, 1]}, "offset": [0, 0], "gain": {"value": 2}}': ["gain", "scale"],
    "Slope\t2\nIntercept\t0": ["Slope"],
    "<a><slope>0.5</slope><b offset='3'/></a>": ["b offset", "slope"],
    '<a><Item name="scale">3</Item><p name="gain" value="4"/></a>': ["gain", "scale"],
    "<e><name>slope</name><value>2</value><key>gain</key>\n<real>1</real></e>": ["slope"],
    "flat-field corrected by the camera": ["flat-field corrected by the camera"],
    "Values in optical density": ["Values in optical density"],
    "1.5 mm of aluminium\ndivided by the ring's current": ["divided by the ring's current"],
    "Normalization: none": [],
    "Normalization: by the ring current": ["Normalization"],
    "log file: scan.log\nlog_scaled=1": ["log_scaled"],
    "unit=mm": [],
    "Scale bar: 100 um\nCalibration date: 2020-05-01\nGain: 1": [],
    "Date: 2020-05-01\nPixel scale: 2\nUpdated gain: 3": ["Pixel scale", "Updated gain"],
    "Units: optical density": ["Units"],
    "ImageJ=1.54f\nunit=micron\nvunit=Gray Value\nmin=0.0": [],
    "ImageJ=1.54f\ngain=3": ["gain"],
    "CameraGain: 2\nDataGain: 3\nagain: 4": ["CameraGain", "DataGain"],
    "SCIFIO=0.37\nscales=0.5,0.5\nunits=micron,micron\nimages=1": [],
    '<MetaData><prop id="autoscale-state" value="on"/></MetaData>': [],
    "Gamma = 2.2\nBlackLevel: 64\nBackground=0\nPedestal: 100": ["BlackLevel", "Gamma", "Pedestal"],
    "SoftwareVersion=8.3\nGain=0\nPre-Amp Gain: 1x\nZAxisUnit=Count\nReverseX=0": [],
    "Gain: 12.5 dB\nReverseX: 1\nPre-Amp Gain: 2x": ["Gain", "Pre-Amp Gain", "ReverseX"],
    "-ln(I/I0) x 1000": ["-ln(I/I0) x 1000"],
    "Scaled Image Pixel Size (um)=5.0\nGamma: 1.0\nBackground colour: black": [],
    "x" * 10**6 + "gain": [],
}


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text[:30])
def test_entries_of_a_description_that_may_change_values_are_named(text, tmp_path):
    found = named(tiffs(tmp_path, text=text), **GIVEN)
    assert found == [f"ImageDescription: {name}" for name in TEXTS[text]]


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
    "ordinary": ([(b"pHYs", bytes(9)), (b"iDOT", bytes(28))], [("Comment", "a: b")], []),
    "private": ([(b"prVt", b"a"), (b"orNT", b"\3")], [], ["prVt", "orNT"]),
    "a scale": (
        [],
        [("Scale", "0.5"), ("Comment", "a=1\nslope=2")],
        ["text: Scale", "text: slope"],
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
            assert sorted(named(path, **options)) == expected
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
