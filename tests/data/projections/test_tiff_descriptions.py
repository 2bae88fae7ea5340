"""What OME, Micro-Manager and Dectris describe in a TIFF is applied, compared or refused."""

import re
import warnings

import numpy as np
import pytest
import tifffile
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from tests.data.projections.conftest import opened
from tests.data.projections.test_tiff import written

#: Exposures of four views relative to the flat field's, and its grey value.
EXPOSURES, FLAT = [1.0, 0.5, 2.0, 0.25], 2000
WEDGE = np.linspace(0, 2, 48).reshape(6, 8)


def ome(path, values, planes="", pixels="", more=""):
    """A TIFF with OME's description of a stack along z."""
    kind = {"u1": "uint8", "u2": "uint16", "i2": "int16", "f4": "float"}[values.dtype.str[1:]]
    axes = f'Type="{kind}" SizeX="8" SizeY="6" SizeC="1" SizeT="1" SizeZ="{len(values)}"'
    axes = re.sub(r'Type="\w+"', pixels, axes) if pixels.startswith("Type") else f"{axes} {pixels}"
    head = f'<OME xmlns="x"><Image ID="Image:0">{more}<Pixels DimensionOrder="XYZCT" {axes}>'
    text = f"{head}<TiffData/>{planes}</Pixels></Image></OME>"
    return written(path, values, description=text.encode())


def planes(times, unit="ms", sort=1):
    """OME's elements of exposure times, written in either order."""
    end = f' ExposureTimeUnit="{unit}"' if unit else ""
    lines = [f'<Plane TheZ="{k}" TheC="0" TheT="0" ExposureTime="{t}"{end}/>' for k, t in times]
    return "".join(lines[::sort])


def exposed():
    """Views of one wedge by their exposures."""
    light = FLAT * np.array(EXPOSURES)[:, None, None] * np.exp(-WEDGE)
    return light.round().astype("u2")


#: Other times, in places that are no part of the description.
TIMES = planes([(k, 7 * k + 1) for k in range(4)]) + '<x:Plane ExposureTime="3"/>'
QUOTED = {
    "comment": f"<!-- As before:\n{TIMES} -->",
    "annotations": f"<SA:StructuredAnnotations ID='a'>\n{TIMES}</SA:StructuredAnnotations >",
    "original": f"<OriginalMetadata>{TIMES}<!-- </OME> --></OriginalMetadata><Plane/>",
    "empty": f"<OriginalMetadata/><!-- --><OriginalMetadata>{TIMES}</OriginalMetadata>",
}


@pytest.mark.parametrize("quoted", ["", *QUOTED])
@pytest.mark.parametrize(
    ("unit", "factor", "prefix"),
    [
        ("ms", 1, ""),
        (None, 1e-3, ""),
        ("s", 1e-3, "ome:"),
        ("µs", 1e3, "OME:"),
        ("min", 1 / 6e4, ""),
    ],
)
@pytest.mark.filterwarnings("ignore:.*several values")
def test_exposure_times_of_ome_are_applied_by_their_name(unit, factor, prefix, quoted, tmp_path):
    """In their units, of s without one, and in the order of the images, also with a prefix of
    names, but not those of comments and annotations. Without views.exposure, views and flat fields
    that differ are warned of.
    """
    times = [(k, 20 * factor * e) for k, e in enumerate(EXPOSURES)]
    text = planes(times, unit, -1).replace("<Plane", f"<{prefix}Plane")
    before, _, after = QUOTED.get(quoted, "").partition("<!-- -->")
    views = ome(tmp_path / "views.ome.tif", exposed(), text + after, more=before)
    flat = np.full((1, 6, 8), FLAT, "u2")
    flat = ome(tmp_path / "flat.ome.tif", flat, planes([(0, 20 * factor)], unit))
    options = {"flat": str(flat), "find_bad_pixels": False}
    found = opened(views, exposure="ExposureTime", **options).whole().views.numpy()
    np.testing.assert_allclose(found, np.broadcast_to(WEDGE, found.shape), atol=1e-2)
    with pytest.warns(UserWarning, match="the flat field has the ExposureTime 20, its views have"):
        opened(views, **options)


