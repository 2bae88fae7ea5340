"""VGStudio's volumes."""

import os
import re
import warnings

import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import open_volume, read_volume

VALUES = np.arange(24).reshape(2, 3, 4) - 3
FLOATS = VALUES.astype("<f4")


def vgi(folder, kind="float", bits=32, unit="mm", values=FLOATS, **changed):
    head = {
        "representation.size": "4 3 2",
        "representation.datarange": "0 -1",
        "file1.SkipHeader": 0,
        "file1.FileFormat": "raw",
        "file1.Size": "4 3 2",
        "file1.Name": "a.vol",
        "file1.Datatype": kind,
        "file1.datarange": "0 -1",
        "file1.BitsPerElement": bits,
        "geometry.resolution": "0.5 0.25 2",
        "geometry.unit": unit,
        **{name.replace("__", "."): value for name, value in changed.items()},
    }
    lines, section = ["{volume1}"], ""
    for name, value in head.items():
        place, _, key = name.partition(".")
        lines += [f"[{place}]"] * (place != section) + [f"{key} = {value}"]
        section = place
    (folder / "a.vgi").write_text("\n".join(lines), encoding="utf-8")
    values.tofile(folder / "a.vol")
    return folder / "a.vgi"


@pytest.mark.parametrize(
    ("kind", "bits", "dtype"),
    [("float", 32, "<f4"), ("signed integer", 16, "<i2"), ("float", 64, "<f8")],
)
def test_a_volume_of_vgstudio_has_its_values_and_voxels(kind, bits, dtype, tmp_path):
    volume, grid = read_volume(vgi(tmp_path, kind, bits, values=VALUES.astype(dtype)))
    assert np.array_equal(volume.numpy(), VALUES)
    assert grid.spacing == (0.5, 0.25, 2.0) and np.allclose(grid.centre, 0)
    _, grid = read_volume(vgi(tmp_path, unit="um", geometry__resolution="500 250 2000"))
    assert np.allclose(grid.spacing, (0.5, 0.25, 2.0))


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "utf-8-sig"])
def test_a_unit_of_vgstudio_is_read_in_any_encoding(encoding, tmp_path):
    path = vgi(tmp_path, unit="µm", geometry__resolution="500 250 2000")
    path.write_bytes(path.read_text(encoding="utf-8").encode(encoding))
    assert np.allclose(read_volume(path)[1].spacing, (0.5, 0.25, 2.0))


def test_values_that_are_cut_short_while_they_are_read_are_refused(tmp_path):
    slabs, _ = open_volume(vgi(tmp_path))
    assert np.array_equal(slabs.whole().numpy(), VALUES)
    os.truncate(tmp_path / "a.vol", 48)
    with pytest.raises(Refused, match="a.vol: cannot be read"):
        slabs.whole()


def _ranged(text, **changed):
    """A range of values in both places."""
    return {"representation__datarange": text, "file1__datarange": text, **changed}


