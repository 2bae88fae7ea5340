"""Invalid scans are refused with a message, or reported by a warning with numbers."""

import shutil
import warnings

import h5py
import numpy as np
import pytest
import torch
from PIL import Image as Pillow

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections import images as image_module
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.projections.views import Measured
from tests.data.projections.conftest import (
    VIEWS,
    array,
    dicom_image,
    grey,
    images,
    many_pages,
    opened,
)


def field(folder, name, values):
    Pillow.fromarray(np.asarray(values, "u2")).save(folder / f"{name}.tif")


def cut(path, size):
    path.write_bytes(path.read_bytes()[:size])
    return path


@pytest.mark.parametrize("dark", [0, 300])
def test_a_zero_flat_field_is_refused(dark, scan):
    """A flat field that is not above the dark one is refused, with both medians."""
    field(scan, "flat", np.full((6, 8), dark))
    field(scan, "dark", np.full((6, 8), dark))
    with pytest.raises(Refused, match=rf"flat field above the dark one, got .*{dark} and {dark}"):
        opened(scan)


def test_intensities_need_a_flat_field(tmp_path):
    """Grey values without a flat field are refused, with the option that sets one."""
    folder = images(tmp_path / "scan", grey())
    with pytest.raises(Refused, match="expected a flat field for intensities; give flat="):
        opened(folder)
    with pytest.raises(Refused, match=r"flat field of the views' \(6, 8\) pixels, got \(3, 8\)"):
        np.save(tmp_path / "flat.npy", np.ones((3, 8)))
        opened(folder, flat=str(tmp_path / "flat.npy"))


def test_the_kind_of_floats_is_not_guessed(tmp_path):
    """Floats that may be grey values or line integrals are refused until the kind is specified, as
    are integers as line integrals.
    """
    np.save(tmp_path / "a.npy", np.ones((2, 4, 4), "f4"))
    np.save(tmp_path / "b.npy", np.ones((2, 4, 4), "u2"))
    with pytest.raises(
        Refused, match="expected kind=integrals or kind=intensities .views.kind. for .*float32"
    ):
        opened(tmp_path / "a.npy")
    with pytest.raises(Refused, match="expected floats for line integrals, got pixels of uint16"):
        opened(tmp_path / "b.npy", kind="integrals")
    with pytest.raises(ValueError, match="integrals, counts, intensities, got 'grey'"):
        Measured(path="a.npy", kind="grey")  # type: ignore[arg-type]


def test_dark_pixels_count_as_the_floor_and_are_counted(scan):
    """The logarithm of nothing is not taken: such pixels count as the floor, with their number."""
    values = grey()[3]
    values[2, 1:4] = (100, 90, 103)  # at, below and just above the dark field
    Pillow.fromarray(values).save(scan / "view_3.tif")
    with pytest.warns(UserWarning, match="3 pixels of 12 views have a transmission of at most"):
        back = opened(scan).whole()
    assert back.odd["floored"] == 3 and back.views.isfinite().all()
    assert torch.allclose(back.views[3, 2, 1:4], torch.tensor(1e4).log())


def test_a_view_without_light_is_refused(scan):
    """A view that is dark everywhere is refused with its name."""
    field(scan, "view_7", np.full((6, 8), 90))
    with pytest.raises(Refused, match=r"expected light in every view, got none .* in view_7"):
        opened(scan).read(6, 9)