def test_exposure_times_of_ome_that_contradict_the_tag_are_not_applied(tmp_path):
    tag = [(33434, "2I", 1, (1, 100), True)]
    text = f'<OME><Image><Pixels SizeZ="1"><TiffData/>{planes([(0, 20)])}</Pixels></Image></OME>'
    written(tmp_path / "a.tif", exposed()[0], description=text, extratags=tag)
    with pytest.warns(UserWarning, match="several values of ExposureTime, 10 or 20"):
        assert open_projections(tmp_path / "a.tif").exposure("ExposureTime") is None


def test_times_of_ome_in_an_unknown_unit_are_warned_of_and_not_used(tmp_path):
    path = ome(tmp_path / "a.tif", exposed(), planes(enumerate(EXPOSURES), "pixel"))
    with pytest.warns(UserWarning, match="expected the ExposureTime in units such as s or ms"):
        assert open_projections(path).exposure("ExposureTime") is None


@pytest.mark.parametrize(
    ("kind", "bits", "top"), [("u2", 12, 4095), ("u2", 16, 65535), ("i2", 13, 4095), ("u1", 7, 127)]
)
def test_the_greatest_value_of_omes_significant_bits_is_saturation(kind, bits, top, tmp_path):
    values = np.full((2, 6, 8), top // 4, kind)
    values[1, 2, 3], values[1, 4, 5] = top, top - 1
    path = ome(tmp_path / "a.tif", values, pixels=f'SignificantBits="{bits}"')
    measured = opened(path, flat=0.5 * top, find_bad_pixels=False)
    assert measured.stack.top == top
    with pytest.warns(UserWarning, match="1 pixels of 2 views are saturated"):
        mask = measured.whole().mask
    assert torch.equal(mask, torch.from_numpy(values != top))
    other = opened(path, flat=0.5 * top, find_bad_pixels=False, saturation=top + 1)
    assert other.whole().mask.all()


@pytest.mark.parametrize(
    ("kind", "pixels", "message"),
    [
        ("u2", 'SignificantBits="17"', "SignificantBits from 1 to 16 bits, got 17"),
        ("u2", 'SignificantBits="0"', "SignificantBits from 1 to 16 bits, got 0"),
        ("u2", 'Type="int16"', "OME's Type int16, got uint16"),
        ("u2", 'Type="float"', "OME's Type float, got uint16"),
        ("i2", 'Type="uint16"', "OME's Type uint16, got int16"),
    ],
)
def test_pixels_of_another_type_than_ome_states_are_refused(kind, pixels, message, tmp_path):
    with pytest.raises(Refused, match=message):
        open_projections(ome(tmp_path / "a.tif", exposed().astype(kind), pixels=pixels))


@pytest.mark.parametrize(
    ("element", "own", "other"),
    [
        ("DetectorSettings", 'Gain="1.0"', 'Gain="4.0"'),
        ("DetectorSettings", 'Binning="1x1"', 'Binning="2x2"'),
        ("DetectorSettings", 'Integration="1"', 'Integration="8"'),
        ("LightSourceSettings", 'Attenuation="0.1"', 'Attenuation="0.9"'),
    ],
)
def test_flat_fields_of_other_settings_of_ome_are_warned_of(element, own, other, tmp_path):
    views = ome(tmp_path / "views.tif", exposed(), more=f'<{element} ID="a" {own}/>')
    for settings, warned in ((own, False), (other, True)):
        field = np.full((1, 6, 8), FLAT, "u2")
        flat = ome(tmp_path / "flat.tif", field, more=f'<{element} ID="a" {settings}/>')
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            opened(views, flat=str(flat), find_bad_pixels=False)
        words = f"the flat field has the {element} {settings.partition('=')[0]}"
        assert [words in str(one.message) for one in caught] == [True] * warned


@pytest.mark.filterwarnings("ignore:.*several values")
def test_times_and_bits_of_micro_manager_are_applied(tmp_path):
    """JSON in a tag of each page."""

    def tag(ms):
        text = f'{{"Exposure-ms": {ms}, "BitDepth": 12}}'
        return [(51123, "s", 0, text, True)]

    with tifffile.TiffWriter(tmp_path / "views.tif") as file:
        for view, exposure in zip(exposed(), EXPOSURES, strict=True):
            options = {"photometric": "minisblack", "metadata": None, "contiguous": False}
            file.write(view, extratags=tag(20 * exposure), **options)
    flat = np.full((6, 8), FLAT, "u2")
    flat = written(tmp_path / "flat.tif", flat, extratags=tag(20))
    options = {"flat": str(flat), "find_bad_pixels": False, "exposure": "ExposureTime"}
    measured = opened(tmp_path / "views.tif", **options)
    found = measured.whole().views.numpy()
    np.testing.assert_allclose(found, np.broadcast_to(WEDGE, found.shape), atol=1e-2)
    assert measured.stack.top == 4095


@pytest.mark.parametrize(
    "entry",
    [
        *('"Binning": {}', '"ROI": "{}-0-8-6"', '"Camera-Gain": {}', '"Camera-Offset": "{}"'),
        '"Camera-TransposeMirrorX": {{"PropType": "Integer", "PropVal": {}}}',
    ],
)
def test_settings_of_micro_manager_are_compared_with_the_flat_field(entry, tmp_path):
    for number, warned in ((1, False), (2, True)):
        for name, own in (("views", 1), ("flat", number)):
            values = exposed() if name == "views" else np.full((6, 8), FLAT, "u2")
            tag = [(51123, "s", 0, f"{{{entry.format(own)}}}", True)]
            written(tmp_path / f"{name}.tif", values, extratags=tag)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            options = {"flat": str(tmp_path / "flat.tif"), "find_bad_pixels": False}
            opened(tmp_path / "views.tif", **options)
        words = "the flat field has the Micro-Manager"
        assert any(words in str(one.message) for one in caught) == warned


MANAGED = {
    "no bits": ('"BitDepth": ""', "BitDepth: expected a number, got ''", 65535, None),
    "bits of 0": ('"BitDepth": 0', "BitDepth from 1 to 16 bits, got 0", 65535, None),
    "bits of others": ('"BitDepth": 17', "BitDepth from 1 to 16 bits, got 17", 65535, None),
    "bits with words": ('"BitDepth": "16bit"', "BitDepth: .*got '16bit'", 65535, None),
    "a comma": ('"Exposure-ms": "50,0"', "Exposure-ms: .*got '50,0'", 65535, None),
    "infinite": ('"Exposure-ms": "inf"', "Exposure-ms: .*got 'inf'", 65535, None),
    "property maps": (
        '"BitDepth": {"PropType": "Integer", "PropVal": "12"}, '
        '"Exposure-ms": {"PropType": "Double", "PropVal": 50.0}',
        None,
        4095,
        50,
    ),
}


@pytest.mark.parametrize("case", MANAGED)
def test_entries_of_micro_manager_that_cannot_be_read_are_warned_of(case, tmp_path):
    entries, words, top, time = MANAGED[case]
    tag = [(51123, "s", 0, f"{{{entries}}}", True)]
    written(tmp_path / "a.tif", exposed()[0], extratags=tag)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stack = open_projections(tmp_path / "a.tif")
    texts = {str(one.message) for one in caught}
    assert len(texts) == (words is not None)
    assert all(re.search(f"a.tif: .*{words}.* it is not used", text) for text in texts)
    assert stack.top == top
    assert stack.exposure("ExposureTime") == (None if time is None else [time])


@pytest.mark.parametrize(
    ("times", "warned"), [((0.1, 0.0999998), False), ((49.99, 50.01), False), ((50, 51), True)]
)
def test_times_that_differ_by_less_than_a_percent_are_not_warned_of(times, warned, tmp_path):
    pages = [(k, times[k % 2]) for k in range(4)]
    path = ome(tmp_path / "a.tif", exposed(), planes(pages, "s"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        open_projections(path)
    found = ["several values of ExposureTime" in str(one.message) for one in caught]
    assert found == [True] * warned


def test_times_of_ome_that_are_no_numbers_are_warned_of(tmp_path):
    path = ome(tmp_path / "a.tif", exposed(), planes([(0, "0,1")]))
    with pytest.warns(UserWarning, match="a.tif: ExposureTime: expected a number, got '0,1'"):
        assert open_projections(path).exposure("ExposureTime") is None


DECTRIS = {
    "Detector:": "PILATUS 300K, S/N 3-0101",
    "Pixel_size": "172e-6 m x 172e-6 m",
    "Silicon": "sensor, thickness 0.000320 m",
    "Exposure_time": "0.0200000 s",
    "Exposure_period": "0.0300000 s",
    "Tau": "= 199.0e-09 s",
    "Count_cutoff": "133490 counts",
    "Threshold_setting": "6000 eV",
    "Gain_setting": "high gain (vrf = -0.150)",
    "N_excluded_pixels": "= 2",
    "Filter_transmission": "1.0000",
    "Start_angle": "0.0000 deg.",
}


def pilatus(path, values, **entries):
    """A TIFF with the header of Dectris's detectors; entries of None are left out."""
    lines = [f"# {name} {text}" for name, text in {**DECTRIS, **entries}.items() if text]
    return written(path, values.astype("i4"), description="\r\n".join(lines))


def pilatus_scan(folder, entries=(), **of_flat):
    """Views and a flat field of a detector with two gaps and a bad pixel."""
    folder.mkdir()
    values, flat = exposed().astype("i4"), np.full((6, 8), FLAT, "i4")
    for image in (*values, flat):
        image[2, :2], image[4, 5] = -1, -2
    for k, view in enumerate(values):
        pilatus(folder / f"view_{k}.tif", view, **(entries[k] if entries else {}))
    pilatus(folder / "flat.tif", flat, **of_flat)
    return values


@pytest.mark.parametrize("flat", [None, FLAT])
def test_negative_pixels_of_dectris_are_bad_ones(flat, tmp_path):
    """Whether the flat field has them, or is a number; the cutoff is saturation, and the pixel size
    that of the cameras.
    """
    values = pilatus_scan(tmp_path / "a")
    with pytest.warns(UserWarning, match="3 of 48 pixels are dead, hot or stuck"):
        measured = opened(tmp_path / "a", flat=flat, find_bad_pixels=False)
        found = measured.whole()
    assert torch.equal(found.mask, torch.from_numpy(values >= 0))
    good = values[0] >= 0
    np.testing.assert_allclose(found.views[0].numpy()[good], WEDGE[good], atol=1e-2)
    assert found.views.isfinite().all() and found.odd["floored"] == 0
    assert measured.stack.top == 133490
    assert measured.stack.pixel_mm == pytest.approx((0.172, 0.172))


@pytest.mark.parametrize("kind", ["intensities", "counts"])
def test_pixels_that_are_negative_in_single_views_are_left_out_of_these(kind, tmp_path):
    """As where counts overflow, whatever the first view has; a pixel that is negative in all views
    stays bad.
    """
    values = pilatus_scan(tmp_path / "a")
    for k, value in ((1, -2), (3, -1)):
        values[k, 3, 3] = value
        pilatus(tmp_path / f"a/view_{k}.tif", values[k])
    with pytest.warns(UserWarning, match="2 pixels of 4 views are negative, which marks bad ones"):
        found = opened(tmp_path / "a", kind=kind, find_bad_pixels=False).whole()
    assert torch.equal(found.mask, torch.from_numpy(values >= 0))
    near = (values[1, [2, 4, 3, 3], [3, 3, 2, 4]] / FLAT).mean()
    expected = -np.log(near) if kind == "intensities" else FLAT * near
    assert found.views[1, 3, 3] == pytest.approx(expected, rel=1e-4)
    assert found.odd["floored"] == 0


def test_fewer_negative_pixels_than_dectris_states_are_warned_of(tmp_path):
    pilatus_scan(tmp_path / "a", [{"N_excluded_pixels": "= 9"}] * 4)
    with pytest.warns(UserWarning, match="N_excluded_pixels states, 9, got 3; give the others"):
        opened(tmp_path / "a", find_bad_pixels=False).whole()


EQUAL_LIGHT = {
    "time": [{"Exposure_time": f"{0.02 * e} s"} for e in EXPOSURES],
    "ms": [{"Exposure_time": f"{20 * e} ms"} for e in EXPOSURES],
    "filter": [{"Filter_transmission": f"{e}"} for e in EXPOSURES],
}


@pytest.mark.parametrize("case", EQUAL_LIGHT)
@pytest.mark.filterwarnings("ignore:.*(several values|dead, hot)")
def test_exposures_of_dectris_are_applied_by_their_name(case, tmp_path):
    """A time without the filter that changed as well, or a filter without the time, is refused
    with their product, which may have blanks.
    """
    values = pilatus_scan(tmp_path / "a", EQUAL_LIGHT[case])
    names = ["Filter_transmission", "ExposureTime"][:: 1 if case == "filter" else -1]
    options = {"find_bad_pixels": False}
    found = opened(tmp_path / "a", exposure=names[0], **options).whole().views.numpy()
    for view, kept in zip(found, values >= 0, strict=True):
        np.testing.assert_allclose(view[kept], WEDGE[kept], atol=1e-2)
    with pytest.raises(Refused, match=r"say views.exposure=ExposureTime\*Filter_transmission"):
        opened(tmp_path / "a", exposure=names[1], **options)
    for product in (f"{names[1]} * {names[0]}", f" {names[0]}* {names[1]} "):
        other = opened(tmp_path / "a", exposure=product, **options).whole().views.numpy()
        np.testing.assert_allclose(other, found)


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("Tau", "= 0 s"),
        ("Threshold_setting", "9000 eV"),
        ("Gain_setting", "low gain (vrf = -0.300)"),
        ("Flat_field", "FF_p300k.tif"),
        ("Ratecorr_lut_directory", "ContinuousStandard_v1.1"),
    ],
)
@pytest.mark.parametrize("of", ["a view", "the flat field"])
@pytest.mark.filterwarnings("ignore:.*dead, hot")
def test_other_settings_of_dectris_are_warned_of(of, name, other, tmp_path):
    own = {name: DECTRIS.get(name, "(nil)")}
    entries = [own, own, own, {name: other} if of == "a view" else own]
    pilatus_scan(tmp_path / "a", entries, **({name: other} if of != "a view" else own))
    words = f"several values of {name}" if of == "a view" else f"flat field has the {name} "
    with pytest.warns(UserWarning, match=words):
        opened(tmp_path / "a", find_bad_pixels=False)


def test_images_of_several_cutoffs_have_no_saturation_until_it_is_given(tmp_path):
    entries = [{"Count_cutoff": f"{n} counts"} for n in (1000, 1000, 1000, 2000)]
    pilatus_scan(tmp_path / "a", entries)
    with pytest.raises(Refused, match="one greatest grey value.*give saturation="):
        opened(tmp_path / "a")


UNREAD = {
    "Exposure_time": ("unknown", "0,02 s"),
    "Count_cutoff": ("unknown", "10,48 counts"),
    "Filter_transmission": ("none",),
    "Pixel_size": ("172e-6 m", "172 x 172 pixels"),
    "N_excluded_pixels": ("none",),
}


@pytest.mark.parametrize(("name", "text"), [(n, text) for n, own in UNREAD.items() for text in own])
def test_entries_of_dectris_that_cannot_be_read_are_warned_of(name, text, tmp_path):
    pilatus(tmp_path / "a.tif", exposed()[0], **{name: text})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stack = open_projections(tmp_path / "a.tif")
    (words,) = {str(one.message) for one in caught}
    assert re.search("a.tif: expected .*; it is not used", words)
    assert stack.exposure("ExposureTime") == (None if name == "Exposure_time" else [20])
    assert stack.top == (2**31 - 1 if name == "Count_cutoff" else 133490)


@pytest.mark.parametrize(
    ("text", "top"),
    [
        *(("-1", 2**31 - 1), ("0 counts", 2**31 - 1), ("1,048,574 counts", 1048574)),
        ("4294967295 counts", 2**31 - 1),
    ],
)
def test_cutoffs_of_dectris_with_commas_or_of_none_are_read(text, top, tmp_path):
    """Those beyond the pixels' type, in which counts are clipped, are its greatest value."""
    pilatus(tmp_path / "a.tif", exposed()[0], Count_cutoff=text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert open_projections(tmp_path / "a.tif").top == top


def test_a_text_of_other_programs_with_such_words_is_none_of_dectris(tmp_path):
    """Negative values of other files are values."""
    values = exposed().astype("i4") - 100
    written(tmp_path / "a.tif", values, description="# Comment\n# made by hand 5 s\n")
    stack = open_projections(tmp_path / "a.tif")
    assert stack.marked is None and stack.top == 2**31 - 1
