"""Whatever form a scan has on disk, its views are the same numbers in the same order."""

import os
import struct
import warnings
import zlib

import h5py
import numpy as np
import pytest
import SimpleITK as sitk
import torch
from PIL import Image as Pillow

from mvrecon.core import machine as memory
from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.projections.ordering import ordered
from mvrecon.data.projections.png import INTERLACED, PLAIN
from mvrecon.data.volume_files import read_volume
from tests.data.projections.conftest import FORMS, VIEWS, dicom_image, grey, images


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_scan_has_the_same_views(form, tmp_path):
    values = grey()
    stack = open_projections(FORMS[form](tmp_path, values))
    assert (stack.n_views, stack.shape) == (VIEWS, values.shape[1:])
    expected = torch.from_numpy(values.astype("f4"))
    assert torch.equal(stack.read(0, VIEWS), expected)
    assert torch.equal(stack.read(9, 11), expected[9:11])  # view_10 follows view_9
    assert torch.equal(torch.cat(list(stack.chunks(pixels=100))), expected)
    mean, parts = stack.mean()
    assert torch.allclose(mean, expected.double().mean(dim=0).float())
    for i, rows in enumerate((slice(0, 2), slice(1, 3), slice(3, 5), slice(4, 6))):  # six rows
        columns = expected[:, rows].unflatten(2, (4, 2))
        assert torch.allclose(parts[:, i], columns.mean(dim=(1, 3)))
    assert len(set(stack.names)) == VIEWS
    with pytest.raises(IndexError, match=f"within 0 to {VIEWS}, got 11 to 13"):
        stack.read(11, 13)


@pytest.mark.parametrize("kind", ["i2", "u1", "f4"])
def test_pixels_of_other_types_keep_their_values(kind, tmp_path):
    values = (grey() % 101).astype(kind)
    if kind != "u1":
        values[0] = -values[0]
    for form in ("tif", "npy", "mha"):
        (tmp_path / form).mkdir()
        stack = open_projections(FORMS[form](tmp_path / form, values))
        assert np.array_equal(stack.read(0, VIEWS).numpy(), values.astype("f4"))


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "i4", "u4", "f4"])
def test_a_tiff_of_any_type_keeps_its_values_and_its_greatest_one(kind, tmp_path):
    """SimpleITK writes the TIFF and reads it, as the second reader."""
    ends = [-2.5, 7.25] if kind == "f4" else [np.iinfo(kind).min, np.iinfo(kind).max]
    values = np.array([[0, 1, 2], [3, *ends]], kind)
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / "a.tif"))
    assert np.array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "a.tif"))), values)
    stack = open_projections(tmp_path / "a.tif")
    assert np.array_equal(stack.read(0, 1)[0].numpy(), values.astype("f4"))
    assert stack.top == (None if kind == "f4" else ends[1])


@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize("kind", ["u1", "u2"])
def test_a_png_without_its_last_rows_is_refused(kind, interlaced, tmp_path):
    values = np.full((6, 5), 200, kind)
    path, passes = tmp_path / "a.png", INTERLACED if interlaced else PLAIN
    parts = [values[y::down, x::right] for x, y, right, down in passes]
    rows = [b"\0" + row.astype(f">{kind}").tobytes() for part in parts for row in part if row.size]
    for count in (len(rows), len(rows) - 1):
        path.write_bytes(png(values, b"".join(rows[:count]), interlaced))
        if count == len(rows):
            assert np.array_equal(np.asarray(Pillow.open(path)), values)
            assert np.array_equal(open_projections(path).read(0, 1)[0].numpy(), values)
            continue
        with pytest.raises(Refused, match="expected .* bytes of 6 x 5 pixels, got"):
            open_projections(path).read(0, 1)


ORIENTED = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0"
CHUNKS = {
    "pCAL": b"cal\0" + struct.pack(">iiBB", 0, 255, 0, 2) + b"mV\0" + b"0\0" + b"10",
    "acTL": struct.pack(">II", 2, 0),
    "eXIf: Orientation": ORIENTED,
    "": ORIENTED.replace(b"\0\x03\0\0\0\0\0\0", b"\0\x01\0\0\0\0\0\0"),
}