def test_saturated_and_dead_pixels_are_reported_and_masked(scan):
    """Saturated and dead pixels are reported with their number and excluded by the mask."""
    flat = np.full((6, 8), 60_100)
    flat[1, 1] = flat[4, 6] = 110
    field(scan, "flat", flat)
    values = grey()[5]
    values[0, 0:3] = 65_535
    Pillow.fromarray(values).save(scan / "view_5.tif")
    with (
        pytest.warns(UserWarning, match="2 of 48 pixels are dead"),
        pytest.warns(UserWarning, match="3 pixels of 12 views are saturated .*65535 or more"),
    ):
        back = opened(scan).whole()
    expected = torch.ones(VIEWS, 6, 8, dtype=torch.bool)
    expected[:, 1, 1] = expected[:, 4, 6] = expected[5, 0, 0:3] = False
    assert torch.equal(back.mask, expected) and back.views.isfinite().all()
    with pytest.warns(UserWarning):
        joined = opened(scan, binning=2).whole()
    assert torch.equal(joined.mask, expected.reshape(VIEWS, 3, 2, 4, 2).all(dim=4).all(dim=2))
    field(scan, "flat", np.full((6, 8), 65_535))
    with pytest.raises(
        Refused, match="expected at least half of the pixels between dark and satur"
    ):
        opened(scan)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_that_are_not_finite_are_refused(value, tmp_path):
    """A pixel that is NaN or infinite is refused with the number and the name of its view."""
    values = grey().astype("f4")
    values[4, 2, 2] = value
    for form in ("a.npy", "a.h5", "a.mha"):
        stack = open_projections(array(tmp_path / form, values))
        assert stack.read(0, 4).isfinite().all()
        with pytest.raises(Refused, match=r"1 that are NaN or infinite in view 4 \("):
            stack.read(3, 6)


@pytest.mark.parametrize("size", [60, 150, 200])
def test_a_truncated_image_is_refused(size, scan):
    """A TIFF that is cut short is refused with its name, wherever it is cut."""
    cut(scan / "view_10.tif", size)
    with pytest.raises(Refused, match=r"view_10\.tif: "):
        open_projections(scan).read(0, VIEWS)


@pytest.mark.parametrize("form", ["a.npy", "a.mha", "a.mhd", "a.nrrd", "a.h5", "a.tiff", "a.dcm"])
def test_a_truncated_stack_is_refused(form, tmp_path):
    """A stack of views that is cut short is refused with its name, in every format."""
    values, path = grey(), tmp_path / form
    if form == "a.tiff":
        many_pages(path, values)
    elif form == "a.dcm":
        dicom_image(path, values)
    else:
        array(path, values)
    large = path.with_suffix(".raw") if form == "a.mhd" else path
    for part in (0.98, 0.7, 0.4):
        cut(large, int(part * large.stat().st_size))
        with pytest.raises(Refused, match=rf"{form}: "):
            open_projections(path).read(0, VIEWS)


def test_images_of_several_sizes_are_refused(scan, tmp_path):
    """Images of several sizes, types or formats in one scan are refused, with the file."""
    values = grey()[0]
    Pillow.fromarray(values[:, :7]).save(scan / "view_4.tif")
    with pytest.raises(Refused, match=r"view_4\.tif: expected 6 x 8 pixels .* got 6 x 7 pixels"):
        open_projections(scan)
    Pillow.fromarray(values.astype("f4")).save(scan / "view_4.tif")
    with pytest.raises(Refused, match=r"view_4\.tif: expected .* of uint16 .*got .* of float32"):
        open_projections(scan)
    Pillow.fromarray(values).save(scan / "view_4.png")
    with pytest.raises(Refused, match="those of PNG and TIFF; choose by pattern="):
        open_projections(scan)
    Pillow.fromarray(values).save(scan / "view_4.tif")
    chosen = opened(scan, pattern="*.tif")  # dark and flat are no views
    assert chosen.n_views == VIEWS and chosen.whole().views.isfinite().all()
    pages = [Pillow.fromarray(values), Pillow.fromarray(values[:3])]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    with pytest.raises(Refused, match="on every page, got 3 x 8 pixels of uint16 on page 1"):
        open_projections(tmp_path / "a.tif")


def test_pixels_that_are_not_grey_values_are_refused(tmp_path):
    """Colours, complex numbers, truth values and Python objects are refused as views."""
    Pillow.fromarray(np.zeros((4, 4, 3), "u1")).save(tmp_path / "a.png")
    with pytest.raises(Refused, match="colour type 0, got 2: grey values"):
        open_projections(tmp_path / "a.png")
    for kind in ("c8", "?"):
        np.save(tmp_path / "a.npy", np.ones((2, 4, 4), kind))
        with pytest.raises(Refused, match="expected pixels that are integers or floats, got"):
            open_projections(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.array([[[None]]]), allow_pickle=True)
    with pytest.raises(Refused, match=r"a\.npy: cannot be read as a NumPy array"):
        open_projections(tmp_path / "a.npy")


