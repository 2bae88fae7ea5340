"""Data sets beside frames in HDF5 that are not used are named; moves of sample and detector.

Truth: the definitions of NeXus and of Data Exchange. Tried beside these: control data and energies,
links to frames, fields and masks in other files, and translations that nxtomo writes as tx.
"""

import h5py
import numpy as np
import pytest

from tests.data.projections.conftest import COLUMNS, ROWS, VIEWS, grey, opened
from tests.data.projections.test_nexus import KEYS, exchange, frames, tomo
from tests.data.projections.test_unknown_keys import GIVEN, named

TIMES, MASK = np.ones(VIEWS), np.ones((ROWS, COLUMNS), "u1")


@pytest.mark.parametrize("layout", [None, "sinogram"])
def test_keys_beside_frames_by_name_that_are_not_used_are_named(layout, tmp_path):
    """Of frames, also those that rows of sinograms do not use; keys that do not count are not."""
    values = grey() if layout is None else grey().swapaxes(0, 1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["raw"], file["theta"] = values, TIMES
        file["data_white"] = MASK.astype("u2")
        file["pixel_mask"], file["saturation_value"], file["count_time"] = MASK * 0, 65_000, TIMES
        file["energy"], file["description"], file["depends_on"] = 20.0, "corrected", "."
    of_frames = [] if layout is None else ["count_time", "pixel_mask", "saturation_value"]
    found = named(tmp_path / "a.h5", dataset="raw", layout=layout, **GIVEN)
    assert found == sorted(["data_white", "theta", *of_frames])
    found = named(tmp_path / "a.h5", dataset="raw", layout=layout, **GIVEN | {"flat": "data_white"})
    assert "data_white" not in found


def test_keys_of_which_another_is_used_are_known(tmp_path):
    """Pixel sizes of the detector beside those of the sample, a key beside that of control, and
    links of a plot."""
    path = tomo(tmp_path / "a.nxs", sample__x_pixel_size=2e-3, sample__y_pixel_size=2e-3)
    with h5py.File(path, "a") as file:
        for axis in "xy":
            file[f"entry/sample/{axis}_pixel_size"].attrs["units"] = "mm"
        for name in ("instrument/detector/data", "instrument/detector/image_key"):
            file[f"entry/data/{name.rpartition('/')[2]}"] = h5py.SoftLink(f"/entry/{name}")
        file["entry/data/rotation_angle"] = file["entry/sample/rotation_angle"]
    assert named(path) == []


@pytest.mark.parametrize("name", ["gain", "count_time", "pixel_mask", "x_flipped", "image_key"])
def test_data_sets_beside_parts_of_virtual_frames_are_named(name, tmp_path):
    """Unless the file of the frames states it itself, as image_key."""
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["camera/data"], file[f"camera/{name}"] = frames(), 2
    path, shape = tomo(tmp_path / "a.nxs"), (len(KEYS), ROWS, COLUMNS)
    layout = h5py.VirtualLayout(shape, "u2")
    layout[:] = h5py.VirtualSource("raw.h5", "camera/data", shape, "u2")
    with h5py.File(path, "a") as file:
        del file["entry/instrument/detector/data"]
        file.create_virtual_dataset("entry/instrument/detector/data", layout)
    assert named(path) == ([] if name == "image_key" else [name])


def test_data_sets_beside_a_linked_field_of_data_exchange_are_named(tmp_path):
    other = exchange(tmp_path / "air.h5", gain=2.0)
    path = exchange(tmp_path / "a.h5", data_white=None)
    with h5py.File(path, "a") as file:
        file["exchange/data_white"] = h5py.ExternalLink(other.name, "/exchange/data_white")
    assert named(path) == ["gain"]


DETECTOR = "entry/instrument/detector"
MOVES = {
    "the sample, of views": ("entry/sample/x_translation", VIEWS),
    "the sample, of frames": ("entry/sample/z_translation", len(KEYS)),
    "a stage of the sample": ("entry/sample/transformations/tx", len(KEYS)),
    "the detector": (f"{DETECTOR}/x_translation", len(KEYS)),
    "the detector, by NXtransformations": (f"{DETECTOR}/transformations/tx", VIEWS),
    "the detector, by its depends_on": (f"{DETECTOR}/stage", len(KEYS)),
}


@pytest.mark.parametrize("still", [True, False])
@pytest.mark.parametrize("unit", ["units", "unit"])
@pytest.mark.parametrize("case", MOVES)
def test_a_sample_or_a_detector_that_moves_is_warned_of(case, unit, still, tmp_path):
    """By more than 0.1 pixels of 2 um; the key of flat fields counts with frames alone."""
    (name, count), path = MOVES[case], tomo(tmp_path / "a.nxs")
    move = np.full(count, 5.0) if still else np.linspace(0, 0.5, count)
    if count != VIEWS:
        move[KEYS != 0] = 100
    with h5py.File(path, "a") as file:
        file[name] = move
        file[name].attrs.update({unit: "mm", "transformation_type": "translation"})
        file[f"{DETECTOR}/depends_on"] = "stage" if name.endswith("stage") else "."
    if still:
        assert named(path) == []
        return
    with pytest.warns(UserWarning, match=f"{name}: the sample moved by .* to the detector"):
        opened(path, find_bad_pixels=False)


def test_a_sample_that_moves_between_the_angles_of_sinograms_is_warned_of(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["raw"], file["sample/x_translation"] = grey().swapaxes(0, 1), np.arange(VIEWS)
    with pytest.warns(UserWarning, match="x_translation: the sample moved by 11 between"):
        opened(tmp_path / "a.h5", dataset="raw", layout="sinogram", **GIVEN)


@pytest.mark.parametrize("name", ["instrument/tube", "instrument/source", "xray_tube"])
def test_a_source_of_any_name_counts_by_its_class(name, tmp_path):
    path = tomo(tmp_path / "a.nxs", **{f"{name}/type": "Fixed Tube X-ray"})
    with h5py.File(path, "a") as file:
        file[f"entry/{name}"].attrs["NX_class"] = "NXsource"
    assert opened(path).stack.rig["name"] is None


@pytest.mark.parametrize("kind", ["NXmonitor", "NXbeam"])
@pytest.mark.parametrize("name", ["instrument/ionc", "ionc", "control", "beam"])
def test_monitors_and_beams_of_other_names_are_named(name, kind, tmp_path):
    path = tomo(tmp_path / "a.nxs", **{f"{name}/distance": 1.0})
    with h5py.File(path, "a") as file:
        file[f"entry/{name}"].attrs["NX_class"] = np.bytes_(kind)
    assert named(path) == (["ionc"] if name.endswith("ionc") else [])


BEAMS = {
    "beam/incident_energy": (20.0, 30.0, tomo),
    "../measurement/instrument/monochromator/energy": (20.0, 30.0, exchange),
    "../measurement/instrument/attenuator/attenuator_transmission": (1.0, 0.5, exchange),
    "../measurement/instrument/source/current": (200.0, 100.0, exchange),
    "../measurement/instrument/detector/gain_setting": ("low", "high", exchange),
    "../measurement/instrument/detector/count_time": (0.1, 0.2, exchange),
}


@pytest.mark.parametrize("alike", [True, False])
@pytest.mark.parametrize("name", BEAMS)
def test_a_flat_field_of_another_beam_is_warned_of(name, alike, tmp_path):
    """Of nxtomo's beam, and of Data Exchange's instrument."""
    own, other, write = BEAMS[name]
    paths = [write(tmp_path / "a.h5"), write(tmp_path / "air.h5")]
    for path, value in zip(paths, (own, own if alike else other), strict=True):
        with h5py.File(path, "a") as file:
            file["entry" if write is tomo else "exchange"][name.replace("../", "/")] = value
    if alike:
        assert named(paths[0], flat=str(paths[1])) == []
        return
    last = name.rpartition("/")[2]
    with pytest.warns(UserWarning, match=f"the flat field has the ([a-z/]*/)?{last} "):
        opened(paths[0], flat=str(paths[1]), find_bad_pixels=False)


def test_a_tube_and_a_moved_sample_of_data_exchange_count(tmp_path):
    path = exchange(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["measurement/instrument/source/type"] = "X-ray tube"
        file["measurement/sample/x_translation"] = np.arange(VIEWS)
    with pytest.warns(UserWarning, match="x_translation: the sample moved by 11"):
        assert opened(path, find_bad_pixels=False).stack.rig["name"] is None
