"""Beamlines' HDF5: NXtomo, Data Exchange, any data set; links stay in the folder."""

import re
import warnings

import h5py
import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data import storage
from mvrecon.data.projections.nexus import EXPECTED, hdf5_views
from tests.data.projections.conftest import COLUMNS, ROWS, VIEWS, grey, opened

#: Flats and darks before and behind the views, one frame invalid, one of alignment.
KEYS = np.array([1, 2, *[0] * 5, 3, *[0] * 7, 2, 1, 1, -1])
FLAT, DARK = 60_000, 300
ANGLES = np.linspace(0, 180, VIEWS)


def frames():
    """All frames with the views of `grey` where the key is zero."""
    values = np.full((len(KEYS), ROWS, COLUMNS), 7, "u2")
    values[KEYS == 0], values[KEYS == 1], values[KEYS == 2] = grey(), FLAT, DARK
    values[1] += 10  # the mean of two dark fields counts
    values[-4] -= 10
    return values


def integrals():
    return -np.log((grey() - DARK) / (FLAT - DARK))


def angles():
    """The angles of all frames; no angle is needed of the fields."""
    values = np.full(len(KEYS), np.nan)
    values[KEYS == 0] = ANGLES
    return values


def tomo(path, data=None, unit=b"degrees", size=(b"um", 2.0, 3.0), **changed):
    """A file of NXtomo; further data sets by name replace its own, None leaves them out."""
    sets = {
        "instrument/detector/data": frames() if data is None else data,
        "instrument/detector/image_key_control": KEYS,
        "instrument/detector/image_key": np.where(KEYS == -1, 0, KEYS),
        "sample/rotation_angle": angles(),
        "instrument/detector/y_pixel_size": size[1],
        "instrument/detector/x_pixel_size": size[2],
        **{name.replace("__", "/"): value for name, value in changed.items()},
    }
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry")
        for name, value in sets.items():
            if value is not None:
                entry[name] = value
        for name, text in (("sample/rotation_angle", unit), ("x", size[0]), ("y", size[0])):
            name = f"instrument/detector/{name}_pixel_size" if len(name) == 1 else name
            if name in entry and text is not None:
                entry[name].attrs["units"] = (
                    text if isinstance(text, str | np.ndarray) else np.bytes_(text)
                )
    return path


def exchange(path, theta=ANGLES, **changed):
    """A file of Data Exchange."""
    sets = {"data": grey(), "data_white": np.full((2, ROWS, COLUMNS), FLAT, "u2")}
    sets |= {"data_dark": np.full((3, ROWS, COLUMNS), DARK, "u2"), "theta": theta}
    with h5py.File(path, "w") as file:
        for name, value in (sets | changed).items():
            if value is not None:
                file[f"exchange/{name}"] = value
    return path


def linked(path, target, name):
    """An NXtomo file whose frames are a link to another file."""
    tomo(path)
    with h5py.File(path, "a") as file:
        del file["entry/instrument/detector/data"]
        file["entry/instrument/detector/data"] = h5py.ExternalLink(target, name)
    return path


def other_file(path):
    """A file with the frames alone, in chunks of two frames."""
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_dataset("entry/data", data=frames(), chunks=(2, ROWS, COLUMNS), shuffle=True)
        file["soft"] = h5py.SoftLink("/entry/data")
    return path


def virtual(path):
    """An NXtomo file whose frames are virtual, of two data sets in another file."""
    half, values = len(KEYS) // 2, frames()
    with h5py.File(path.parent / "parts.h5", "w") as file:
        file["a"], file["b"] = values[:half], values[half:]
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[:half] = h5py.VirtualSource("parts.h5", "a", values[:half].shape, values.dtype)
    layout[half:] = h5py.VirtualSource("parts.h5", "b", values[half:].shape, values.dtype)
    tomo(path)
    with h5py.File(path, "a") as file:
        del file["entry/instrument/detector/data"]
        file.create_virtual_dataset("entry/instrument/detector/data", layout)
    return path


def named(path):
    """The data sets of another layout, by name."""
    with h5py.File(path, "w") as file:
        file["raw"], file["open"] = grey(), np.full((ROWS, COLUMNS), FLAT, "u2")
        file["shut"], file["turn"] = np.full((ROWS, COLUMNS), DARK, "u2"), ANGLES
    return path