def test_a_missing_view_is_reported(scan):
    """A missing view number is reported, unless gaps are allowed."""
    (scan / "view_6.tif").unlink()
    with pytest.raises(Refused, match="numbered in equal steps, got 5 and then 7; is a file missi"):
        open_projections(scan)
    assert open_projections(scan, gaps=True).n_views == VIEWS - 1
    field(scan, "view_06", np.ones((6, 8)))
    field(scan, "view_6", np.ones((6, 8)))
    with pytest.raises(Refused, match="one file of every number, got 'view_06.tif' and 'view_6.ti"):
        open_projections(scan)


def test_an_order_without_numbers_is_reported(scan):
    """View names that differ in more than their numbers are refused, or as chosen by a pattern
    reported with the resulting order.
    """
    (scan / "view_3.tif").rename(scan / "front.tif")
    with pytest.raises(Refused, match=r"1 such as front\.tif and 11 such as view_0\.tif; choose"):
        open_projections(scan)
    with pytest.warns(UserWarning, match=r"more than their numbers; .*text: front\.tif, view_0"):
        assert open_projections(scan, pattern="*").names[0] == "front"


def test_fields_as_octopus_names_them_are_applied(scan):
    """Dark fields di0001 and flat fields io0001 beside the views, which may have any name; views of
    which all have such a name are no fields of themselves.
    """
    expected = opened(scan).whole().views
    (scan / "dark.tif").rename(scan / "di0001.tif")
    (scan / "flat.tif").rename(scan / "IO0001.tif")
    assert torch.equal(opened(scan).whole().views, expected)
    for name in ("io", "flatpanel"):
        folder = images(scan / name, grey())
        for path in folder.iterdir():
            path.rename(folder / path.name.replace("view_", name))
        assert open_projections(folder).n_views == VIEWS
        with pytest.raises(Refused, match="expected a flat field"):
            opened(folder)