@pytest.mark.parametrize("key", CHUNKS)
def test_chunks_of_a_png_that_change_its_pixels_are_refused_by_name(key, tmp_path):
    """A calibration, further frames, another order of rows and columns; the usual order is read."""
    values, path = grey()[0], tmp_path / "a.png"
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    data, name, content = png(values, raw, False), key[:4] or "eXIf", CHUNKS[key]
    head = struct.pack(">I", len(content)) + name.encode() + content
    path.write_bytes(data[:33] + head + struct.pack(">I", zlib.crc32(head[4:])) + data[33:])
    if not key:
        assert np.array_equal(open_projections(path).read(0, 1)[0], values)
        return
    with pytest.raises(Refused, match=key):
        open_projections(path)


def png(values, raw, interlaced):
    """A PNG of the size of some values, of these bytes."""
    rows, columns = values.shape
    head = struct.pack(">IIBBBBB", columns, rows, 8 * values.itemsize, 0, 0, 0, interlaced)
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(raw)), (b"IEND", b"")]
    chunks = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.mark.parametrize("turned", range(2, 9))
def test_a_tiff_with_a_rotated_orientation_is_refused(turned, tmp_path):
    """A TIFF whose Orientation turns or mirrors it is refused."""
    Pillow.fromarray(grey()[0]).save(tmp_path / "a.tif", tiffinfo={274: turned})
    with pytest.raises(
        Refused, match=f"Orientation 1, got {turned}: the first pixel is at the upper left"
    ):
        open_projections(tmp_path / "a.tif")
    Pillow.fromarray(grey()[0]).save(tmp_path / "a.tif", tiffinfo={274: 1})
    assert np.array_equal(open_projections(tmp_path / "a.tif").read(0, 1)[0].numpy(), grey()[0])


@pytest.mark.parametrize("layout", [{}, {"chunks": (1, 6, 8)}])
def test_a_views_h5_with_unwritten_data_is_refused(layout, tmp_path):
    with h5py.File(tmp_path / "views.h5", "w") as file:
        file.create_dataset("views", (3, 6, 8), "f4", **layout)
        file["padding"] = np.zeros(10_000)
    with pytest.raises(Refused, match="0 of its 576 bytes|for the chunk"):
        open_projections(tmp_path / "views.h5").read(0, 3)


@pytest.mark.parametrize("ending", ["mha", "npy"])
def test_only_the_requested_views_are_in_memory(ending, tmp_path):
    """512 MiB of views on disk, of which one is read."""
    path, shape = tmp_path / f"large.{ending}", (512, 512, 1024)
    if ending == "npy":
        np.lib.format.open_memmap(path, mode="w+", dtype="u2", shape=shape)
    else:
        head = "ObjectType = Image\nNDims = 3\nElementType = MET_USHORT\n"
        head += "DimSize = 1024 512 512\nElementDataFile = LOCAL\n"
        with path.open("wb") as file:
            file.write(head.encode())
            file.truncate(len(head) + 2 * 2**28)
    stack = open_projections(path)
    stack.read(0, 1)
    before = memory.peak() or 0
    assert stack.read(300, 302).shape == (2, 512, 1024)
    assert (memory.peak() or 0) - before < 2**26


@pytest.mark.parametrize("ending", ["mha", "mhd", "nrrd"])
def test_an_image_of_two_axes_is_one_view_and_no_volume(ending, tmp_path):
    """A flat field that SimpleITK writes beside the projections, with its pixel size."""
    image = sitk.GetImageFromArray(grey()[0])
    image.SetSpacing((0.5, 0.25))
    image.SetOrigin((-1.0, 2.0))
    sitk.WriteImage(image, str(path := tmp_path / f"flat.{ending}"))
    stack = open_projections(path)
    assert np.array_equal(stack.read(0, 1)[0], grey()[0])
    assert (stack.n_views, stack.pixel_mm) == (1, (0.25, 0.5))
    with pytest.raises(Refused, match="expected three axes"):
        read_volume(path)


