"""Attributes of HDF5 files that change values, units or axes are read or refused by name."""

from itertools import product

import h5py
import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.projections.arrays import Hdf5Views

VALUES = np.arange(60, dtype="f4").reshape(3, 4, 5)
COUNTS = {"unit": "counts", "dose": 2.0, "unit_per_dose": "spect of activity"}


def views(path, **attributes):
    """A views.h5 with these attributes."""
    with h5py.File(path, "w") as file:
        file.create_dataset("views", data=VALUES).attrs.update(attributes)
    return Hdf5Views(path)


@pytest.mark.parametrize(
    ("attributes", "kind"),
    [
        ({"unit": "1/mm * mm", "axes": "camera, v, u"}, "integrals"),
        ({"scale_factor": 1.0, "add_offset": np.zeros(1), "_FillValue": np.nan}, "integrals"),
        (COUNTS, "counts"),
        ({**COUNTS, "unit": np.bytes_("counts")}, "counts"),
        ({**COUNTS, "source": "a scanner", "duration": 3.0}, "counts"),
    ],
)
def test_known_attributes_of_views_are_read(attributes, kind, tmp_path):
    """Texts of fixed length as those of variable length; attributes without effect."""
    stack = views(tmp_path / "views.h5", **attributes)
    assert stack.kind == kind and stack.dose == attributes.get("dose")
    assert np.array_equal(stack.read(0, 3), VALUES)


EFFECTS = {
    "scale_factor": 2.0,
    "add_offset": np.float32(5),
    "RescaleSlope": 2,
    "intercept": -1000,
    "_FillValue": 0.0,
    "missing_value": -1,
    "units": "1/cm",
    "calibration": "a.txt",
    "gain": [1.0, 2.0],
    "conversion": 2.0,
    "multiplier": 0.5,
    "bias": 3,
    "exponent": 2,
    "_Unsigned": "true",
    "order": "x, y, z",
    "axisOrder": "xyz",
    "dimension_order": "C",
}


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("place", ["/", "views"])
def test_attributes_of_views_that_change_values_are_refused_by_name(place, name, tmp_path):
    """Those of NetCDF, DICOM and their like, on the file and on the data."""
    path = tmp_path / "views.h5"
    views(path)
    with h5py.File(path, "r+") as file:
        file[place].attrs[name] = EFFECTS[name]
    with pytest.raises(Refused, match=name):
        Hdf5Views(path)


@pytest.mark.parametrize(
    ("attributes", "name"),
    [
        ({"axes": "camera, u, v"}, "axes"),
        ({"unit": 5}, "unit"),
        ({"attenuated": 1}, "attenuated"),
        ({"attenuated": "true"}, "attenuated"),
        ({"unit": "Counts", "dose": 2.0}, "dose"),
        ({"unit": "1/mm * mm", "unit_per_dose": "a"}, "unit_per_dose"),
        ({**COUNTS, "dose": np.nan}, "dose"),
        ({**COUNTS, "dose": [2.0, 3.0]}, "dose"),
        ({**COUNTS, "duration": -1.0}, "duration"),
    ],
)
def test_attributes_of_views_with_other_values_are_refused_by_name(attributes, name, tmp_path):
    with pytest.raises(Refused, match=name):
        views(tmp_path / "views.h5", **attributes)


@pytest.mark.parametrize(
    ("place", "name"),
    sorted({*product(["/", "ct", "spacing"], EFFECTS)} - {("/", "units")}),  # known there
)
def test_attributes_of_volumes_that_change_values_are_refused_by_name(place, name, tmp_path):
    path = tmp_path / "ct.h5"
    write_volumes(path, [Stored("a", VALUES, (1.0, 2.0, 3.0))], source="a scanner")
    assert VolumeFile(path).read(0).name == "a"
    with h5py.File(path, "r+") as file:
        file[place].attrs[name] = EFFECTS[name]
    with pytest.raises(Refused, match=name):
        VolumeFile(path).read(0)


@pytest.mark.parametrize("text", ["mm", "mm, order z, y, x", "cm", "mm, order x, y, z"])
def test_the_unit_and_order_of_spacings_are_compared(text, tmp_path):
    path = tmp_path / "ct.h5"
    write_volumes(path, [Stored("a", VALUES, (1.0, 2.0, 3.0))])
    with h5py.File(path, "r+") as file:
        file.attrs["spacing_units"] = text
    if text in ("mm", "mm, order z, y, x"):
        assert VolumeFile(path).read(0).spacing == (1.0, 2.0, 3.0)
        return
    with pytest.raises(Refused, match="spacing_units"):
        VolumeFile(path).read(0)


