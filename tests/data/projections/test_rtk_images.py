"""Projections of linacs and of the ESRF have the numbers that their formats state, and the line
integrals that RTK computes of them.
"""

import gzip
import struct
import subprocess
import sys
import warnings
from importlib.util import find_spec

import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections import rtk_images
from tests.data.projections.conftest import opened

needs_rtk = pytest.mark.skipif(find_spec("itk") is None, reason="itk-rtk is not installed")
#: Grey values of air that RTK assumes of each format.
AIR = {"hnc": 65535.0, "hnd": 139_000.0, "xim": 139_000.0, "his": 65536.0}
PIXEL_MM = (0.784, 0.392)


def edf(path, values, ends=b"", **keys):
    """The ESRF's data format: a header of text in blocks of 512 bytes."""
    kinds = {"u2": "UnsignedShort", "i2": "SignedShort", "f4": "FloatValue"}
    order = "HighByteFirst" if values.dtype.byteorder == ">" else "LowByteFirst"
    head = {"HeaderID": "EH:000001:000000:000000", "Image": 1, "ByteOrder": order}
    head |= {"DataType": kinds[values.dtype.str[1:]], "Dim_1": values.shape[1]}
    head |= {"Dim_2": values.shape[0], "Size": values.nbytes, "optic_used": 0.28, **keys}
    text = "{\n" + "".join(f"{name} = {value} ;\n" for name, value in head.items())
    text = text.ljust(-(-(len(text) + 2) // 512) * 512 - 2) + "}\n"
    path.write_bytes(text.encode() + values.tobytes() + ends)


def his(path, values, number=4):
    """Heimann's format of Elekta: 68 bytes, an image header of 32, unsigned shorts."""
    rows, columns = values.shape
    head = (0x7000, 68, 100, 100 + values.nbytes, 32, 1, 1, columns, rows, 1, 0, 0.0, number)
    packed = struct.pack("<HHHIHHHHHHHdH", *head)
    path.write_bytes(packed.ljust(100, b"\0") + values.astype("<u2").tobytes())


def _varian(values, length):
    """The header of Varian's OBI: the 24th and 25th of its numbers are the size of a pixel."""
    rows, columns = values.shape
    head = bytearray(length)
    struct.pack_into("<32s", head, 0, b"VARIAN_VA_INTERNAL")
    struct.pack_into("<2I", head, 120, columns, rows)
    struct.pack_into("<2d", head, 168 + 23 * 8, PIXEL_MM[1], PIXEL_MM[0])
    return bytes(head)


def hnc(path, values):
    """Varian's unpacked format: 512 bytes, unsigned shorts."""
    path.write_bytes(_varian(values, 512) + values.astype("<u2").tobytes())


def _packed(values):
    """Varian's packing: a look-up table of the bytes (1, 2, 4) of each pixel behind the second
    row's first, the pixels until there, and the other pixels' differences from the plane through
    their left, upper and upper left neighbours.
    """
    flat, columns = values.ravel().astype(int), values.shape[1]
    table, bits = bytearray(-(-(values.shape[0] - 1) * columns // 4)), b""
    for k in range(columns + 1, flat.size):
        step = int(flat[k] - flat[k - 1] - flat[k - columns] + flat[k - columns - 1])
        size = next(s for s in (0, 1, 2) if -(2 ** (8 * 2**s - 1)) <= step < 2 ** (8 * 2**s - 1))
        n = k - columns - 1
        table[n // 4] |= size << (n % 4 * 2)
        bits += step.to_bytes(2**size, "little", signed=True)
    return bytes(table), flat[: columns + 1].astype("<i4").tobytes() + bits


def hnd(path, values):
    """Varian's packed format of the OBI."""
    path.write_bytes(_varian(values, 1024) + b"".join(_packed(values)) + bytes(4))


def xim(path, values, packing=1, table=None, **properties):
    """TrueBeam's format: packed pixels, a histogram, and properties, lengths in cm."""
    first, pixels = _packed(values)
    table = len(first) if table is None else table
    head = struct.pack("<8s7i", b"VMS.XI", 1, *values.shape[::-1], 32, 4, packing, table)
    properties |= {"PixelHeight": PIXEL_MM[0] / 10, "PixelWidth": PIXEL_MM[1] / 10}
    tail = struct.pack("<5i", values.size * 4, 2, 7, 7, len(properties))
    for name, value in properties.items():
        tail += struct.pack(f"<i{len(name)}s", len(name), name.encode())
        if isinstance(value, int):
            tail += struct.pack("<2i", 0, value)
        elif isinstance(value, float):
            tail += struct.pack("<id", 1, value)
        elif isinstance(value, str):
            tail += struct.pack(f"<2i{len(value)}s", 2, len(value), value.encode())
        else:
            tail += struct.pack(f"<2i{len(value)}d", 4, 8 * len(value), *value)
    path.write_bytes(head + first + struct.pack("<i", len(pixels)) + pixels + tail)


def grey(most, shape=(12, 12), views=3):
    return np.random.default_rng(1).integers(1000, most, (views, *shape), dtype="i8")


WRITERS = {"edf": edf, "his": his, "hnc": hnc, "hnd": hnd, "xim": xim}


def folder_of(tmp_path, ending, values):
    """A folder of views in a format."""
    folder = tmp_path / "scan"
    folder.mkdir()
    for k, view in enumerate(values):
        view = view.astype("u2") if ending == "edf" else view
        WRITERS[ending](folder / f"Proj_{k}.{ending}", view)
    return folder


def of_rtk(files, line_integrals=True):
    """The line integrals by RTK, as its programs read them."""
    import itk

    image = itk.Image[itk.F, 3]
    reader = itk.ProjectionsReader[image].New(FileNames=[str(file) for file in files])
    reader.SetComputeLineIntegral(line_integrals)
    reader.Update()
    return itk.array_from_image(reader.GetOutput())


@needs_rtk
@pytest.mark.parametrize("ending", WRITERS)
@pytest.mark.parametrize("shape", [(12, 12), (9, 14), (11, 10)])
def test_grey_values_are_those_that_were_written(ending, shape, tmp_path):
    """Also of odd numbers of rows, and of differences of 1, 2 and 4 bytes. Other inputs of the
    kind: the sizes of a pixel, of which .his and .edf state none, and names in upper case.
    """
    if ending == "his":
        shape = (shape[0], shape[0])
    values = grey(60_000, shape)
    if ending in ("hnd", "xim"):
        values[:, 2:, 3:] += 200_000
    folder = folder_of(tmp_path, ending, values)
    air = {"flat": 300_000.0, "saturation": 1e6}
    measured = opened(folder, **air)
    expected = 65536 - values[:, 4:-4, 4:-4] if ending == "his" else values
    assert measured.stack.shape == expected.shape[1:]
    assert np.array_equal(measured.stack.read(0, 3).numpy(), expected)
    stated = measured.stack.pixel_mm
    assert stated == (None if ending in ("his", "edf") else pytest.approx(PIXEL_MM))
    for file in folder.iterdir():
        file.rename(file.with_suffix(file.suffix.upper()))
    assert np.array_equal(opened(folder, **air).stack.read(0, 3).numpy(), expected)


@needs_rtk
@pytest.mark.parametrize("ending", AIR)
def test_line_integrals_are_those_of_rtk(ending, tmp_path):
    """With the grey value of air that RTK assumes."""
    folder = folder_of(tmp_path, ending, grey(60_000))
    found = opened(folder, flat=AIR[ending], saturation=1e9, find_bad_pixels=False).whole()
    expected = of_rtk(sorted(folder.iterdir()))
    np.testing.assert_allclose(found.views.numpy(), expected, atol=2e-6, rtol=2e-6)


@needs_rtk
def test_fields_of_the_esrf_are_found(tmp_path):
    """dark.edf and refHST of a folder, as RTK finds them."""
    folder = folder_of(tmp_path, "edf", grey(20_000))
    dark, flat = np.full((12, 12), 100, "u2"), grey(65_000, views=1)[0].astype("u2") // 2 + 30_000
    edf(folder / "dark.edf", dark)
    for k in (0, 3):
        edf(folder / f"refHST000{k}.edf", flat)
    found = opened(folder, find_bad_pixels=False).whole().views
    views = [folder / f"Proj_{k}.edf" for k in range(3)]
    np.testing.assert_allclose(found.numpy(), of_rtk(views), atol=2e-6, rtol=2e-6)
    edf(folder / "darkend0000.edf", dark * 20)  # a sum of images
    with pytest.raises(Refused, match="darkend0000.edf"):
        opened(folder)


@needs_rtk
def test_edf_of_floats_and_of_big_endian_numbers(tmp_path):
    """Floats are of a kind that is asked for."""
    values = grey(60_000)[0]
    edf(tmp_path / "big.edf", values.astype(">u2"))
    assert np.array_equal(opened(tmp_path / "big.edf", flat=6e4).stack.read(0, 1)[0], values)
    floats = values.astype("f4") / 1e4
    edf(tmp_path / "floats.edf", floats)
    found = opened(tmp_path / "floats.edf", kind="integrals", layout="projections")
    assert np.array_equal(found.whole().views[0].numpy(), floats)
    with pytest.raises(Refused, match="kind"):
        opened(tmp_path / "floats.edf")


@needs_rtk
def test_negative_grey_values_are_no_light(tmp_path):
    """RTK reads a negative pixel of .xim as 2^32 more, an attenuation far below zero."""
    values = np.full((5, 8), 60_000)
    values[1, 2] = -7
    xim(tmp_path / "view.xim", values)
    found = opened(tmp_path / "view.xim", flat=6e4, layout="projections", find_bad_pixels=False)
    views = found.whole().views[0].numpy()
    assert views[1, 2] == pytest.approx(-np.log(1e-4)) and abs(np.delete(views, 10)).max() < 1e-6


CASES = {
    "EDF of two images": (edf, {"ends": bytes(1000)}, "expected one image of 80 bytes, got 1080"),
    "EDF cut short": (edf, {"Dim_2": 6}, "expected one image of 96 bytes, got 80"),
    "EDF in another file": (edf, {"EDF_BinaryFileName": "../x"}, "no EDF_BinaryFileName"),
    "packed EDF": (edf, {"Compression": "GzipCompression"}, "Compression none"),
    "EDF of 3 axes": (edf, {"Dim_3": 2}, "Dim_3 1, got '2'"),
    "EDF with a mark of bad pixels": (edf, {"Dummy": -10}, "no Dummy, got '-10'.*bad_pixels"),
    "EDF of other numbers": (edf, {"DataType": "Packed"}, "DataType"),
    "HIS of floats": (his, {"number": 16}, "TypeOfNumbers 4, got 16"),
    "HIS of a panel that is not square": (his, {}, "as many rows as columns"),
    "unpacked XIM": (xim, {"packing": 0}, "compression indicator 1, got 0"),
    "XIM with a long table": (xim, {"table": 1000}, "look-up table of 8 bytes"),
}


@needs_rtk
@pytest.mark.parametrize("name", CASES)
def test_what_rtk_reads_wrongly_is_refused(name, tmp_path):
    """RTK reads the first image of two, floats as integers, columns as rows, and beyond the end of
    a buffer; or takes a file elsewhere for the values.
    """
    write, options, match = CASES[name]
    path = tmp_path / f"view.{write.__name__}"
    write(path, grey(60_000, (5, 8))[0].astype("u2"), **options)
    with pytest.raises(Refused, match=match):
        opened(path, flat=6e4, layout="projections")


EXPOSURES = {
    "count_time": ("ExposureTime", [{"count_time": t} for t in (0.2, 0.1, 0.1)]),
    "ExposureTime": ("ExposureTime", [{"ExposureTime": f"{t}"} for t in (2, 1, 1)]),
    "acq_expo_time": ("ExposureTime", [{"acq_expo_time": f"{t:e}"} for t in (0.02, 0.01, 0.01)]),
    "srcur": (
        "srcur",
        [{"counter_mne": "mon srcur", "counter_pos": f"7 {i}"} for i in (200, 100, 100)],
    ),
    "machineCurrent": ("srcur", [{"machineCurrent": f"{i} mA"} for i in (200, 100, 100)]),
}


@needs_rtk
@pytest.mark.parametrize("case", EXPOSURES)
def test_exposures_of_edf_are_applied_by_their_name(case, tmp_path):
    """A view of twice the exposure of the flat field has the integrals of the other; a time that is
    no number is none, and is warned of.
    """
    name, stated = EXPOSURES[case]
    for k, light in enumerate((2, 1)):
        edf(tmp_path / f"view_{k}.edf", grey(20_000)[0].astype("u2") * light, **stated[k])
    edf(tmp_path / "refHST0000.edf", np.full((12, 12), 30_000, "u2"), **stated[2])
    with pytest.warns(UserWarning, match=f"several values of {name}"):
        views = opened(tmp_path, exposure=name, find_bad_pixels=False).whole().views
    np.testing.assert_allclose(views[0], views[1], atol=1e-6)
    edf(tmp_path / "other.edf", grey(20_000)[0].astype("u2"), count_time="auto")
    with pytest.warns(UserWarning, match="other.edf: count_time: expected a number, got 'auto'"):
        assert opened(tmp_path / "other.edf", flat=6e4).stack.exposure("ExposureTime") is None


def test_the_part_of_the_detector_that_edf_states_is_compared(tmp_path):
    """As SPEC and Lima of the ESRF write it."""
    spec = {f"{axis}_{end}": n for axis in ("col", "row") for end, n in (("end", 11), ("bin", 2))}
    lima = {"image_bin": "<2x2>", "image_roi": "<0,0>-<12x12>"}
    for k, keys in enumerate((spec, lima)):
        edf(tmp_path / f"{k}.edf", grey(20_000)[0].astype("u2"), **keys)
        _, stated, unknown = rtk_images._check_edf(tmp_path / f"{k}.edf")
        assert stated == {name: [str(value)] for name, value in keys.items()}
        assert unknown == []


TRUEBEAM = {
    **{"GantryRtn": 12.5, "KVDetectorVrt": -50.0, "KVSourceVrt": 100.0, "CouchLat": 0.1},
    **{"KVKiloVolts": 125.0, "KVMilliAmperes": 60.0, "KVMilliSeconds": 20.0},
    **{"KVNormChamber": 20_000, "KVCollimatorShape": "None", "DataGain": 1.0, "DataOffset": 0.0},
    **{"AcquisitionNotes": "", "MLCLeafsA": [1.0, 2.0], "StartTime": 1234, "MVDoseRate": 0.0},
}


def test_properties_of_xim_are_compared_or_named(tmp_path):
    """The exposure by the chamber's reading, else by current and time. Of the others, those with a
    word such as gain, unless it changes nothing.
    """
    path, values = tmp_path / "a.xim", grey(60_000)[0]
    beam = {"KVKiloVolts": ["125"], "KVCollimatorShape": ["None"]}
    xim(path, values, **TRUEBEAM)
    assert rtk_images._check_xim(path) == ({"KVNormChamber": ["20000"], **beam}, [])
    xim(path, values, **{**TRUEBEAM, "KVNormChamber": 0})
    exposures = {"ExposureTime": ["20"], "XRayTubeCurrent": ["60"]}
    assert rtk_images._check_xim(path) == ({**exposures, **beam}, [])
    changed = {"DataGain": 2.0, "DataOffset": 100.0, "AcquisitionNotes": "scaled by 2"}
    xim(path, values, **{**TRUEBEAM, **changed})
    unknown = ["DataGain", "DataOffset", "AcquisitionNotes: scaled by 2"]
    assert rtk_images._check_xim(path)[1] == unknown


@needs_rtk
def test_a_flat_field_of_another_exposure_of_xim_is_warned_of_and_applied_by_its_name(tmp_path):
    """A view of thrice the light of the flat field's, by the chamber, has the same integrals."""
    values = grey(20_000)[0]
    xim(tmp_path / "flat.xim", np.full_like(values, 20_000), **TRUEBEAM)
    brighter = {**TRUEBEAM, "KVNormChamber": 60_000, "KVMilliAmperes": 180.0}
    xim(tmp_path / "view.xim", 3 * values, **brighter)
    options = {"flat": tmp_path / "flat.xim", "layout": "projections", "find_bad_pixels": False}
    with pytest.warns(UserWarning, match="KVNormChamber .*views.exposure=KVNormChamber"):
        opened(tmp_path / "view.xim", **options)
    found = opened(tmp_path / "view.xim", exposure="KVNormChamber", **options).whole().views[0]
    np.testing.assert_allclose(found.numpy(), -np.log(values / 20_000), atol=1e-5)


@pytest.mark.parametrize("write", [hnc, hnd])
def test_what_the_header_of_varians_obi_states_of_the_light_is_compared(write, tmp_path):
    """The chamber's reading, else the current; the 30th, 31st and 35th of its numbers."""
    path = tmp_path / f"a.{write.__name__}"
    write(path, grey(60_000)[0])
    head = bytearray(path.read_bytes())
    path.write_bytes(head)
    assert rtk_images._of_varian(path) == ({}, [])
    struct.pack_into("<2d", head, 168 + 29 * 8, 110.0, 20.0)
    path.write_bytes(head)
    stated = {"dXRayKV": ["110"], "XRayTubeCurrent": ["20"]}
    assert rtk_images._of_varian(path) == (stated, [])
    struct.pack_into("<d", head, 168 + 34 * 8, 1234.5)
    struct.pack_into("<I", head, 160, 7)
    path.write_bytes(head)
    stated = {"dXRayKV": ["110"], "dCTNormChamber": ["1234.5"]}
    assert rtk_images._of_varian(path) == (stated, ["nPixelOffset"])


def test_how_cameras_turned_images_and_the_title_of_edf_are_searched(tmp_path):
    path, values = tmp_path / "a.edf", grey(20_000)[0].astype("u2")
    edf(path, values, image_flip="<flip x : True>", energy=20, title="knee 3")
    _, stated, unknown = rtk_images._check_edf(path)
    assert stated == {"image_flip": ["<flip x : True>"], "energy": ["20"]}
    assert unknown == []
    edf(path, values, title="-log(I/I0)")
    assert rtk_images._check_edf(path)[2] == ["title: -log(I/I0)"]


@pytest.mark.parametrize("text", ["-", "auto", "1e", "0.1.2", "nan"])
def test_times_of_edf_that_are_no_numbers_are_warned_of(text, tmp_path):
    path = tmp_path / "a.edf"
    edf(path, grey(20_000)[0].astype("u2"), count_time=text, acq_expo_time=0.02)
    with pytest.warns(UserWarning, match=f"a.edf: count_time: .*got '{text}'; it is not used"):
        _, stated, _ = rtk_images._check_edf(path)
    assert stated == {"ExposureTime": ["20"]}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("BSize_1", 2), ("Skew", "left")),
        *(("gain", 2), ("DataOffset", 100), ("FlatField", "Corrected"), ("Units", "1/mm")),
        *(("conversions", "x-CBF_BYTE_OFFSET"), ("BackgroundCorrectionConstant", 0.002)),
    ],
)
def test_unknown_keys_of_edf_are_found(name, value, tmp_path):
    """Not a gain of 1, nor those of the ESRF's cameras."""
    own = {"image_flip": "<flip x : False,flip y : False>", "image_rotation": "Rotation_0"}
    own |= {"Offset_1": 0, "PSize_1": 1e-6, "motor_mne": "sx sy", "acq_mode": "Single", "gain": 1}
    edf(tmp_path / "a.edf", grey(20_000)[0].astype("u2"), **{**own, name: value})
    assert rtk_images._check_edf(tmp_path / "a.edf")[2] == [name.lower()]


def test_a_long_header_of_edf_is_read_without_a_wait(tmp_path):
    """Of a key without a value, and of a name with a hyphen."""
    values = grey(20_000)[0].astype("u2")
    edf(tmp_path / "a.edf", values, **{"my-gain": "2 ;\n" + "a" * 60_000})
    assert rtk_images._check_edf(tmp_path / "a.edf")[2] == ["my-gain"]


@needs_rtk
def test_one_warning_names_the_unknown_keys_of_a_folder(tmp_path):
    for k in range(3):
        edf(tmp_path / f"a_{k}.edf", grey(20_000)[k].astype("u2"), gain=2)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        opened(tmp_path, flat=6e4)
    texts = [str(one.message) for one in found if "does not know: gain;" in str(one.message)]
    assert len(texts) == 1 and f"{tmp_path}: " in texts[0]


@pytest.mark.parametrize(("step", "warned"), [(0.001, False), (0.02, True)])
@needs_rtk
def test_a_rings_current_that_decays_by_less_than_a_percent_is_not_warned_of(
    step, warned, tmp_path
):
    for k in range(3):
        current = {"counter_mne": "srcur", "counter_pos": f"{200 * (1 - k * step):g}"}
        edf(tmp_path / f"view_{k}.edf", grey(20_000)[0].astype("u2"), **current)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(tmp_path, flat=6e4, find_bad_pixels=False)
    assert any("several values of srcur" in str(one.message) for one in caught) is warned


@needs_rtk
@pytest.mark.parametrize("ending", WRITERS)
def test_damaged_files_are_refused(ending, tmp_path):
    """Cut at any third, or an EDF in gzip; and pixels that .hnd and .xim cannot pack."""
    values = grey(60_000)[0].astype("u2")
    path = tmp_path / f"view.{ending}"
    WRITERS[ending](path, values)
    whole = path.read_bytes()
    for length in (0, 10, len(whole) // 3, 2 * len(whole) // 3):
        path.write_bytes(whole[:length])
        with pytest.raises(Refused):
            opened(path, flat=6e4, layout="projections").whole()
    path.write_bytes(gzip.compress(whole))
    with pytest.raises(Refused):
        opened(path, flat=6e4, layout="projections").whole()
    if ending in ("hnd", "xim"):
        WRITERS[ending](path, grey(60_000, (4, 5))[0])
        with pytest.raises(Refused, match="multiple of 4"):
            opened(path, flat=6e4, layout="projections")


def test_without_itk_rtk_the_extra_is_named(tmp_path, root):
    """In a process of its own that finds no itk."""
    hnc(tmp_path / "view.hnc", grey(60_000)[0])
    code = (
        "import sys; sys.modules['itk'] = None\n"
        "from mvrecon.data.projections.views import Measured, MeasuredViews\n"
        f"MeasuredViews(Measured(path={str(tmp_path / 'view.hnc')!r}, flat=6e4))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "view.hnc: needs itk: pip install 'mvrecon[rtk]'" in done.stderr
    assert (root / "pyproject.toml").read_text().count("\nrtk = [") == 1