REFUSED = {
    "cut short": ({"values": VALUES[:1].astype("<f4")}, "is it cut short|expected .* bytes"),
    "longer": ({"bits": 16, "kind": "signed integer"}, "expected 48 bytes, got 96"),
    "mapped values": ({"representation__datarange": "0 1"}, "expected the datarange '0 1'"),
    "another size": ({"representation__size": "4 3 1"}, "expected the size '4 3 1'"),
    "packed": ({"file1__FileFormat": "zip"}, "expected .*fileformat raw, got 'zip'"),
    "elsewhere": ({"file1__Name": "../a.vol"}, "without / "),
    "moved": ({"geometry__relativeposition": "1 0 0"}, "expected relativeposition"),
    "turned": ({"geometry__rotate": "0 1 0 -1 0 0 0 0 1"}, "expected rotate 1 0 0 0 1"),
    "scaled": ({"geometry__scale": "2 1 1"}, "expected scale 1 1 1, got '2 1 1'"),
    "two volumes": ({"file1__name": "b.vol"}, "expected one volume"),
    "two sizes": ({"geometry__Resolution": "1 1 1"}, "expected one volume"),
    "two units": ({"geometry__Unit": "um"}, "expected one volume"),
    "other bytes": ({"file1__ByteOrder": "big endian"}, "file1.byteorder 'big endian'; apply it"),
    "a slope": ({"file1__slope": 2}, "file1.slope '2'; apply it"),
    "an offset": ({"representation__offset": 3}, "representation.offset '3'; apply it"),
    "mapped": ({"representation__datamapping": "0 1"}, "datamapping '0 1'; apply it"),
    "mirrored": ({"geometry__mirror": "1 0 0"}, "expected mirror 0 0 0 or .*got '1 0 0'"),
    "mirrored file": ({"file1__mirror": "0 0 1 0"}, "expected mirror"),
    "each second voxel": ({"file1__SamplingDistance": "2 2 2"}, "expected samplingdistance 1 1 1"),
    "a distance of 2": ({"representation__samplingdistance": 2}, "expected samplingdistance"),
    "resampled": ({"representation__resamplemode": "activated"}, "expected resamplemode"),
    "a range of values": ({"file1__filerange": "0 1"}, "expected filerange 0 -1, got '0 1'"),
    "a range in the head": ({"representation__filerange": "-1 5"}, "expected filerange"),
    "a part from within": ({"file1__RegionOfInterestStart": "1 0 0"}, "regionofintereststart"),
    "a part of the file": ({"file1__RegionOfInterestEnd": "3 2 0"}, "RegionOfInterestEnd of all"),
    "scaled beside an identity": (
        {"representation__scale": "1 1 1", "geometry__scale": "2 1 1"},
        "expected scale 1 1 1, got '2 1 1'",
    ),
    "moved by another key": ({"geometry__translation": "5 0 0"}, "translation '5 0 0'; apply it"),
    "inches": ({"unit": "inch"}, "expected units of m, cm"),
    "half of the bits": ({"bits": 16, "values": FLOATS.astype("<f2")}, "BitsPerElement .32, 64"),
    "bits of no whole bytes": ({"bits": 33}, "BitsPerElement .32, 64.*got 33"),
    "12 bits": ({"kind": "unsigned integer", "bits": 12}, "BitsPerElement .8, 16, 32, 64"),
    "other bits in the head": ({"representation__bitsperelement": 16}, "expected the bitsper"),
    "values beyond a range": (_ranged("0 10"), "within the datarange 0 10, got -3"),
    "values beyond the last digit": (_ranged("-3.00 19.99"), "within the datarange .*got 20"),
    "another constant": (_ranged("5 5"), "within the datarange 5 5, got -3"),
    "a range of the wrong way": (_ranged("20 -3"), "expected a datarange of values of float32"),
    "an infinite range": (
        _ranged("-inf inf"),
        "of finite values, or 0 -1, .* got -inf inf; correct",
    ),
    "a range without an end": (_ranged("-3 inf"), "of finite values, or 0 -1, .* got -3 inf"),
    "a range of no number": (_ranged("nan nan"), "of finite values, or 0 -1, .* got nan nan"),
    "values above a range": (_ranged("-3 19.9"), "within the datarange -3 19.9, got 20"),
    "a range beyond the type": (
        _ranged("0 65535", kind="unsigned integer", bits=8, values=(VALUES + 3).astype("u1")),
        "expected a datarange of values of uint8",
    ),
    "a range of half a number": (_ranged("0"), "has no datarange"),
    "calibrated": ({"calibration__factor": 2}, "calibration.factor '2'; apply it"),
    "calibrated by materials": ({"calibration1__air": "12000"}, "calibration1.air '12000'"),
    "mapped elsewhere": ({"datamapping__low": "-1000"}, "datamapping.low '-1000'; apply it"),
    "NaN": ({"values": VALUES.astype("<f4") * np.nan}, "expected finite values"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_volume_of_vgstudio_that_is_not_applied_is_refused(fault, tmp_path):
    changed, message = REFUSED[fault]
    with pytest.raises(Refused, match=message):
        read_volume(vgi(tmp_path, **changed))


@pytest.mark.parametrize(
    ("entry", "name"),
    [
        ({"file1__compression": "zip"}, "file1.compression"),
        ({"representation__gamma": 2}, "representation.gamma"),
        ({"geometry__shift": "1 0 0"}, "geometry.shift"),
        ({"filter__kernel": 3, "filter__strength": 4}, "[filter]"),
    ],
)
def test_other_unknown_entries_of_vgstudio_are_named(entry, name, tmp_path):
    """One by one in the sections of values and geometry, else by their section."""
    with pytest.warns(UserWarning, match=f"know: {re.escape(name)};") as found:
        assert np.array_equal(read_volume(vgi(tmp_path, **entry))[0].numpy(), VALUES)
    assert len(found) == 1


def test_a_file_of_vgstudio_max_is_read_without_a_warning(tmp_path):
    """With the sections of version 1.2's display, and the name as CERA's users write it."""
    path = vgi(tmp_path, file1__Name="./a.vol", geometry__clipbox="0 0 0 4 3 2")
    sections = {
        "section1": "offset = 3",
        "segment1": "redx = 0 65535",
        "version": "release = 1.2.1",
        "viewer": "position = 0 5849 0",
        "perspective": "status = activated",
        "light1": "diffuse = 0.3 0.3 0.3",
        "angle": "right = 1 2 0",
        "volume": "volume = volume1",
        "resolution": "displayunit = mm",
        "rendering": "intensity = 0.3",
        "description": "text = a",
    }
    lines = (f"[{section}]\n{entry}" for section, entry in sections.items())
    path.write_text("\n".join([path.read_text(encoding="utf-8"), *lines]), encoding="utf-8")
    with warnings.catch_warnings(action="error"):
        assert np.array_equal(read_volume(path)[0].numpy(), VALUES)


def test_entries_of_vgstudio_that_change_nothing_are_accepted(tmp_path):
    """As version 1.2 writes them, with values of its whole file."""
    neutral = {
        **{"representation__mirror": "0 0 0 0", "representation__resamplemode": "not activated"},
        **{"representation__samplingdistance": "1 1 1", "file1__filerange": "0 -1"},
        **{"file1__RegionOfInterestStart": "0 0 0", "file1__RegionOfInterestEnd": "3 2 1"},
        **{"geometry__status": "visible", "geometry__relativeposition": "0 0 0"},
        **{"geometry__position": "-0 0 0", "geometry__scale": "1.0 1 1"},
        **{"geometry__center": "2 1.5 1", "geometry__rotate": "1 0 0 0 1 0 0 0 1"},
    }
    neutral |= {"calibration__status": "off", "description__text": "calibrated", "view__scale": 3}
    neutral |= {"scalebar__visible": "true", "histogram__scale_type": "logarithmic"}
    for text in ("0 -1", "-3 20", "-1e3 1e3", "-3.00001 20"):
        volume, grid = read_volume(vgi(tmp_path, **neutral, **_ranged(text)))
        assert np.array_equal(volume.numpy(), VALUES) and np.allclose(grid.centre, 0)


def test_a_range_of_the_file_alone_is_that_of_its_floats(tmp_path):
    """The head may state none. Integers would be stretched to their type's range, and are
    refused; also tried: a range of the file that the values exceed.
    """
    ranges = {"representation__datarange": "0 -1", "file1__datarange": "-3.0 20.0"}
    assert np.array_equal(read_volume(vgi(tmp_path, **ranges))[0].numpy(), VALUES)
    with pytest.raises(Refused, match="within the datarange -3.0 19.0, got 20"):
        read_volume(vgi(tmp_path, **{**ranges, "file1__datarange": "-3.0 19.0"}))
    whole = {"kind": "signed integer", "bits": 16, "values": VALUES.astype("<i2")}
    with pytest.raises(Refused, match="expected the datarange '0 -1' of .representation"):
        read_volume(vgi(tmp_path, **ranges, **whole))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        *((FLOATS / 7, f"{-3 / 7:{form}} {20 / 7:{form}}") for form in (".4f", ".3f", ".4g")),
        (FLOATS * 1234.5, f"{-3 * 1234.5:.4g} {20 * 1234.5:.4g}"),
        (np.linspace(0, 65535, 24).astype("<u2"), f"0 {65535:.4g}"),
        (FLOATS * 0 + 5, "5 5"),
        (FLOATS * 0 + 1 / 3, "0.3333 0.3333"),
        (FLOATS, "0 0"),
        (FLOATS * 0, "0 0"),
        (FLOATS * 1e-6, "-0.0000 0.0000"),
    ],
)
def test_a_range_of_vgstudio_is_compared_as_it_is_rounded(values, text, tmp_path):
    """By half a unit of its last digit; 0 0 states nothing."""
    kind = {"f": "float", "u": "unsigned integer"}[values.dtype.kind]
    path = vgi(tmp_path, kind, 8 * values.itemsize, values=values, **_ranged(text))
    assert np.array_equal(read_volume(path)[0].numpy().ravel(), values.ravel())