LAYOUTS = {
    "NXtomo": lambda folder: (tomo(folder / "a.nxs"), {}),
    "NXtomo in texts of variable length": lambda folder: (
        tomo(folder / "a.nx", unit="deg", size=("um", 2.0, 3.0)),
        {},
    ),
    "angles of the views": lambda folder: (
        tomo(folder / "a.nxs", sample__rotation_angle=ANGLES),
        {},
    ),
    "keys and angles as rows": lambda folder: (
        tomo(
            folder / "a.nxs",
            sample__rotation_angle=angles()[None],
            instrument__detector__image_key_control=None,
            instrument__detector__image_key=np.where(KEYS == -1, 3, KEYS)[None].astype("f8"),
        ),
        {},
    ),
    "radians": lambda folder: (
        tomo(folder / "a.nxs", unit=b"rad", sample__rotation_angle=np.radians(ANGLES)),
        {},
    ),
    "linked": lambda folder: (
        linked(folder / "a.nxs", str(other_file(folder / "raw/b.h5").relative_to(folder)), "soft"),
        {},
    ),
    "linked by a path of the beamline": lambda folder: (
        linked(folder / "a.nxs", "/dls/" + other_file(folder / "b.h5").name, "/entry/data"),
        {},
    ),
    "virtual": lambda folder: (virtual(folder / "a.nxs"), {}),
    "Data Exchange": lambda folder: (exchange(folder / "a.h5"), {}),
    "named": lambda folder: (
        named(folder / "a.hdf5"),
        {"dataset": "/raw", "flat": "/open", "dark": "/shut", "angles": "/turn"},
    ),
    "named in other files": lambda folder: (
        f"{named(folder / 'a.h5')}:/raw",
        {
            "flat": str(tomo(folder / "b.nxs")),
            "dark": f"{folder / 'a.h5'}:/shut",
            "angles": f"{folder / 'b.nxs'}:/entry/sample/rotation_angle",
            "image_key": f"{named(folder / 'c.h5')}:/none",
        },
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_views_fields_and_angles_of_a_beamlines_file(layout, tmp_path):
    """Frames are sorted into views, flat and dark fields; invalid and alignment frames are no
    views; angles are those of the views, in degrees.
    """
    path, options = LAYOUTS[layout](tmp_path)
    if layout == "named in other files":
        with h5py.File(tmp_path / "c.h5", "a") as file:
            file["none"] = np.zeros(VIEWS, int)
        with h5py.File(tmp_path / "b.nxs", "a") as file:
            del file["entry/sample/rotation_angle"]
            file["entry/sample/rotation_angle"] = ANGLES
    views = opened(path, **options)
    assert views.kind == "intensities"
    expected = torch.from_numpy(integrals()).float()
    assert torch.allclose(views.whole().views, expected, atol=2e-6)
    assert torch.equal(views.read(4, 8).views, views.whole().views[4:8])
    rig = views.stack.rig
    assert rig["name"] == "parallel"
    assert np.allclose(rig["angles"], ANGLES, atol=1e-9)
    assert rig["detector"].get("pixel_mm") == ((2e-3, 3e-3) if "NXtomo" in layout else None) or (
        layout not in ("Data Exchange", "named") and rig["detector"]["pixel_mm"] == (2e-3, 3e-3)
    )


def escaping(folder):
    """A link out of the folder, by a relative path, an absolute one, and a link of the system."""
    inside = folder / "scan"
    inside.mkdir()
    outside = other_file(folder / "b.h5")
    (inside / "c.h5").symlink_to(outside)
    return [
        linked(inside / f"{k}.nxs", target, "/entry/data")
        for k, target in enumerate(("../b.h5", str(outside), "c.h5"))
    ]


def test_a_link_of_nexus_stays_in_the_files_folder(tmp_path):
    """Links to files outside of the folder are refused, whatever form they have."""
    for path in escaping(tmp_path):
        with pytest.raises(Refused, match="is not in the folder"):
            opened(path)


def test_links_that_lead_in_a_circle_are_refused(tmp_path):
    path = tomo(tmp_path / "a.nxs", instrument__detector__data=None)
    with h5py.File(path, "a") as file:
        file["entry/instrument/detector/data"] = h5py.SoftLink("/entry/again")
        file["entry/again"] = h5py.ExternalLink("a.nxs", "/entry/instrument/detector/data")
    with pytest.raises(Refused, match="at most 16 links"):
        opened(path)


REFUSED = {
    "nothing of it": (
        lambda path: other_file(path),
        r"image_key .*it contains /entry/data \(19, 6, 8\) uint16",
    ),
    "fewer angles": (
        lambda path: tomo(path, sample__rotation_angle=ANGLES[1:]),
        r"rotation_angle: expected an angle for each of 19 frames, or of 12 views, got \(11,\)",
    ),
    "fewer keys": (
        lambda path: tomo(path, instrument__detector__image_key_control=KEYS[1:]),
        "expected a key for each of 19 frames",
    ),
    "unknown keys": (
        lambda path: tomo(path, instrument__detector__image_key_control=KEYS + 3),
        "expected keys 0 .views., 1 .flat.*got",
    ),
    "radians without a unit": (
        lambda path: tomo(path, unit=None, sample__rotation_angle=np.radians(ANGLES)),
        "look like radians",
    ),
    "angles that were never filled": (
        lambda path: tomo(path, sample__rotation_angle=np.zeros(len(KEYS))),
        "expected angles that differ, got 0 in all of 12 views",
    ),
    "angles in mm": (lambda path: tomo(path, unit=b"mm"), "expected units of deg.* got 'mm'"),
    "pixels in V": (lambda path: tomo(path, size=(b"V", 1, 1)), "expected units of m.* got 'V'"),
    "NaN": (
        lambda path: tomo(path, sample__rotation_angle=ANGLES * np.nan),
        "expected finite angles of the views",
    ),
    "scaled frames": (lambda path: scaled(tomo(path)), "no attribute 'scale_factor'"),
    "two detectors": (
        lambda path: tomo(
            path, instrument__other__image_key=KEYS, instrument__other__data=frames()
        ),
        "choose by views.dataset",
    ),
    "flats of other pixels": (
        lambda path: exchange(path, data_white=np.ones((2, ROWS, COLUMNS - 1), "u2")),
        r"expected a flat field of the views' \(6, 8\) pixels, got \(6, 7\)",
    ),
    "scaled by a field of NXdata": (
        lambda path: tomo(path, instrument__detector__scaling_factor=0.5),
        "no field 'scaling_factor' beside '/entry/instrument/detector/data'.*got 0.5",
    ),
    "shifted by a field of its name": (
        lambda path: tomo(path, instrument__detector__data_offset=np.ones(1)),
        "no field 'data_offset' beside",
    ),
    "scaled by a field elsewhere": (
        lambda path: tomo(path, instrument__detector__scaling_factor=h5py.SoftLink("/entry/f")),
        "no field 'scaling_factor' beside .*got SoftLink",
    ),
    "scaled angles": (
        lambda path: tomo(path, sample__rotation_angle_scaling_factor=2.0),
        "no field 'rotation_angle_scaling_factor' beside",
    ),
    "units of each angle": (
        lambda path: tomo(path, unit=np.array([b"rad", b"rad"])),
        "expected units of deg.* got 'rad:rad'",
    ),
    "an order as a list": (
        lambda path: ordered(exchange(path), ["y", "theta", "x"]),
        "axes theta:y:x, got 'y:theta:x'",
    ),
    "an order as bytes": (
        lambda path: ordered(exchange(path), np.array([b"y", b"theta", b"x"])),
        "axes theta:y:x, got 'y:theta:x'",
    ),
    "an order as numbers": (
        lambda path: ordered(exchange(path), 1),
        "axes theta:y:x, got 'int64'",
    ),
    "another order": (lambda path: ordered(exchange(path)), "axes theta:y:x, got 'y:theta:x'"),
    "scaled by the detector's group": (
        lambda path: stated(tomo(path), entry__instrument__detector={"scale_factor": 0.5}),
        "no attribute 'scale_factor' of '/entry/instrument/detector'",
    ),
    "units of the file": (
        lambda path: stated(tomo(path), **{"/": {"units": "1e-3 counts"}}),
        "no attribute 'units' of '/'",
    ),
    "scaled by a field of the entry": (
        lambda path: tomo(path, scaling_factor=0.5),
        "no field 'scaling_factor' beside '/entry/instrument'",
    ),
    "scaled beside a soft link": (
        lambda path: beside(tomo(path), data_scaling_factor=2.0),
        "no field 'data_scaling_factor' beside '/entry/plot/data'",
    ),
    "shifted beside a hard link": (
        lambda path: beside(tomo(path), None, offset=2.0),
        "no field 'offset' beside '/entry/plot/data'",
    ),
    "scaled beside what a link to another file leads to": (
        lambda path: beside(
            linked(path, tomo(path.with_name("b.h5")).name, "/entry/plot/data"),
            file="b.h5",
            scaling_factor=2.0,
        ),
        "b.h5: expected no field 'scaling_factor' beside '/entry/plot/data'",
    ),
    "scaled in the group of another file": (
        lambda path: linked(
            path,
            stated(other_file(path.with_name("b.h5")), entry={"gain": 2.0}).name,
            "/soft",
        ),
        "b.h5: expected no attribute 'gain' of '/entry'",
    ),
    "a scaled part": (
        lambda path: (
            stated(virtual(path), **{"/": {}})
            and stated(path.with_name("parts.h5"), a={"scale_factor": 2.0}).parent / "a.nxs"
        ),
        "parts.h5: expected no attribute 'scale_factor' of '/a'",
    ),
    "angles of a group in another unit": (
        lambda path: stated(tomo(path), entry__sample={"units": "rad"}),
        "no attribute 'units' of '/entry/sample'",
    ),
    "a translation as angles": (
        lambda path: stated(
            tomo(path), entry__sample__rotation_angle={"transformation_type": "translation"}
        ),
        "expected the transformation_type rotation, got 'translation'",
    ),
    "an axis along the beam": (
        lambda path: stated(tomo(path), entry__sample__rotation_angle={"vector": [0, 0, 1]}),
        r"expected the vector of a vertical axis, \(0, 1, 0\) or \(0, -1, 0\)",
    ),
    "an axis that leans": (
        lambda path: stated(tomo(path), entry__sample__rotation_angle={"vector": [0.1, 1, 0]}),
        "expected the vector of a vertical axis",
    ),
    "no axis": (
        lambda path: stated(tomo(path), entry__sample__rotation_angle={"vector": [0, 0, 0]}),
        "expected the vector of a vertical axis",
    ),
    "an axis as a word": (
        lambda path: stated(tomo(path), entry__sample__rotation_angle={"vector": "y"}),
        "expected its vector as numbers",
    ),
    "an axis aside": (
        lambda path: stated(tomo(path), entry__sample__rotation_angle={"offset": [1.5, 0, 0]}),
        "expected the offset 0 of the axis",
    ),
    "an axis that a stage turns": (
        lambda path: tilted(path),
        "an axis that no other rotation turns, got .*stage",
    ),
    "a chain without an end": (
        lambda path: tilted(path, "translation", depends_on="rotation_angle"),
        "at most 16 transformations",
    ),
    "frames along the last axis": (
        lambda path: stated(
            tomo(path), entry__instrument__detector__data={"axes": "x:y:rotation_angle"}
        ),
        "got the axis 'x' at the place 0 by its axes",
    ),
    "transposed frames": (
        lambda path: labelled(tomo(path), "frame", "x", "y"),
        "got the axis 'x' at the place 1 by its DIMENSION_LABELS",
    ),
    "axes of NXdata": (
        lambda path: stated(
            beside(tomo(path)),
            entry__plot={"signal": "data", "axes": np.array([b"y", b"rotation_angle", b"x"])},
        ),
        "/entry/plot: .*got the axis 'y' at the place 0 by its axes",
    ),
    "the place of angles in NXdata": (
        lambda path: stated(beside(tomo(path)), entry__plot={"rotation_angle_indices": 2}),
        "got the axis 'rotation_angle' at the place 2 by its rotation_angle_indices",
    ),
    "line integrals with flat fields": (
        lambda path: stated(tomo(path), entry__instrument__detector__data={"units": "absorbance"}),
        "expected units of intensities beside flat fields, got 'absorbance'",
    ),
    "an order of pixel sizes": (
        lambda path: stated(tomo(path), entry__instrument__detector__x_pixel_size={"order": "yx"}),
        "no attribute 'order' of '/entry/instrument/detector/x_pixel_size'",
    ),
    "an order of frames": (
        lambda path: stated(tomo(path), entry__instrument__detector__data={"order": "x,y,n"}),
        "no attribute 'order' of '/entry/instrument/detector/data'",
    ),
    "a missing part": (lambda path: without_part(virtual(path)), "parts.h5, which is not in"),
}


def scaled(path):
    with h5py.File(path, "a") as file:
        file["entry/instrument/detector/data"].attrs["scale_factor"] = 0.5
    return path


def stated(path, **attributes):
    """The file with attributes of groups and data sets by their names; __ is /."""
    with h5py.File(path, "a") as file:
        for name, values in attributes.items():
            texts = {key: np.bytes_(v) for key, v in values.items() if isinstance(v, str)}
            file[name.replace("__", "/")].attrs.update({**values, **texts})
    return path


def beside(path, link=h5py.SoftLink, file=None, **fields):
    """An NXdata group with a link to the frames, and fields beside it; in a file of its own."""
    with h5py.File(path if file is None else path.with_name(file), "a") as other:
        target = "/entry/instrument/detector/data"
        other["entry/plot/data"] = link(target) if link else other[target]
        for name, value in fields.items():
            other[f"entry/plot/{name}"] = value
    return path


TURNED = {"transformation_type": "rotation", "vector": [1.0, 0.0, 0.0], "depends_on": "."}


def tilted(path, kind="rotation", **turned):
    """Angles that depend on a stage of 5 degrees, or on what `turned` says."""
    tomo(path, sample__stage=5.0)
    stated(path, entry__sample__stage={**TURNED, "transformation_type": kind})
    return stated(path, entry__sample__rotation_angle={"depends_on": "stage", **turned})


def labelled(path, *labels):
    """The file with labels of the frames' axes."""
    with h5py.File(path, "a") as file:
        for dim, label in zip(file["entry/instrument/detector/data"].dims, labels, strict=True):
            dim.label = label
    return path


def ordered(path, axes=b"y:theta:x"):
    with h5py.File(path, "a") as file:
        file["exchange/data"].attrs["axes"] = np.bytes_(axes) if isinstance(axes, bytes) else axes
    return path


def without_part(path):
    (path.parent / "parts.h5").unlink()
    return path


@pytest.mark.parametrize("fault", REFUSED)
def test_a_beamlines_file_that_contradicts_itself_is_refused_by_name(fault, tmp_path):
    make, message = REFUSED[fault]
    with pytest.raises(Refused, match=message):
        opened(make(tmp_path / "a.nxs"))


def test_a_pixel_size_without_units_is_not_used(tmp_path):
    with pytest.warns(UserWarning) as warned:
        views = opened(tomo(tmp_path / "a.nxs", size=(None, 2.0, 3.0)))
    assert all("pixel_size: has no units" in str(one.message) for one in warned)
    assert "pixel_mm" not in views.stack.rig["detector"]


@pytest.mark.parametrize(
    ("source", "beam"),
    [
        ("Synchrotron X-ray Source", "parallel"),
        ("Reactor Neutron Source", "parallel"),
        ("Fixed Tube X-ray", None),
        ("Rotating Anode X-ray", None),
        ("Metal Jet X-ray", None),
    ],
)
def test_beams_of_tubes_are_not_parallel(source, beam, tmp_path):
    path = tomo(tmp_path / "a.nxs", instrument__source__type=np.bytes_(source))
    assert opened(path).stack.rig["name"] is beam


def area(path, name, **attributes):
    """A file of Data Exchange or NXtomo with attributes of areaDetector or silx at a place."""
    with h5py.File(path, "a") as file:
        file[name].attrs.update(attributes)
    return path


def detector(offset=(0, 0), binning=(1, 1)):
    """What areaDetector states of the part of the detector in each of its data sets, x first."""
    names = ("NDArrayDimOffset", "NDArrayDimBinning", "NDArrayDimReverse")
    pairs = zip(names, (offset, binning, (0, 0)), strict=True)
    return {name: np.array(pair, "i4") for name, pair in pairs}


@pytest.mark.parametrize("part", [{}, {"offset": (320, 512)}, {"binning": (2, 2)}])
def test_views_and_fields_of_one_part_of_the_detector(part, tmp_path):
    """areaDetector states offset and binning, which are those of views and fields; other ones are
    refused by name, also of fields in a file of their own.
    """
    path = exchange(tmp_path / "a.h5")
    for name in ("data", "data_white", "data_dark"):
        area(path, f"exchange/{name}", **detector(**part))
    assert np.allclose(opened(path).whole().views, integrals(), atol=1e-6)
    other = area(exchange(tmp_path / "b.h5"), "exchange/data_white", **detector((8, 0), (4, 4)))
    with pytest.raises(Refused, match="flat field with the NDArrayDim(Offset|Binning)"):
        opened(path, flat=f"{other}:/exchange/data_white")


def test_virtual_frames_have_the_part_of_the_detector_of_their_files(tmp_path):
    """As areaDetector writes raw files, and a beamline virtual frames of them."""
    path, parts = virtual(tmp_path / "a.nxs"), tmp_path / "parts.h5"
    with h5py.File(parts) as file:
        names = [*file]
    for name in names:
        area(parts, name, **detector((320, 512)))
    assert np.allclose(opened(path).whole().views, integrals(), atol=1e-6)
    other = area(exchange(tmp_path / "b.h5"), "exchange/data_white", **detector((320, 0)))
    with pytest.raises(Refused, match=r"flat field with the NDArrayDimOffset \[320 512\] of the"):
        opened(path, flat=f"{other}:/exchange/data_white")
    area(parts, names[-1], **detector((320, 0)))
    with pytest.raises(Refused, match="data: expected one NDArrayDimOffset, got"):
        opened(path)


VALUES, EVERY = frames(), slice(None)
HEAD, TAIL = slice(len(KEYS) // 2), slice(len(KEYS) // 2, None)
TWICE = np.stack([VALUES, VALUES + 1], 1).reshape(-1, ROWS, COLUMNS)
#: Parts of virtual frames: of each its frames, the values of its data set, and the frames of these.
PARTS = {
    "the last first": [(TAIL, VALUES[TAIL], EVERY), (HEAD, VALUES[HEAD], EVERY)],
    "of two writers in turn": [(slice(k, None, 2), VALUES[k::2], EVERY) for k in (1, 0)],
    "each second frame": [(EVERY, TWICE, slice(None, None, 2))],
    "an image each": [(k, VALUES[k], EVERY) for k in range(len(KEYS))],
    "another order of bytes": [(EVERY, VALUES.astype(">u2"), EVERY)],
}
NO_PARTS = {
    "some twice": [
        (HEAD, VALUES[HEAD], EVERY),
        (slice(1, 11), VALUES[TAIL], EVERY),
    ],
    "some of none": [(HEAD, VALUES[HEAD], EVERY)],
    "rows": [
        ((EVERY, slice(3)), VALUES[:, :3], EVERY),
        ((EVERY, slice(3, 6)), VALUES[:, 3:], EVERY),
    ],
    "a type that holds more": [(EVERY, VALUES.astype("u4") + 2**16, EVERY)],
}


def virtual_of(path, parts):
    """An NXtomo file whose frames are virtual, of such parts."""
    layout = h5py.VirtualLayout(VALUES.shape, VALUES.dtype)
    with h5py.File(path.parent / "parts.h5", "w") as file:
        for k, (target, values, own) in enumerate(parts):
            file[f"part{k}"] = values
            source = h5py.VirtualSource("parts.h5", f"part{k}", values.shape, values.dtype)
            layout[target] = source[own]
    tomo(path)
    with h5py.File(path, "a") as file:
        del file["entry/instrument/detector/data"]
        file.create_virtual_dataset("entry/instrument/detector/data", layout)
    return path


@pytest.mark.parametrize("form", PARTS)
def test_virtual_frames_are_those_that_hdf5_reads(form, tmp_path):
    """Whatever the order of their parts, and the steps in which these are taken."""
    views = opened(virtual_of(tmp_path / "a.nxs", PARTS[form])).whole().views
    assert np.allclose(views, integrals(), atol=1e-6)


@pytest.mark.parametrize("form", NO_PARTS)
def test_virtual_frames_that_are_not_each_one_whole_frame_are_refused(form, tmp_path):
    """Tried beside these: parts without limits, and columns of frames."""
    with pytest.raises(Refused, match="virtual frames|each of .* frames once"):
        opened(virtual_of(tmp_path / "a.nxs", NO_PARTS[form]))


@pytest.mark.parametrize("name", ["/", "entry", "entry/sample", "entry/instrument/detector/data"])
def test_the_kind_of_a_scale_of_a_plot_is_no_scale(name, tmp_path):
    """As nxtomo writes it for silx. Neutral numbers of each axis change nothing; others do."""
    styles = {f"SILX_style/{kind}": "linear" for kind in ("axis_scale_types", "signal_scale_type")}
    styles["SILX_style/axis_scale_types"] = ["linear", "linear"]
    path = area(tomo(tmp_path / "a.nxs"), name, **styles, scale_factor=[1.0, 1.0], offset=[0, 0])
    assert np.allclose(opened(path).whole().views, integrals(), atol=1e-6)
    with pytest.raises(Refused, match=r"scale_factor.*\[1.0, 2.0\]"):
        opened(area(path, name, scale_factor=[1.0, 2.0]))


def test_one_frame_may_have_one_key(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frame"], file["key"], file["angles"] = grey()[0], 0, [0.0]
    names = {"dataset": "frame", "image_key": "key", "angles": "angles"}
    views = opened(tmp_path / "a.h5", kind="counts", **names)
    assert np.array_equal(views.whole().views[0], grey()[0])


def test_a_flat_field_of_another_name_is_listed_and_read(tmp_path):
    """As the SLS names those before and behind the views."""
    flat = np.full((2, ROWS, COLUMNS), FLAT, "u2")
    path = exchange(tmp_path / "a.h5", data_white=None, data_white_pre=flat, data_white_post=flat)
    with pytest.raises(Refused, match="no flat field, it contains .*/exchange/data_white_pre"):
        opened(path)
    views = opened(path, flat="exchange/data_white_pre").whole().views
    assert np.allclose(views, integrals(), atol=1e-6)


CHANGED = {
    "flats of half the exposure": (
        {"instrument__detector__count_time": np.where(KEYS == 1, 0.05, 0.1)},
        "the flat field has the count_time 0.05, its views have 0.1",
    ),
    "darks of another exposure": (
        {"instrument__detector__count_time": np.where(KEYS == 2, 0.4, 0.1)},
        "the dark field has the count_time 0.4, its views have 0.1",
    ),
    "a beam that decays": (
        {"control__data": np.linspace(1, 0.8, len(KEYS))},
        "the flat field has the control/data .*, its views have 0.8.* to 0.9",
    ),
    "a beam that decays, of views alone": (
        {"control__data": np.linspace(1, 0.8, VIEWS)},
        "control/data: of the views is 0.8 to 1",
    ),
    "a beam that decays, without flats": (
        {"control__data": np.where(KEYS == 1, np.nan, np.linspace(1, 0.8, len(KEYS)))},
        "control/data: of the views is 0.8.* unless views.exposure=<file>",
    ),
    "unequal exposures, of flats without": (
        {"instrument__detector__count_time": np.where(KEYS == 1, 0, np.arange(len(KEYS)) % 2 + 1)},
        "count_time: of the views is 1 to 2, which is not corrected",
    ),
    "a ring's current": (
        {"instrument__source__current": np.linspace(300, 200, len(KEYS))},
        "the flat field has the instrument/source/current .*, its views have",
    ),
    "mirrored columns": ({"instrument__detector__x_flipped": True}, "views.flip_columns=true"),
    "mirrored rows": ({"instrument__detector__y_flipped": np.uint8(1)}, "views.flip_rows=true"),
    "a sample that rises": (
        {"sample__z_translation": np.arange(len(KEYS)) * 0.1},
        "z_translation: the sample moved by .* between views",
    ),
    "a jittered sample": (
        {"sample__x_translation": np.arange(len(KEYS)) % 3},
        "x_translation: the sample moved by 2 between views",
    ),
    "radians as degrees": ({"sample__rotation_angle": np.radians(ANGLES)}, "look like radians"),
}


@pytest.mark.parametrize("change", CHANGED)
def test_what_a_beamlines_file_states_and_no_correction_applies_is_warned_of(change, tmp_path):
    """Equal exposures, an upright detector and a beam within a percent are not. Of views whose
    flat fields state no exposure, zero or NaN, the change from view to view is.
    """
    sets, message = CHANGED[change]
    with pytest.warns(UserWarning, match=message):
        opened(tomo(tmp_path / "a.nxs", **sets))
    steady = {
        name: values if name.endswith("angle") else values * 0 for name, values in sets.items()
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(tomo(tmp_path / "b.nxs", **steady | {"sample__rotation_angle": ANGLES}))


@pytest.mark.parametrize("columns", [1, -1])
@pytest.mark.parametrize(("vector", "unit"), [((0, 1, 0), 1), ((0, -1.0, 0), 1), ((0, 2, 0), 57.3)])
def test_the_vector_of_a_rotation_says_which_way_the_sample_turns(vector, unit, columns, tmp_path):
    """Points of a sample that turns counter-clockwise about the vector: from the columns in which
    a detector sees them and the angles that are read, they follow from least squares, with the
    sense in which they lie about the vertical. A mirrored detector sees the sample from behind.

    Tried beside these: vectors that are not vertical, are zero, or no numbers, which are refused.
    """
    turns = ANGLES if unit == 1 else np.radians(ANGLES)
    path = tomo(tmp_path / "a.nxs", unit=b"deg" if unit == 1 else b"rad")
    with h5py.File(path, "a") as file:
        file["entry/sample/rotation_angle"][KEYS == 0] = turns
    row = np.reshape(vector, (-1, 3) if columns < 0 else 3)  # MATLAB writes [1 3]
    attributes = {"vector": row, "transformation_type": np.bytes_("rotation")}
    stated(path, entry__sample__rotation_angle={**attributes, "offset": [0.0, 0, 0]})
    points = np.array([[3.0, 0, 0], [1.0, 0, 2.0]])  # x to the left along the beam z, y upwards
    at = np.radians(ANGLES)[:, None] * np.sign(vector[1])
    seen = columns * (np.cos(at) * points[:, 0] + np.sin(at) * points[:, 2])
    angles = np.radians(opened(path).stack.rig["angles"])
    rows = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    found, (*left,), *_ = np.linalg.lstsq(rows, seen, rcond=None)
    assert max(left) < 1e-20
    assert np.linalg.det(found.T) == pytest.approx(-6.0)  # of (z, x), seen from above


def test_angles_that_depend_on_other_stages(tmp_path):
    """Translations that stay and stages that are not turned change nothing; a stage that moves is
    warned of, and so is one that is not in the file.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert opened(tilted(tmp_path / "a.nxs", "translation")).n_views == VIEWS
        path = tilted(tmp_path / "b.nxs")
        with h5py.File(path, "a") as file:
            file["entry/sample/stage"][()] = 0.0
        assert opened(path).n_views == VIEWS
    path = tilted(tmp_path / "c.nxs", "translation")
    with h5py.File(path, "a") as file:
        kept = dict(file["entry/sample/stage"].attrs)
        del file["entry/sample/stage"]
        file["entry/sample/stage"] = np.arange(len(KEYS)) * 1.0
    with pytest.warns(UserWarning, match="stage: the sample moved by"):
        opened(stated(path, entry__sample__stage=kept))
    with pytest.warns(UserWarning, match="depends on 'none', which is not there"):
        opened(tilted(tmp_path / "d.nxs", depends_on="none"))


def test_axes_that_are_stated_in_their_order(tmp_path):
    """By any of the attributes, also with names that say nothing, and of units of counts."""
    path = labelled(beside(tomo(tmp_path / "a.nxs")), "frame", "", "det_x")
    names = {"axes": np.array([b"rotation_angle", b".", b"."]), "rotation_angle_indices": 0}
    data = {"axes": "rotation_angle:y:x", "units": "counts"}
    stated(path, entry__plot=names, entry__instrument__detector__data=data)
    assert opened(path).n_views == VIEWS


@pytest.mark.parametrize(
    ("name", "kind", "warned"),
    [
        *(("rx", "", True), ("rx", "rotation", True), ("roll", "Rotation", True)),
        *(("tx", "", False), ("height", "translation", False), ("roll", "", False)),
    ],
)
def test_a_detector_that_is_turned_is_warned_of(name, kind, warned, tmp_path):
    """As nxtomo writes mirrored frames, and by transformations of other names."""
    path = tomo(tmp_path / "a.nxs", **{f"instrument__detector__transformations__{name}": 180})
    if kind:
        place = f"entry__instrument__detector__transformations__{name}"
        stated(path, **{place: {"transformation_type": kind}})
    with h5py.File(path, "a") as file:  # by nxtomo 3
        file["entry/instrument/detector/transformations"].attrs["units"] = "NX_TRANSFORMATION"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(path)
    words = f"transformations/{name}: the detector is turned"
    assert [words in str(one.message) for one in caught] == [True] * warned


@pytest.mark.parametrize("form", ["uint32", "bool", "one frame", "a frame more", "floats"])
def test_pixels_of_a_detectors_mask_are_left_out(form, tmp_path):
    """Whatever bit is set; those of a mask that is none of the frames' pixels are warned of."""
    mask = np.zeros((ROWS, COLUMNS), "u4")
    mask[1, 2], mask[4, 7] = 1, 256
    if form in ("bool", "floats"):
        mask = mask.astype("f4" if form == "floats" else bool)
    mask = np.stack([mask] * {"one frame": 1, "a frame more": 2}.get(form, 0) or [mask]).squeeze(
        0 if form in ("uint32", "bool", "floats") else ()
    )
    path = tomo(tmp_path / "a.nxs", instrument__detector__pixel_mask=mask)
    if form in ("a frame more", "floats"):
        with pytest.warns(UserWarning, match="expected a mask of .*give it as views.bad_pixels"):
            assert opened(path, find_bad_pixels=False).whole().mask.all()
        return
    with pytest.warns(UserWarning, match="2 of 48 pixels are dead, hot or stuck"):
        found = opened(path, find_bad_pixels=False).whole()
    good = torch.from_numpy(mask == 0).reshape(ROWS, COLUMNS)
    assert torch.equal(found.mask, good.expand(VIEWS, ROWS, COLUMNS))
    expected = torch.from_numpy(integrals()).float()
    assert torch.allclose(found.views[:, good], expected[:, good], atol=2e-6)


SATURATION = {
    "a value": ({"saturation_value": 40_000}, 40_000),
    "a value in an array": ({"saturation_value": [[40_000.0]]}, 40_000),
    "bits of each readout": ({"bit_depth_readout": 12}, 65535),
    "both": ({"saturation_value": 40_000, "bit_depth_readout": 15}, 40_000),
    "never filled": ({"saturation_value": 0, "bit_depth_readout": 0}, 65535),
    "below 0": ({"saturation_value": -1}, 65535),
    "beyond the type": ({"saturation_value": 1_048_575}, 65535),
    "NaN": ({"saturation_value": np.nan}, 65535),
    "a text": ({"saturation_value": "none"}, 65535),
}


@pytest.mark.parametrize("case", SATURATION)
def test_the_saturation_that_a_detector_states_is_applied(case, tmp_path):
    """Half of the grey values of `grey` are above 24 500."""
    sets, top = SATURATION[case]
    path = tomo(tmp_path / "a.nxs", **{f"instrument__detector__{n}": v for n, v in sets.items()})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stack = opened(path, flat=20_000.0, find_bad_pixels=False).stack
        found = opened(path, flat=20_000.0, find_bad_pixels=False).whole()
    assert any("is not used" in str(one.message) for one in caught) is (case in ("NaN", "a text"))
    assert stack.top == top
    assert np.array_equal(found.mask.numpy(), grey() < top)


def test_values_below_a_detectors_underload_are_warned_of(tmp_path):
    path = tomo(tmp_path / "a.nxs", instrument__detector__underload_value=3)
    with pytest.warns(UserWarning, match="underload_value: is not applied"):
        opened(path)


NUMBERS = np.arange(len(KEYS))
SEQUENCES = {
    "of all frames": (NUMBERS + 1, None),
    "of each kind": (np.where(KEYS == 0, np.cumsum(KEYS == 0), 0), None),
    "of the views": (np.arange(VIEWS), None),
    "in steps of two": (2 * NUMBERS, None),
    "never filled": (0 * NUMBERS, None),
    "bytes that start again": ((NUMBERS + 250).astype("u1"), None),
    "16 bits that start again": ((NUMBERS + 65530).astype(">u2"), None),
    "bytes of views that start again": ((np.arange(VIEWS) + 250).astype("u1"), None),
    "a dropped frame where bytes start again": (
        (NUMBERS + 246 + (NUMBERS > 9)).astype("u1"),
        "1 gaps between views, such as from 255 to 1",
    ),
    "texts": ([str(n) for n in NUMBERS], "sequence_number: expected up to .* it is not used"),
    "NaN": (NUMBERS * np.nan, "expected a number of each view, got .* it is not used"),
    "NaN of a view": (np.where(NUMBERS == 5, np.nan, NUMBERS), "number of each view.*not used"),
    "NaN of a field": (np.where(KEYS == 0, NUMBERS, np.nan), None),
    "a dropped frame": (NUMBERS + (NUMBERS > 9), "1 gaps between views, such as from 9 to 11"),
    "two dropped views": (np.delete(np.arange(14), [3, 8]), "2 gaps between views"),
    "other numbers": (np.arange(5), "a number of each of 19 frames or 12 views, got 5"),
}


@pytest.mark.parametrize("case", SEQUENCES)
def test_frames_in_the_order_of_their_sequence_numbers_are_read(case, tmp_path):
    """Counted for all frames or for each kind; dropped frames are warned of."""
    numbers, words = SEQUENCES[case]
    path = tomo(tmp_path / "a.nxs", instrument__detector__sequence_number=numbers)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(path)
    found = [re.search(words, str(one.message)) is not None for one in caught if words]
    assert found == [True] * (words is not None)
    assert len(caught) == (words is not None)


@pytest.mark.parametrize(
    "numbers",
    [
        *(NUMBERS[::-1], NUMBERS // 2, np.r_[1, 0, NUMBERS[2:]]),
        *(NUMBERS[::-1].astype("u1"), (NUMBERS // 2).astype("u4")),
    ],
)
def test_frames_in_another_order_than_their_sequence_numbers_are_refused(numbers, tmp_path):
    """Reversed, repeated, and two exchanged; those of fields alone do not count."""
    path = tomo(tmp_path / "a.nxs", instrument__detector__sequence_number=numbers)
    if numbers[0] == 1:  # a flat and a dark field
        opened(path)
        return
    with pytest.raises(Refused, match="sequence_number: expected views in the order"):
        opened(path)


@pytest.mark.parametrize(("unit", "warned"), [(b"nm", False), (b"um", True), (b"mm", True)])
def test_a_motor_that_trembles_by_less_than_a_tenth_of_a_pixel_is_none_that_moves(
    unit, warned, tmp_path
):
    """Pixels of 2 um; steps of 1 nm, 1 um and 1 mm."""
    path = tomo(tmp_path / "a.nxs", sample__z_translation=np.arange(len(KEYS)) % 2.0)
    with h5py.File(path, "a") as file:
        file["entry/sample/z_translation"].attrs["units"] = np.bytes_(unit)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(path)
    assert any("the sample moved" in str(one.message) for one in caught) is warned


def test_a_monitor_in_a_missing_file_is_not_needed(tmp_path):
    path = tomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        file["entry/control/data"] = h5py.ExternalLink("current.h5", "/data")
        file["entry/instrument/detector/count_time"] = h5py.ExternalLink("time.h5", "/data")
    assert opened(path).n_views == VIEWS


@pytest.mark.parametrize("layout", ["NXtomo", "linked", "virtual", "Data Exchange"])
def test_each_file_of_a_scan_is_opened_once(layout, tmp_path, monkeypatch):
    """However often its frames are in groups of NXdata, and whatever it states beside them."""
    path, _ = LAYOUTS[layout](tmp_path)
    frames = "/exchange/data" if layout == "Data Exchange" else "/entry/instrument/detector/data"
    with h5py.File(path, "a") as file:
        for k in range(4):
            file[f"entry/plot{k}/data"] = h5py.SoftLink(frames)
        file["entry/control/data"] = file["entry/instrument/detector/count_time"] = 1.0
    names, read = [], storage.reading
    monkeypatch.setattr(storage, "reading", lambda path: names.append(path.name) or read(path))
    assert hdf5_views(path).n_views == VIEWS
    assert path.name in names and len({*names}) == len(names)


@pytest.mark.parametrize("link", [h5py.SoftLink, lambda name: name])
def test_frames_of_two_names_are_those_of_the_detector(link, tmp_path):
    """NXdata repeats frames and image_key by links, hard ones too, but neither image_key_control
    nor the pixels' size.
    """
    path = tomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        for name in ("data", "image_key"):
            target = link(f"/entry/instrument/detector/{name}")
            file[f"entry/data/{name}"] = file[target] if isinstance(target, str) else target
    for options in ({}, {"dataset": "/entry/data/data"}):
        views = opened(path, **options)
        assert views.n_views == VIEWS
        assert views.stack.rig["detector"] == {"pixel_mm": (2e-3, 3e-3)}


DETECTORS = {
    "a mask": ("instrument/detector/pixel_mask", np.eye(ROWS, COLUMNS, dtype=int), "dead, hot"),
    "mirrored columns": ("instrument/detector/x_flipped", True, "views.flip_columns=true"),
    "times": ("instrument/detector/count_time", np.where(KEYS == 1, 2.0, 1.0), "count_time 2,"),
    "a monitor": ("control/data", np.linspace(1, 0.8, len(KEYS)), "has the control/data"),
    "a key": ("instrument/detector/skew", 2.0, "does not know: skew"),
}


@pytest.mark.parametrize("dataset", [None, "entry/plot/data"])
@pytest.mark.parametrize("case", DETECTORS)
def test_what_stands_beside_another_name_of_the_frames_counts(case, dataset, tmp_path):
    """Frames with their key in a group of NXdata, of which the detector has the pixels' size."""
    name, value, message = DETECTORS[case]
    path = tomo(tmp_path / "a.nxs", **{name.replace("/", "__"): value})
    with h5py.File(path, "a") as file:
        detector = file["entry/instrument/detector"]
        file["entry/plot/data"] = detector["data"]
        file["entry/plot/image_key"] = detector["image_key_control"]
        del detector["image_key"], detector["image_key_control"]
    with pytest.warns(UserWarning, match=message):
        found = opened(path, dataset=dataset, find_bad_pixels=False)
        views = found.whole()
    assert found.stack.rig["detector"]["pixel_mm"] == pytest.approx((2e-3, 3e-3))
    expected = torch.from_numpy(integrals()).float()
    assert torch.allclose(views.views[views.mask], expected[views.mask], atol=2e-6)


@pytest.mark.parametrize("kind", ["rotation", "translation", "still"])
def test_a_sample_that_depends_on_stages_above_its_axis(kind, tmp_path):
    """NeXus states the uppermost stage by the sample's own `depends_on`."""
    stage = np.zeros(len(KEYS)) if kind == "still" else np.arange(len(KEYS)) * 1.0
    first = {"sample__depends_on": "/entry/sample/transformations/stage"}
    path = tomo(tmp_path / "a.nxs", **first, sample__transformations__stage=stage)
    below = {"depends_on": "/entry/sample/rotation_angle"}
    below["transformation_type"] = "translation" if kind == "translation" else "rotation"
    stated(path, entry__sample__transformations__stage=below)
    if kind == "rotation":
        with pytest.raises(Refused, match="no other rotation turns, got .*stage of up to"):
            opened(path)
    elif kind == "translation":
        with pytest.warns(UserWarning, match="stage: the sample moved by"):
            opened(path)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            opened(path)


@pytest.mark.parametrize("signal", ["raw", "preview"])
def test_the_order_of_axes_that_nxdata_states_of_frames_by_name(signal, tmp_path):
    """Its `axes` are those of its signal."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["plot/raw"] = grey()
        file["plot"].attrs.update(signal=signal, axes=["theta", "x", "y"])
    options = {"dataset": "plot/raw", "flat": 6e4}
    if signal == "raw":
        with pytest.raises(Refused, match="the axis 'x' at the place 1"):
            opened(tmp_path / "a.h5", **options)
    else:
        assert opened(tmp_path / "a.h5", **options).n_views == VIEWS


FLATS = {
    "keys of flat fields": {"keys": [1, 1, 1]},
    "keys of both fields": {"keys": [1, 2, 1]},
    "keys of views": {"keys": [0, 0, 0]},
    "no keys": {"keys": None},
    "the time of the views": {"keys": [1, 1, 1], "time": 1.0},
    "another time": {"keys": [1, 1, 1], "time": 2.0},
}


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("case", FLATS)
def test_flat_fields_in_a_group_or_file_of_their_own(case, inside, tmp_path):
    """They need no angles, and the data sets beside them are theirs. Also tried: the same for
    dark fields, and frames of NXtomo whose angles are all alike.
    """
    keys, time = (FLATS[case].get(name) for name in ("keys", "time"))
    with (
        h5py.File(tmp_path / "a.h5", "w") as scan,
        h5py.File(tmp_path / "flat.nxs", "w") as other,
    ):
        scan["views/raw"], scan["views/count_time"] = grey(), 1.0
        own = (scan if inside else other).create_group("flats")
        own["data"] = np.where([[[key == 2]] for key in keys or [1] * 3], DARK, [[[FLAT]]]).astype(
            "u2"
        ) * np.ones((1, ROWS, COLUMNS), "u2")
        own["sample/rotation_angle"] = np.zeros(3)
        if keys:
            own["image_key"] = keys
        if time:
            own["count_time"] = time
    flat = "flats/data" if inside else tmp_path / ("flat.nxs" if keys else "flat.nxs:/flats/data")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        options = {"dataset": "views/raw", "flat": str(flat), "dark": DARK}
        found = opened(tmp_path / "a.h5", **options, find_bad_pixels=False).whole().views
    assert np.allclose(found, integrals(), atol=1e-6)
    assert ["count_time 2, its views have 1" in str(one.message) for one in caught] == [True] * (
        time == 2
    )


@pytest.mark.parametrize("many", [1, 4])
def test_a_chunk_may_be_one_frame_of_any_size(many, tmp_path, monkeypatch):
    """Which is read at once anyway; of larger ones the command is named that makes them smaller."""
    monkeypatch.setattr(storage, "MAX_CHUNK_BYTES", ROWS * COLUMNS)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("raw", data=grey(), chunks=(many, ROWS, COLUMNS), compression="gzip")
    if many == 1:
        views = opened(tmp_path / "a.h5", dataset="raw", flat=FLAT)
        assert np.array_equal(views.stack.read(0, VIEWS), grey())
        return
    with pytest.raises(Refused, match=r"at most 96 bytes .* h5repack -l /raw:CHUNK=1x6x8 writes"):
        opened(tmp_path / "a.h5", dataset="raw", flat=FLAT).whole()


def test_what_stands_beside_frames_counts_whatever_their_name_is(tmp_path):
    """Frames by name with keys, a mask and a greatest value; also of a link in another group."""
    path, mask = tmp_path / "a.h5", np.zeros((ROWS, COLUMNS), "u1")
    mask[2, 3] = 1
    values = frames()
    values[2, 0, 0] = 61_000  # of the first view
    with h5py.File(path, "w") as file:
        file["camera/raw"], file["camera/image_key"] = values, np.where(KEYS < 0, 3, KEYS)
        file["camera/pixel_mask"], file["camera/saturation_value"] = mask, 61_000
        file["links/raw"] = h5py.SoftLink("/camera/raw")
    for name in ("camera/raw", "links/raw"):
        views = opened(path, dataset=name, find_bad_pixels=False)
        whole = views.whole()
        right = torch.from_numpy(mask == 0).repeat(VIEWS, 1, 1)
        right[0, 0, 0] = False
        assert torch.equal(whole.mask, right)
        good = whole.mask.numpy()
        np.testing.assert_allclose(whole.views.numpy()[good], integrals()[good], atol=1e-5)
        assert views.stack.rig["name"] is None  # angles of frames by name are named as well
    with h5py.File(path, "w") as file:
        file["raw"], file["pixel_mask"] = grey().swapaxes(0, 1), mask
        file["count_time"] = np.arange(1.0, VIEWS + 1)
    with warnings.catch_warnings(action="error"):  # of rows of sinograms no frame is stated
        hdf5_views(path, "raw", layout="sinogram")


@pytest.mark.parametrize("name", ["units", "unit", "angle_unit"])
def test_units_of_angles_by_each_of_their_names(name, tmp_path):
    """The last one is CIL's."""
    for unit, angles in (("degree", ANGLES), ("radian", np.radians(ANGLES))):
        path = tmp_path / f"{unit}.h5"
        with h5py.File(path, "w") as file:
            file["raw"], file["angles"] = grey(), angles
            file["angles"].attrs[name] = unit
        stack = hdf5_views(path, "raw", "angles")
        np.testing.assert_allclose(stack.rig["angles"], ANGLES, atol=1e-9)
    with h5py.File(path, "a") as file:
        file["angles"].attrs.update({"units": "degree", "angle_unit": "radian"})
    with pytest.raises(Refused, match="expected units of deg.*got 'degree or radian'"):
        hdf5_views(path, "raw", "angles")


CIL = ("angle", "vertical", "horizontal")


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 0, 1)])
def test_the_order_of_axes_that_cil_states_is_compared(order, tmp_path):
    """As its NEXUSDataWriter writes it: the second order is that of ASTRA's sinograms."""
    path = tmp_path / "cil.nxs"
    with h5py.File(path, "w") as file:
        file["entry1/tomo_entry/data/data"] = np.moveaxis(grey(), order, (0, 1, 2))
        stored = file["entry1/tomo_entry/data/data"]
        stored.attrs.update({f"dim{n}": CIL[axis] for n, axis in enumerate(order)})
        stored.attrs.update(data_type="AcquisitionData", num_pixels_h=COLUMNS, num_channels=1)
    for layout, right in (("projections", (0, 1, 2)), ("sinogram", (1, 0, 2))):
        options = {"dataset": "/entry1/tomo_entry/data/data", "flat": 6e4, "layout": layout}
        if order == right:
            assert opened(path, **options).shape == (ROWS, COLUMNS)
            continue
        with pytest.raises(Refused, match="at the place . by its dim"):
            opened(path, **options)
    with h5py.File(path, "w") as file:  # of one slice
        file["data"] = grey()[:, 0]
        file["data"].attrs.update(dim0="angle", dim1="horizontal")
    assert opened(path, dataset="data", flat=6e4, layout="sinogram").n_views == VIEWS


def test_an_option_of_hdf5_for_another_file_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", grey())
    with pytest.raises(Refused, match=r"for views\.angles"):
        opened(tmp_path / "a.npy", kind="counts", angles="/turn")
    assert "NXtomo" in EXPECTED