@pytest.mark.parametrize("name", ["order", "axes"])
@pytest.mark.parametrize(
    ("text", "read"),
    [
        *(("z, y, x", True), ("zyx", True), ("(z,y,x)", True), ("x, y, z", False), ("xyz", False)),
        (np.array([b"z", b"y", b"x"]), True),
        (np.array([b"x", b"y", b"z"]), False),
    ],
)
def test_the_order_of_spacings_is_compared(name, text, read, tmp_path):
    """By an attribute of the data set itself. An order of other words is refused."""
    path = tmp_path / "ct.h5"
    write_volumes(path, [Stored("a", VALUES, (1.0, 2.0, 3.0))])
    with h5py.File(path, "r+") as file:
        file["spacing"].attrs[name] = text
    if read:
        assert VolumeFile(path).read(0).spacing == (1.0, 2.0, 3.0)
        return
    with pytest.raises(Refused, match=f"/spacing: .*by its {name}"):
        VolumeFile(path).read(0)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (("camera", "v", "u"), None),
        (("", "", "u"), None),
        (("v", "u", "camera"), "axis 'v' at the place 0 by its DIMENSION_LABELS"),
        (("view", "x", "y"), "axis 'x' at the place 1 by its DIMENSION_LABELS"),
    ],
)
def test_labels_of_axes_are_compared(labels, message, tmp_path):
    """Of views; and of volumes, for which z, y and x are reversed."""
    path, ct = tmp_path / "views.h5", tmp_path / "ct.h5"
    views(path)
    write_volumes(ct, [Stored("a", VALUES, (1.0, 2.0, 3.0))])
    axes = ("n", "z", "y", "x") if message is None else ("n", "x", "y", "z")
    for file, name, texts in ((path, "views", labels), (ct, "ct", axes)):
        with h5py.File(file, "r+") as opened:
            for dim, text in zip(opened[name].dims, texts, strict=True):
                dim.label = text
    if message is None:
        assert Hdf5Views(path).n_views == 3 and VolumeFile(ct).read(0).name == "a"
        return
    with pytest.raises(Refused, match=message):
        Hdf5Views(path)
    with pytest.raises(Refused, match="axis 'x' at the place 1"):
        VolumeFile(ct).read(0)


FIELDS = ("slope", "rescale_intercept", "scale", "units", "offset", "gain")


@pytest.mark.parametrize("name", [*FIELDS, "origin", "affine", "mask", "split", "patient_age"])
def test_other_data_sets_of_a_file_are_refused_or_named(name, tmp_path):
    """Of volumes and of views: a slope of each volume is refused, unless it is 1; one warning names
    the others. Also tried: a group, a link to another file, and attributes of the data.
    """
    path, ct = tmp_path / "views.h5", tmp_path / "ct.h5"
    views(path)
    write_volumes(ct, [Stored("a", VALUES, (1.0, 2.0, 3.0))])
    for file in (path, ct):
        with h5py.File(file, "r+") as opened:
            opened[name] = np.full(3, 2.0)
    if name in FIELDS:
        for read in (lambda: VolumeFile(ct).read(0), lambda: Hdf5Views(path)):
            with pytest.raises(Refused, match=f"no field '{name}' beside"):
                read()
        return
    with pytest.warns(UserWarning, match=f"does not know: {name};") as found:
        assert np.array_equal(VolumeFile(ct).read(0).ct, VALUES)
    assert len(found) == 1
    assert Hdf5Views(path).unknown == [name]


@pytest.mark.parametrize(
    ("place", "unit", "read"),
    [("ct", "HU", True), ("ct", "1/cm", False), ("spacing", "mm", True), ("spacing", "cm", False)],
)
def test_units_of_volumes_and_spacings_are_compared(place, unit, read, tmp_path):
    path = tmp_path / "ct.h5"
    write_volumes(path, [Stored("a", VALUES, (1.0, 2.0, 3.0))])
    with h5py.File(path, "r+") as file:
        file[place].attrs["units"] = unit
    if read:
        assert VolumeFile(path).read(0).spacing == (1.0, 2.0, 3.0)
        return
    with pytest.raises(Refused, match=f"/{place}: expected the units .*, got '{unit}'"):
        VolumeFile(path).read(0)
