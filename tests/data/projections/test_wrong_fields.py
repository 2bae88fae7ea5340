"""Fields that are not those of the views: the views themselves, several fields at once, other
pixels, another scale; and right ones, by whatever names.

Truth: grey values of a smooth body that moves from view to view, D + (F - D) exp(-p). Tried beside
these, of 97 fields: stacks of TIFF and NumPy, sinograms, PNG and 32-bit means beside views of 16
bits, masks of every type, fields of other sizes, transposed, swapped, NaN, lists and patterns.
"""

import warnings

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.faults import zingers
from mvrecon.data.projections.opening import open_projections
from tests.data.projections.conftest import array, opened
from tests.data.projections.test_nikon import xtekct

DARK, FLAT, VIEWS, ROWS, COLUMNS = 100, 50_100, 12, 20, 24
K, Y, X = np.ogrid[:VIEWS, :ROWS, :COLUMNS]
BODY = 0.8 * np.exp(-((X - 12 - 6 * np.cos(0.5 * K)) ** 2) / 30 - (Y - 7) ** 2 / 40)


def grey(exposure=1.0, body=BODY):
    """Grey values [m v u] of 16 bits."""
    return (DARK + (FLAT - DARK) * exposure * np.exp(-body)).round().astype("u2")


def images(folder, values, names="view_{}.tif"):
    folder.mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(values):
        tifffile.imwrite(folder / names.format(k), image)
    return folder


def level(value, count=1, kind="u2"):
    return np.full((count, ROWS, COLUMNS), value, kind)


@pytest.fixture
def scan(tmp_path):
    return images(tmp_path / "scan", grey())


@pytest.mark.parametrize("name", ["flat", "dark"])
@pytest.mark.parametrize("form", ["folder", "stack", "npy"])
def test_the_views_are_none_of_their_own_fields(form, name, scan, tmp_path):
    path = scan
    if form == "stack":
        tifffile.imwrite(path := tmp_path / "scan.tif", grey())
    elif form == "npy":
        path = array(tmp_path / "scan.npy", grey())
    with pytest.raises(Refused, match=f"images of the {name} field, got those of the views"):
        opened(path, **{"flat": FLAT, "dark": DARK, name: str(path)})


def test_another_scan_as_flat_field_is_warned_of(scan, tmp_path):
    """Its views have one mean, but not one in each part of the detector."""
    other = images(tmp_path / "other", grey(body=BODY + 0.4))
    with pytest.warns(UserWarning, match="in parts of the detector; are views among them"):
        opened(scan, dark=DARK, flat=str(other))


NAMES = {
    "before and after": ["before_1", "before_2", "after_1", "after_2"],
    "in words": ["before", "after"],
    "with gaps": ["img_1", "img_2", "img_5"],
}


@pytest.mark.parametrize("case", NAMES)
@pytest.mark.parametrize("inside", [False, True])
def test_images_of_a_field_have_any_names_and_no_order(inside, case, scan, tmp_path):
    for field, value in (("flat", FLAT), ("dark", DARK)):
        folder = (scan if inside else tmp_path / "fields") / f"{field}s"
        folder.mkdir(parents=True)
        for k, name in enumerate(NAMES[case]):
            tifffile.imwrite(folder / f"{name}.tif", level(value + (-1) ** k)[0])
    options = {} if inside else {n: str(tmp_path / "fields" / f"{n}s") for n in ("flat", "dark")}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = opened(scan, find_bad_pixels=False, **options).whole().views
    assert np.abs(found.numpy() - BODY).max() < 1e-3


@pytest.mark.parametrize("name", ["flat", "dark"])
@pytest.mark.parametrize("names", ["img_{}.tif", None])
def test_images_of_both_fields_are_none_of_one(names, name, scan, tmp_path):
    """In one folder, numbered or by names that mvrecon does not know."""
    both = (level(FLAT)[0], level(DARK)[0])
    for k, field in enumerate(both):
        file = names.format(k) if names else ("FF_1.tif", "DF_1.tif")[k]
        images(tmp_path / "fields", [field], file)
    with pytest.raises(Refused, match=f"of the {name} field alone, got some with means of 100 to"):
        opened(scan, **{"flat": FLAT, "dark": DARK, name: str(tmp_path / "fields")})