def test_an_empty_folder_is_reported(tmp_path, monkeypatch):
    """An empty folder, a missing path, a wrong file extension and too many files are reported as
    such.
    """
    (tmp_path / "notes.txt").write_text("no view")
    with pytest.raises(
        Refused, match=r"expected images \(TIFF, PNG, DICOM or of RTK.*\), got none"
    ):
        open_projections(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such file or folder; expected a folder of TI"):
        open_projections(tmp_path / "nowhere")
    with pytest.raises(Refused, match=r"notes\.txt: expected a folder of TIFF"):
        open_projections(tmp_path / "notes.txt")
    images(tmp_path / "scan", grey())
    with pytest.raises(Refused, match="has no names like '/etc/.*expected such as scan_"):
        open_projections(tmp_path / "scan", pattern="/etc/*")
    with pytest.raises(Refused, match=r"expected images named b_\* .*got none"):
        open_projections(tmp_path / "scan", pattern="b_*")
    monkeypatch.setattr(image_module, "VIEWS", 5)
    with pytest.raises(Refused, match="expected at most 5 images, got more"):
        open_projections(tmp_path / "scan")


def test_an_h5_of_another_layout_is_refused(tmp_path):
    """An HDF5 file without our views is refused, with its contents and the expected ones."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["exchange"] = np.ones((2, 3, 4), "f4")
    with pytest.raises(Refused, match=r"NXtomo.* got none; it contains /exchange \(2, 3, 4\)"):
        open_projections(path)
    with h5py.File(path, "w") as file:
        file["views"] = np.ones((3, 4), "f4")
        file["views"].attrs["unit"] = "1/mm * mm"
    with pytest.raises(Refused, match=r"has float32 \(3, 4\); expected the views\.h5"):
        open_projections(path)
    path.write_bytes(b"no HDF5")
    with pytest.raises(Refused, match=r"a\.h5: not an HDF5 file, or cut short"):
        open_projections(path)


@pytest.mark.parametrize("kind", ["f4", "f8", "u2"])
def test_views_in_hdf5_without_a_unit_are_those_of_another_program(kind, tmp_path):
    """Transmissions in a data set that is called as ours are not taken for line integrals: as of
    frames of any name, the kind of floats is asked for, and integers are intensities.
    """
    values = np.full((2, 3, 4), 0.5 if kind != "u2" else 20_000, kind)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["views"] = values
    if kind != "u2":
        with pytest.raises(Refused, match=r"expected kind=integrals or kind=intensities"):
            opened(tmp_path / "a.h5")
        assert np.array_equal(opened(tmp_path / "a.h5", kind="integrals").whole().views, values)
    found = opened(tmp_path / "a.h5", kind="intensities", flat=2.0 * float(values[0, 0, 0]))
    assert np.allclose(found.whole().views, np.log(2))
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["views"].attrs["unit"] = "1/mm * mm"
    if kind == "f4":
        assert opened(tmp_path / "a.h5").kind == "integrals"


def test_views_of_another_program_have_angles_by_name(tmp_path):
    """As frames of any name: a data set views is found without views.dataset also if the angles or
    the keys of the frames are named.
    """
    values = np.random.default_rng(2).uniform(0.5, 1, (4, 3, 5)).astype("f4")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["views"], file["theta"], file["keys"] = values, [0.0, 0, 60, 120], [1, 0, 0, 0]
    for names in ({"angles": "/theta"}, {"angles": "/theta", "image_key": "keys"}):
        stack = open_projections(tmp_path / "a.h5", **names)
        first = len(names) - 1
        assert np.array_equal(stack.read(0, 4 - first).numpy(), values[first:])
        assert stack.rig["angles"] == [0.0, 0.0, 60.0, 120.0][first:]


OUTSIDE = [
    "../a.raw",
    "/etc/passwd",
    "in/../../a.raw",
    "in/../a.raw",
    "link/a.raw",
    "link.raw",
    "a" * 300,
]


@pytest.mark.parametrize("name", [*OUTSIDE, "gone.raw", "in", "./a.raw", "in/a.raw", "./in/a.raw"])
def test_the_data_of_a_header_is_in_its_folder_or_below(name, tmp_path):
    """An MHD header that leads to another folder, through a link, or to no file, is refused."""
    (tmp_path / "scan" / "in").mkdir(parents=True)
    path = array(tmp_path / "scan" / "a.mhd", grey())
    for folder in (tmp_path, path.parent / "in"):
        shutil.copy(path.with_name("a.raw"), folder)
    (path.parent / "link").symlink_to(path.parent / "in")
    (path.parent / "link.raw").symlink_to(path.parent / "a.raw")
    path.write_text(path.read_text().replace("a.raw", name))
    if name in ("./a.raw", "in/a.raw", "./in/a.raw"):
        assert np.array_equal(open_projections(path).read(0, VIEWS), grey())
    else:
        error = Refused if name in OUTSIDE else FileNotFoundError
        with pytest.raises(error, match="in its folder or below|no such file; expected the val"):
            open_projections(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rows": [2, 7]}, r"rows as \[first, behind the last\] within 0 to 6, got \[2, 7\]"),
        ({"columns": [5, 5]}, "columns as .* within 0 to 8"),
        ({"binning": 4}, r"divides the 6 rows and 8 columns, got \(4, 4\); rows="),
        ({"binning": [0, 1]}, "one or two positive integers"),
        ({"floor": 0}, "floor between 0 and 1"),
        ({"saturation": -1}, "positive saturation"),
        ({"every": 0}, "every from 1 on"),
    ],
)
def test_options_of_views_out_of_range_are_refused(options, message, scan):
    """Rows, columns, binning and thresholds of views out of range are refused with their range."""
    with pytest.raises(ValueError, match=message):
        opened(scan, **options)


def test_a_valid_scan_raises_no_warning(scan):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(scan).whole()