def test_numbers_in_names_decide_the_order(tmp_path):
    for names in (
        ["p9", "p10", "p11"],
        ["a1_b2", "a1_b10", "a2_b2", "a2_b10"],
        ["0007", "8", "09"],
        ["image 98", "image 99", "image100"],  # aligned by blanks
        ["im   9 a", "im  10 a", "im  11 a"],
    ):
        paths = [tmp_path / f"{name}.tif" for name in names]
        assert ordered(paths[::-1]) == paths
    steps = [tmp_path / f"{k}.tif" for k in (0, 4, 8, 12)]
    assert ordered(steps[::-1]) == steps
    assert ordered([*steps, tmp_path / "14.tif"], gaps=True)[-1].name == "14.tif"


def test_decimals_in_names_decide_the_order(tmp_path):
    for names in (
        ["p_0.0", "p_0.25", "p_0.5", "p_0.75"],
        ["p_0", "p_0.5", "p_1", "p_1.5"],
        ["p0_0.0", "p1_0.333", "p2_0.667", "p3_1.0"],
        [f"p_{360 / 7 * k:.2f}" for k in range(7)],
        ["p1.9", "p1.10", "p1.11"],  # 1.10 is no decimal beside 1.9
        ["1.2.9", "1.2.10", "1.2.11"],
        ["p_.25", "p_.5", "p_.75"],
        ["p_8.5", "p_9.5", "p_10.5"],
        [f"p_{k / 2:.1f}_{k / 4:.2f}" for k in range(5)],  # of several places each
        [f"{row}.{k}" for row in (1, 2, 3) for k in range(1, 10)],  # a table: no 2.0 is missing
        [f"a{row}.{k} b" for row in (0, 1) for k in range(3)],
        [f"{row}.{k:02}" for row in (9, 10) for k in range(1, 12)],
    ):
        paths = [tmp_path / f"{name}.tif" for name in names]
        assert ordered(paths[::-1]) == paths