def test_noise_and_drift_of_a_field_are_read(scan, tmp_path):
    """Of 100 photons, of a beam that loses 1.5 %, and dark images of a few counts, one of which is
    brighter by half.
    """
    rng = np.random.default_rng(0)
    beam = np.linspace(1, 0.985, 5)[:, None, None] * level(FLAT - DARK, 5, "f8")
    images(tmp_path / "flats", (DARK + 500 * rng.poisson(beam / 500)).astype("u2"))
    images(tmp_path / "darks", rng.poisson(np.r_[level(2.0, 4, "f8"), level(3.0, 1, "f8")]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(scan, dark=str(tmp_path / "darks"), flat=str(tmp_path / "flats"))


def test_fields_of_another_pixel_size_are_refused(tmp_path):
    """As of another binning, whose images were cropped to as many pixels."""
    for name, values, spacing in (
        ("scan", grey(), 0.4),
        ("same", level(FLAT), 0.4),
        ("binned", level(FLAT), 0.8),
    ):
        image = sitk.GetImageFromArray(values)
        image.SetSpacing((spacing, spacing, 1.0))
        sitk.WriteImage(image, str(tmp_path / f"{name}.mha"))
    opened(tmp_path / "scan.mha", dark=DARK, flat=str(tmp_path / "same.mha"))
    with pytest.raises(Refused, match="with the pixel sizes and Offset .* of the views"):
        opened(tmp_path / "scan.mha", dark=DARK, flat=str(tmp_path / "binned.mha"))


@pytest.mark.parametrize(
    ("scale", "exposure", "warned"),
    [(1.0, None, False), (1 / 16, None, True), (1.0, 1, False), (1.0, 40, True)],
)
def test_views_that_are_all_darker_than_a_tenth_of_their_flat_field_are_named(
    scale, exposure, warned, tmp_path
):
    """Whatever the cause, as views that are brighter are: a field of 12 bits that was scaled to 16,
    exposures in ms that are not relative to the field's.
    """
    scan = images(tmp_path / "scan", grey(exposure=scale))
    options = {"flat": FLAT, "dark": DARK, "find_bad_pixels": False}
    if exposure is not None:
        options["exposure"] = tmp_path / "exposures.txt"
        options["exposure"].write_text("\n".join([str(exposure)] * VIEWS))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(scan, **options).whole()
    assert ["less than a tenth as bright" in str(one.message) for one in caught] == [True] * warned


@pytest.mark.parametrize("option", ["flat", "dark", "saturation"])
def test_options_of_light_are_refused_for_line_integrals(option, tmp_path):
    """Dark and flat fields, as exposures, would not be used; a dark field of 0 changes nothing."""
    path = array(tmp_path / "a.npy", BODY.astype("f4"))
    opened(path, kind="integrals", dark=0)
    for kind in ("integrals", "counts"):
        with pytest.raises(Refused, match=f"expected intensities for views.{option}, got {kind}"):
            opened(path, kind=kind, **{option: 100.0})


def test_a_white_level_of_nikon_is_the_flat_field_of_other_views(scan, tmp_path):
    """A header that is given as flat field: its number, not the mean of its images."""
    (tmp_path / "nikon").mkdir()
    sizes = {"DetectorPixelsX": COLUMNS, "DetectorPixelsY": ROWS, "Projections": VIEWS}
    path = xtekct(tmp_path / "nikon", WhiteLevel=FLAT, **sizes)
    images(tmp_path / "nikon", grey(body=BODY + 0.4), "tooth_{}.tif")
    found = opened(scan, dark=DARK, flat=str(path), find_bad_pixels=False).whole().views
    assert np.abs(found.numpy() - BODY).max() < 1e-3


@pytest.mark.parametrize("top", [65_535.0, 65_534.0, 30_000.0])
def test_a_flat_field_that_is_given_as_a_number_is_not_saturated(top, tmp_path):
    """The largest number that pixels hold, as the unattenuated beam in .hnc; a measured flat field
    of this grey value is.
    """
    views = np.full((3, 6, 8), top / 2).astype("u2")
    np.save(tmp_path / "a.npy", views)
    measured = opened(tmp_path / "a.npy", flat=top, find_bad_pixels=False).whole()
    expected = -np.log(views[0] / np.float32(top))
    np.testing.assert_allclose(measured.views[0], expected, rtol=1e-5)
    np.save(tmp_path / "flat.npy", np.full((6, 8), 65_535, "u2"))
    with pytest.raises(Refused, match="between dark and saturated"):
        opened(tmp_path / "a.npy", flat=str(tmp_path / "flat.npy"), find_bad_pixels=False)


@pytest.mark.parametrize(
    ("bits", "types", "warned"),
    [
        ((12, 14), ("u2", "u2"), True),
        ((12, 12), ("u2", "u2"), False),
        ((12, None), ("u2", "u2"), False),
        ((None, None), ("u1", "u2"), True),
        ((12, None), ("u2", "f4"), False),
        ((None, None), ("i2", "u2"), False),
    ],
)
def test_bits_of_views_and_flat_field_are_compared(bits, types, warned, tmp_path):
    """As Micro-Manager states them, else those of the pixels' types; means in floats have none."""
    for name, bit, kind in zip(("views", "flat"), bits, types, strict=True):
        tags = [] if bit is None else [(51123, "s", 0, f'{{"BitDepth": {bit}}}', True)]
        values = np.full((2, 6, 8), 200 if name == "flat" else 100).astype(kind)
        with tifffile.TiffWriter(tmp_path / f"{name}.tif") as file:
            for value in values:
                file.write(value, photometric="minisblack", metadata=None, extratags=tags)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        options = {"layout": "projections", "find_bad_pixels": False}
        opened(tmp_path / "views.tif", flat=str(tmp_path / "flat.tif"), **options)
    assert any("by its bits" in str(one.message) for one in caught) is warned


@pytest.mark.parametrize("level", [-0.5, -1e-3, 0.0])
def test_zingers_are_found_in_light_below_the_dark_field(level):
    """Of a dark field from another exposure: noise about a negative level has no end of peaks where
    these are relative to their neighbours.
    """
    noise = torch.randn(1, 24, 32, generator=torch.Generator().manual_seed(0))
    assert not zingers(level + 1e-3 * noise).any()


@pytest.mark.parametrize("axes", ["TXY", "YXT"])
def test_axes_of_tifffile_and_scifio_are_compared(axes, tmp_path):
    views = np.full((4, 6, 8), 100, "u2")
    options = {"photometric": "minisblack"}
    tifffile.imwrite(tmp_path / "a.tif", views, metadata={"axes": axes}, **options)
    with pytest.raises(Refused, match=f"axes YX last, got '{axes}'"):
        opened(tmp_path / "a.tif", flat=200.0)
    tifffile.imwrite(tmp_path / "a.tif", views, metadata={"axes": "TYX"}, **options)
    opened(tmp_path / "a.tif", flat=200.0, find_bad_pixels=False)
    tifffile.imwrite(tmp_path / "a.tif", views, metadata={"axes": "YTX"}, **options)
    assert list(open_projections(tmp_path / "a.tif").unknown) == ["axes=YTX"]  # of sinograms
    text = "SCIFIO=0.37\naxes=Y,X,Time\nlengths=6,8,4\nimages=4\n"
    tifffile.imwrite(tmp_path / "a.tif", views, description=text, metadata=None, **options)
    with pytest.raises(Refused, match="SCIFIO's axes X,Y first, got 'Y,X,Time'"):
        opened(tmp_path / "a.tif", flat=200.0)


@pytest.mark.parametrize(
    ("labels", "named"),
    [
        (["view_0", "view_1", "view_10", "view_2"], "order of images, 'view_10' before 'view_2'"),
        (["dark_0", "view_0", "view_1", "view_2"], "image 'dark_0'"),
        (["view_1", "view_2", "view_10", "view_11"], None),
        (["tilt -60", "tilt -57", "tilt -1.5", "tilt 3"], None),
    ],
)
def test_labels_of_images_are_compared_with_their_order(labels, named, tmp_path):
    """ImageJ's labels of slices, and names of pages."""
    views = np.full((4, 6, 8), 100, "u2")
    tifffile.imwrite(tmp_path / "a.tif", views, imagej=True, metadata={"Labels": labels})
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        for view, label in zip(views, labels, strict=True):
            tags = [(285, "s", 0, label, True)]
            file.write(view, photometric="minisblack", metadata=None, extratags=tags)
    for name in ("a.tif", "b.tif"):
        stack = open_projections(tmp_path / name)
        assert list(stack.unknown) == ([] if named is None else [named])


def test_unknown_keys_of_a_file_of_bad_pixels_are_named(tmp_path):
    np.save(tmp_path / "views.npy", np.full((3, 6, 8), 100, "u2"))
    mask, text = np.zeros((6, 8), "u1"), "rows flipped"
    tifffile.imwrite(tmp_path / "mask.tif", mask, description=text, metadata=None)
    with pytest.warns(UserWarning, match="mask.tif: .* ImageDescription: rows flipped"):
        opened(tmp_path / "views.npy", flat=200.0, bad_pixels=str(tmp_path / "mask.tif")).whole()
