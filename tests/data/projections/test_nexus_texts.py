"""Texts, axes and masks of frames in HDF5, as h5py, xarray and GDA write them.

Truth: the names themselves. Tried beside these: labels with units, letters, columns of cameras, and
attributes of each kind of data set.
"""

import h5py
import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from tests.data.projections.conftest import COLUMNS, ROWS, VIEWS, grey, opened
from tests.data.projections.test_nexus import ANGLES, KEYS, integrals, tomo
from tests.data.projections.test_unknown_keys import GIVEN, named

DETECTOR = "entry/instrument/detector"
SCAN = {"dataset": "scan/raw", "angles": "scan/angles"}


def scan(path, **sets):
    """A file of frames and angles by name."""
    with h5py.File(path, "w") as file:
        file["scan/raw"], file["scan/angles"] = grey(), ANGLES
        for name, value in sets.items():
            file[f"scan/{name}"] = value
    return path


@pytest.mark.parametrize("place", ["raw", "angles"])
@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("dark field subtracted", "dark field"),
        ("counts, scale = 0.5", "scale"),
        ("turned clockwise", "clockwise"),
        ("seen from above, counter-clockwise or anticlockwise", None),
        ("a phantom", None),
    ],
)
@pytest.mark.parametrize("name", ["comment", "long_name"])
def test_texts_among_the_attributes_are_searched(name, text, word, place, tmp_path):
    path = scan(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file[f"scan/{place}"].attrs[name] = text
    found = ", ".join(named(path, **SCAN, **GIVEN))
    assert (found == "") if word is None else found.startswith(f"{place}@{name}:") and word in found


@pytest.mark.parametrize("name", ["image_key_control", "pixel_mask"])
def test_attributes_of_keys_and_masks_are_named(name, tmp_path):
    path = tomo(
        tmp_path / "a.nxs", instrument__detector__pixel_mask=np.zeros((ROWS, COLUMNS), "u1")
    )
    with h5py.File(path, "a") as file:
        file[f"{DETECTOR}/{name}"].attrs["meaning"] = "1 is right"
    assert named(path) == [f"{name}@meaning"]


def test_attributes_of_exposures_are_named(tmp_path):
    path = scan(tmp_path / "a.h5", light=np.ones(VIEWS))
    with h5py.File(path, "a") as file:
        file["scan/light"].attrs.update({"relative_to": "the first view", "unit": "1"})
    assert named(path, **SCAN, **GIVEN, exposure="scan/light") == ["light@relative_to"]


@pytest.mark.parametrize("right", [True, False])
@pytest.mark.parametrize(
    "names",
    [
        ("angle", "y", "x"),
        ("theta", "detY", "detX"),
        ("phi", "detector-y", "detector-x"),
        ("omega", "y_pixel", "x_pixel"),
        ("angle", "Y [mm]", "X [mm]"),
        ("angle", "ny", "nx"),
    ],
)
@pytest.mark.parametrize("form", ["labels", "tuple", "list", ";", "/", "scales"])
def test_names_of_axes_in_every_form_are_compared(form, names, right, tmp_path):
    path, order = scan(tmp_path / "a.h5"), names if right else (names[0], *names[:0:-1])
    with h5py.File(path, "a") as file:
        raw = file["scan/raw"]
        for axis, name in enumerate(order):
            if form == "labels":
                raw.dims[axis].label = name
            if form == "scales":
                file[name.replace("/", "")] = np.arange(raw.shape[axis])
                file[name].make_scale(name)
                raw.dims[axis].attach_scale(file[name])
                file["deleted"] = np.zeros(raw.shape[axis])
                file["deleted"].dims[0].attach_scale(file[name])
                del file["deleted"]
        texts = {"tuple": str(order), "list": str([*order]).replace("'", '"')}
        if form not in ("labels", "scales"):
            raw.attrs["axes"] = texts.get(form, form.join(order))
    if right:
        assert named(path, **SCAN, **GIVEN) == []
        return
    with pytest.raises(Refused, match="axis '.*' at the place 1"):
        opened(path, **SCAN, **GIVEN)


@pytest.mark.parametrize(
    ("name", "right"), [("sample_x", True), ("detector_x", False), ("x", False)]
)
def test_a_positioner_of_the_sample_is_no_axis(name, right, tmp_path):
    path = scan(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["scan"].attrs.update({"signal": "raw", f"{name}_indices": 0})
    if right:
        assert named(path, **SCAN, **GIVEN) == []
        return
    with pytest.raises(Refused, match=f"axis '{name}' at the place 0"):
        opened(path, **SCAN, **GIVEN)


def test_bad_pixels_beside_keys_of_frames(tmp_path):
    """No sequence, key or time of the frames is compared with the one mask."""
    bad = np.zeros((ROWS, COLUMNS), bool)
    bad[2, 3] = True
    path = tomo(tmp_path / "a.nxs", instrument__detector__bad=bad)
    with h5py.File(path, "a") as file:
        file[f"{DETECTOR}/sequence_number"] = np.arange(len(KEYS))
    views = opened(path, bad_pixels=f"{path}:/{DETECTOR}/bad", find_bad_pixels=False)
    assert np.array_equal(~views.whole().mask.numpy(), np.broadcast_to(bad, (VIEWS, ROWS, COLUMNS)))


def test_keys_that_do_not_fit_frames_by_name_are_named(tmp_path):
    """Line integrals of the views, beside the frames of which they were made."""
    path = tomo(tmp_path / "a.nxs", instrument__detector__corrected=integrals().astype("f4"))
    options = {"dataset": f"{DETECTOR}/corrected", "kind": "integrals"}
    with h5py.File(path, "a") as file:
        file["angles"] = ANGLES
    found = named(path, **options, angles="angles")
    assert found == ["data", "image_key", "image_key_control"]


def test_exposures_of_all_frames_are_those_of_the_views(tmp_path):
    light = np.full(len(KEYS), 7.0)
    light[KEYS == 0] = np.linspace(0.5, 1, VIEWS)
    path = tomo(tmp_path / "a.nxs", light=light)
    views = opened(path, exposure="entry/light", find_bad_pixels=False)
    right = integrals() + np.log(np.linspace(0.5, 1, VIEWS))[:, None, None]
    np.testing.assert_allclose(views.whole().views.numpy(), right, atol=1e-5)


def test_empty_units_are_none(tmp_path):
    path = scan(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        for name, kind in (("raw", "S1"), ("angles", h5py.string_dtype())):
            file[f"scan/{name}"].attrs["units"] = h5py.Empty(kind)
    assert named(path, **SCAN, **GIVEN) == []
    with h5py.File(path, "a") as file:
        file["scan/angles"].attrs["vector"] = h5py.Empty("f4")
    with pytest.raises(Refused, match="vector as numbers, got float32 None"):
        opened(path, **SCAN, **GIVEN)


@pytest.mark.parametrize("name", ["units", "unit"])
def test_units_of_pixels_by_each_of_their_names(name, tmp_path):
    path = tomo(tmp_path / "a.nxs", size=(None, 2.0, 3.0))
    with h5py.File(path, "a") as file:
        for axis in "yx":
            file[f"{DETECTOR}/{axis}_pixel_size"].attrs[name] = "um"
    assert opened(path).stack.rig["detector"]["pixel_mm"] == pytest.approx((2e-3, 3e-3))