@pytest.mark.parametrize(
    ("name", "warned"),
    [
        ("s_{angle:03}_{k:04}", True),
        ("s1_{angle}_{k}", True),
        ("{energy}_{k:04}", True),
        ("s_{k:04}_{angle:03}", False),
        ("s_{k:04}_{energy}", False),
        ("s_{ms}_{k}", False),
    ],
)
def test_a_counter_in_another_order_than_the_first_number_is_named(name, warned, tmp_path):
    """As of angles beyond a turn before the number of the view. Also tried: turns, random names."""
    names = [name.format(k=k, angle=25 * k % 360, energy=1 + k % 2, ms=41 * k) for k in range(24)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ordered([tmp_path / f"{name}.tif" for name in names])
    assert ["a later one does not run" in str(one.message) for one in caught] == [True] * warned


@pytest.mark.parametrize(
    "names",
    [
        ["p_0.0", "p_0.25", "p_0.75"],
        ["p_0.00", "p_0.25", "p_1.00", "p_1.25"],
        ["p_0.5", "p_1.0", "p_2.0", "p_2.5"],
        [f"{row}.{k}" for row in (1, 2) for k in range(1, 10)][:-1],
        [f"{row}.{k}" for row in (1, 3) for k in range(1, 10)],
        ["p_0.1", "p_0.2", "p_0.4"],
        ["p1.8", "p1.9", "p1.11"],
        ["a1_1", "a1_2", "a1_3", "a2_1", "a2_3"],
        ["a1_1", "a1_3", "a1_4", "a2_1", "a2_3", "a2_4"],
        ["a1_1", "a1_2", "a3_1", "a3_2", "a4_1", "a4_2"],
        ["a1_t3", "a2_t5", "a4_t6"],
    ],
)
def test_a_view_missing_among_decimals_or_pairs_of_numbers_is_reported(names, tmp_path):
    """Names with decimals or several numbers, one of which is missing, are refused."""
    paths = [tmp_path / f"{name}.tif" for name in names]
    with pytest.raises(Refused, match="is a file missing"):
        ordered(paths)
    assert sorted(ordered(paths, gaps=True)) == sorted(paths)


@pytest.mark.parametrize(
    ("names", "warned"),
    [
        (["s1.11", "s1.8", "s1.9"], True),
        (["s1.1", "s1.11", "s1.13", "s1.3"], True),
        (["a_0.25", "a_0.5", "a_1.75"], True),
        (["a_0.25", "a_0.5", "a_0.75", "a_1.0"], False),
        (["a_2.36", "a_6.19", "a_11.02"], False),
        (["a_1", "a_3", "a_11"], False),
    ],
)
def test_decimals_that_may_be_two_numbers_are_named_where_no_steps_tell_them(
    names, warned, tmp_path
):
    """With gaps that are allowed; s1.11 may be the image 11 of the scan 1."""
    paths = [tmp_path / f"{name}.tif" for name in names]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert ordered(paths[::-1], gaps=True) == paths
    assert ["taken for decimals" in str(one.message) for one in caught] == [True] * warned


@pytest.mark.parametrize("name", ["view_4.tif", "view_4.TIFF", "4.png", "4.dcm", "4.his"])
def test_a_link_to_a_view_that_was_not_fetched_is_refused(name, tmp_path):
    """As in repositories of large files: without the last view, all others have other angles."""
    folder = images(tmp_path / "scan", grey()[:4])
    try:
        (folder / name).symlink_to("../.git/annex/objects/a")
    except OSError:
        pytest.skip("needs symbolic links")
    with pytest.raises(FileNotFoundError, match=f"{name}: is a link to .*, which is not there"):
        open_projections(folder)
    (folder / name).rename(folder / "notes.txt")
    (folder / "._view_9.tif").symlink_to("elsewhere.tif")
    assert open_projections(folder).n_views == 4


def test_an_array_that_is_cut_short_while_it_is_read_is_refused(tmp_path):
    """Reading it would end the process; also tried: arrays in the order of Fortran, one view."""
    with (tmp_path / "a.npy").open("wb") as file:  # of one array after the other, NumPy reads one
        for view in grey():
            np.save(file, view)
    with pytest.raises(Refused, match=r"a.npy: expected one array of \d+ bytes, got \d+"):
        open_projections(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.ones((4, 64, 64), "f4"))
    stack = open_projections(tmp_path / "a.npy")
    assert stack.read(3, 4).eq(1).all()
    os.truncate(tmp_path / "a.npy", 1000)
    with pytest.raises(Refused, match=r"a.npy: expected \d+ bytes, as before, got 1000"):
        stack.read(3, 4)


def test_an_index_beside_another_number_shows_that_no_view_is_missing(tmp_path):
    paths = [tmp_path / f"a{k}_t{t}.tif" for k, t in enumerate((3, 8, 9, 17))]
    assert ordered(paths[::-1]) == paths


@pytest.mark.parametrize(
    "names",
    [
        ["tilt_-20", "tilt_-10", "tilt_0", "tilt_10"],
        ["p-1.5", "p-0.5", "p+0.5", "p+1.5"],
        ["-10", "0", "10"],
        ["s-1_-10", "s-2_0", "s-3_10"],
        ["s-1_0", "s-2_-10", "s-3_-20"],
        ["scan-1", "scan-2", "scan-10"],
        ["2021-03-05_-5", "2021-03-05_0", "2021-03-05_5"],
        ["proj_-0.5", "proj_0.5", "proj_1.5", "proj_2.5"],
        ["a_-_1", "a_-_2", "a_-_3"],
        *(
            [f"{start}-{k:0{digits}}" for k in range(9, 12)]
            for start, digits in {
                **dict.fromkeys(["Probe (A)", "sample ", "scan-", "scan_", "a=", ""], 3),
                **dict.fromkeys(["[run3]", "Dr. X.", "10%", "Schädelmaß", "Préparé", "µ"], 1),
                **{"样品": 1, "e\u0301": 1},
            }.items()
        ),
        ["-000", "-001", "-002"],
        ["p_-10_-001", "p_-5_-002", "p_0_-003"],
        ["2021-03-05", "2021-03-06", "2021-03-07"],
    ],
)
def test_a_sign_is_part_of_a_number_and_a_dash_is_not(names, tmp_path):
    """A - that some names lack before a number is its sign; one that all have is a dash.

    Also tried by hand: m10 and p10 for a sign, which are sorted as text with a warning.
    """
    paths = [tmp_path / f"{name}.tif" for name in names]
    gaps = names[0] == "scan-1"
    with warnings.catch_warnings(action="error"):
        files = ordered(paths[::-1], gaps)
    assert files == paths


@pytest.mark.parametrize(
    "names",
    [
        ["p_1e-1", "p_5e-1", "p_1e0", "p_5e0", "p_1e1"],
        ["p_1e-1", "p_2e-1", "p_3e-1"],
        ["p_5e-2", "p_1e-1", "p_1.5e-1", "p_2e-1"],
        ["p_0.0e0", "p_5.0e1", "p_1.0e2", "p_1.5e2"],
        ["1E-1", "1E+0", "1E+1"],
        ["p_-1e-1", "p_0e-1", "p_1e-1"],
        ["p_-2e-1_a", "p_-1e-1_a", "p_1e-1_a"],
        ["p_1e1", "p_1e2", "p_1e3"],
        ["proj_1e-1", "proj_5e-1"],
        [f"bone2e-{k:03}" for k in range(1, 13)],
        [f"Sample3E-{k}" for k in range(8, 12)],
        [f"x1.5e{k:02}" for k in range(1, 13)],
        ["p1e1", "p1e2", "p5e1", "p5e2"],
        *([f"{start}2e-{k}" for k in range(8, 12)] for start in ("Maß", "e\u0301", "样品")),
    ],
)
def test_numbers_with_exponents_decide_the_order(names, tmp_path):
    """That of 1e1, 1e2 and 1e3 is the same for numbers and for two numbers; behind a letter they
    are two numbers.
    """
    paths = [tmp_path / f"{name}.tif" for name in names]
    assert ordered(paths[::-1], gaps=True) == paths
    if names[0] in ("bone2e-001", "Sample3E-8", "x1.5e01"):
        assert ordered(paths[::-1]) == paths


@pytest.mark.parametrize(
    ("names", "such"),
    [
        (["p_1e1", "p_1e2", "p_5e1", "p_5e2"], "1e1"),
        (["3e9", "12e1"], "3e9"),
        (["p_0,0", "p_0,25", "p_0,5"], "0,0"),
        (["p_1,5", "p_1,25"], "1,5"),
        (["p_2,8", "p_2,9", "p_2,11"], "2,8"),
        (["p_0,5", "p_0,50", "p_0,25", "p_1,0"], "0,5"),
        (["p_0,0", "p_0,250", "p_0,5", "p_0,10"], "0,0"),
        (["a_1e1_2,9", "a_1e2_2,10", "a_5e1_2,11"], "1e1"),
    ],
)
@pytest.mark.parametrize("gaps", [False, True])
def test_numbers_that_can_be_read_in_two_orders_are_refused(names, such, gaps, tmp_path):
    """And say how to rename the files; decimals with a trailing zero are no series of integers."""
    words = f"read in one way, got {such}, which may be .* equally many digits"
    with pytest.raises(Refused, match=words):
        ordered([tmp_path / f"{name}.tif" for name in names], gaps)


@pytest.mark.parametrize(
    "names",
    [
        [f"a2,{k}" for k in range(1, 13)],
        [f"p_2,{k}" for k in range(8, 12)],
        [f"{row},{k}" for row in (1, 2) for k in range(1, 12)],
        [f"{row},{k}" for row in range(8, 11) for k in range(8, 11)],
        [f"2,{k} b" for k in range(0, 30, 5)],
        [f"a2,{k:02}" for k in range(1, 13)],
        ["p_0,00", "p_0,25", "p_0,50", "p_0,75", "p_1,00"],
        ["p_0,0", "p_0,5", "p_1,0", "p_1,5"],
        [f"1e{k}" for k in range(1, 13)],
        [f"1e{k:02}" for k in range(1, 13)],
    ],
)
def test_numbers_with_a_comma_that_are_a_series_in_one_way_are_read(names, tmp_path):
    """2,9 is followed by 2,10, which is no decimal; decimals of equally many digits, and powers of
    ten, have one order in either way.
    """
    paths = [tmp_path / f"{name}.tif" for name in names]
    assert ordered(paths[::-1]) == paths


@pytest.mark.parametrize(
    "names",
    [
        ["p_-10.5", "p_-1.5", "p_-0.5"],
        ["tilt_-30", "tilt_-20", "tilt_-10"],
        ["-3", "-2", "-1"],
        ["a=-2 b", "a=-1 b"],
        ["p_-.75", "p_-.5", "p_-.25"],
    ],
)
def test_numbers_that_are_all_negative_are_named(names, tmp_path):
    """A - behind a separator is a sign, though all names have it; in scan-001 it is a dash."""
    paths = [tmp_path / f"{name}.tif" for name in names]
    with pytest.warns(UserWarning, match="are taken to be negative"):
        assert ordered(paths[::-1], gaps=True) == paths


@pytest.mark.parametrize("others", [["scan~00"], ["scan_spr"], ["ob_1", "ob_2"], ["refHST0000"]])
def test_images_that_may_be_no_views_are_refused_by_name(others, tmp_path):
    """References and previews of SkyScan, neutron beamlines and the ESRF among the views, wherever
    they are sorted; chosen by a pattern, they are views, with a warning.
    """
    paths = [tmp_path / f"{name}.tif" for name in [*(f"scan{k:04d}" for k in range(9)), *others]]
    with pytest.raises(Refused, match="choose the views by pattern=") as caught:
        ordered(paths)
    few = f"{len(others)} such as {others[0]}.tif"
    assert "9 such as scan0000.tif" in str(caught.value) and few in str(caught.value)
    with pytest.warns(UserWarning, match="9 such as scan0000.tif"):
        assert sorted(ordered(paths, mixed=True)) == sorted(paths)


def test_the_instance_number_of_dicom_views_decides_their_order(tmp_path):
    values = grey()
    for k, view in enumerate(values):
        name = f"view_{(5 * k) % VIEWS}.dcm"
        dicom_image(tmp_path / name, view, InstanceNumber=k + 1)
    expected = torch.from_numpy(values.astype("f4"))
    assert torch.equal(open_projections(tmp_path).read(0, VIEWS), expected)
    for k, view in enumerate(values):  # all the same: names decide
        dicom_image(tmp_path / f"view_{k}.dcm", view, InstanceNumber=1)
    with pytest.warns(UserWarning, match="have no InstanceNumbers of their own"):
        assert torch.equal(open_projections(tmp_path).read(0, VIEWS), expected)


@pytest.mark.parametrize("number", [2, None])
def test_dicom_views_without_distinct_numbers_are_refused(number, tmp_path):
    """DICOM projections with an InstanceNumber twice, or without one in some files, are refused."""
    for k, view in enumerate(grey()):
        dicom_image(tmp_path / f"view_{k}.dcm", view, InstanceNumber=k + 1)
    dicom_image(tmp_path / "view_0.dcm", grey()[0], InstanceNumber=number)
    with pytest.raises(Refused, match=f"InstanceNumber of its own for each view, got {number} in"):
        open_projections(tmp_path)


def test_two_dicom_series_are_refused_as_a_scan(tmp_path):
    """DICOM projections of two series in one folder are refused until a pattern names one; series
    of a single exposure each are one scan.
    """
    for k, view in enumerate(grey()):
        name = f"{'ab'[k % 2]}_{k // 2}.dcm"
        dicom_image(tmp_path / name, view, InstanceNumber=k, SeriesInstanceUID=f"1.2.{k % 2}")
    with pytest.raises(Refused, match="of one series, got 2 series in 12 files; choose by pattern"):
        open_projections(tmp_path)
    one = open_projections(tmp_path, pattern="b_*")
    assert torch.equal(one.read(0, 6), torch.from_numpy(grey()[1::2].astype("f4")))
    for k, view in enumerate(grey()):
        name = f"{'ab'[k % 2]}_{k // 2}.dcm"
        dicom_image(tmp_path / name, view, InstanceNumber=k, SeriesInstanceUID=f"1.2.{k}")
    whole = open_projections(tmp_path)
    assert torch.equal(whole.read(0, VIEWS), torch.from_numpy(grey().astype("f4")))


def test_a_dicom_view_that_is_missing_by_its_instance_number_is_refused(tmp_path):
    """DICOM projections among whose InstanceNumbers one is missing are refused, but with gaps."""
    for k, view in enumerate(grey()):
        if k != 4:
            dicom_image(tmp_path / f"{k if k < 4 else k - 1}.dcm", view, InstanceNumber=k)
    with pytest.raises(Refused, match="equal steps, got 3 and then 5"):
        open_projections(tmp_path)
    assert open_projections(tmp_path, gaps=True).n_views == VIEWS - 1
