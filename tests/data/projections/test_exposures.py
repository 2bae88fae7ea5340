"""Views of unequal exposures have the line integrals of one object."""

import re
import warnings

import h5py
import numpy as np
import pytest
import torch
from PIL import Image as Pillow

from mvrecon.core.files.checks import Refused
from tests.data.projections.conftest import dicom_image, opened
from tests.data.projections.test_nexus import KEYS, tomo

#: Relative exposures: a view of a fifth of the flat field's time, and one of twice its own.
EXPOSURES = [1.0, 0.2, 2.0, 0.5]
FLAT, DARK = 20_000.0, 100.0


def scan(folder, flat=FLAT):
    """Views of a wedge whose transmissions fall from 1 to e^-2, and their line integrals."""
    integrals = np.linspace(0, 2, 24).reshape(4, 6)
    folder.mkdir()
    for k, exposure in enumerate(EXPOSURES):
        grey = DARK + (flat - DARK) * exposure * np.exp(-integrals)
        Pillow.fromarray(grey.round().clip(0, 65535).astype("u2")).save(folder / f"view_{k}.tif")
    return integrals


def write(path):
    """The exposures as a file of each kind that is read; the name of the option."""
    if path.suffix == ".npy":
        np.save(path, EXPOSURES)
    elif path.suffix == ".csv":
        lines = [f"{k},{90 * k},{one}\n" for k, one in enumerate(EXPOSURES)]
        path.write_text("view,angle,exposure\n" + "".join(lines))
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["entry/time"] = EXPOSURES
        return f"{path}:/entry/time"
    else:
        path.write_text("\n".join(map(str, EXPOSURES)))
    return path


@pytest.mark.parametrize("ending", [".txt", ".csv", ".npy", ".h5"])
def test_intensities_are_divided_by_the_exposure(ending, tmp_path):
    """Within half a grey value; without exposures they are off by its logarithm."""
    integrals = scan(tmp_path / "scan")
    options = {"flat": FLAT, "dark": DARK, "find_bad_pixels": False}
    path = write(tmp_path / f"exposures{ending}")
    found = opened(tmp_path / "scan", exposure=path, **options).whole().views.double().numpy()
    light = (FLAT - DARK) * np.array(EXPOSURES)[:, None, None] * np.exp(-integrals)
    assert (np.abs(found - integrals) < 0.6 / light + 1e-6).all()
    plain = opened(tmp_path / "scan", **options).whole().views.double().numpy()
    logs = np.log(EXPOSURES)[:, None, None]
    np.testing.assert_allclose(plain + logs, found, atol=1e-5)
    third = opened(tmp_path / "scan", exposure=path, every=2, **options).whole().views
    assert np.array_equal(third.double().numpy(), found[::2])


def test_long_exposures_saturate_by_their_grey_values(tmp_path):
    """Twice the exposure exceeds 16 bits where less than a fifth is absorbed: only there."""
    flat = 40_000.0
    integrals = scan(tmp_path / "scan", flat)
    options = {"flat": flat, "dark": DARK, "find_bad_pixels": False}
    with pytest.warns(UserWarning, match="saturated"):
        found = opened(tmp_path / "scan", exposure=write(tmp_path / "e.txt"), **options).whole()
    clipped = DARK + (flat - DARK) * 2.0 * np.exp(-integrals) >= 65535
    assert np.array_equal(~found.mask[2].numpy(), clipped) and clipped.any()
    assert found.mask[[0, 1, 3]].all()


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        ("1\n0.2\n2", "for each of 4 views on disk.*got 3"),
        ("1\n0.2\n0\n1", "positive exposure.*from 0 to 1"),
        ("1\n-1\n2\n1", "positive exposure.*from -1 to 2"),
        ("a,b\n1,2\n1,2", "expected one column of exposures"),
        ("1\nx\n2\n1", "has no exposures|line 2"),
    ],
)
def test_what_is_no_exposure_of_each_view_is_refused(lines, match, tmp_path):
    scan(tmp_path / "scan")
    (tmp_path / "e.txt").write_text(lines)
    with pytest.raises(Refused, match=re.compile(match, re.DOTALL)):
        opened(tmp_path / "scan", flat=FLAT, exposure=tmp_path / "e.txt")


def test_line_integrals_and_counts_have_no_exposure_to_divide_by(tmp_path):
    np.save(tmp_path / "views.npy", torch.rand(4, 4, 6).numpy())
    for kind in ("integrals", "counts"):
        with pytest.raises(Refused, match=f"expected intensities for views.exposure.*got {kind}"):
            opened(tmp_path / "views.npy", kind=kind, exposure=tmp_path / "e.txt")


def _dicom(folder, name, flat=2.5):
    """Views in files of their own, and a flat field with another exposure."""
    integrals = np.linspace(0, 2, 24).reshape(4, 6)
    folder.mkdir()
    for k, exposure in enumerate(EXPOSURES):
        grey = FLAT * exposure * np.exp(-integrals)
        tags = {"InstanceNumber": k, name: round(40 * exposure)}
        dicom_image(folder / f"view_{k}.dcm", grey.round().astype("u2"), **tags)
    field = np.full((4, 6), FLAT * flat).astype("u2")
    dicom_image(folder / "flat.dcm", field, **{name: 40 * flat} if flat != 1 else {})
    return integrals


@pytest.mark.parametrize("name", ["ExposureTime", "ExposureInuAs", "XRayTubeCurrentInuA"])
@pytest.mark.filterwarnings("ignore:.*several values")
def test_exposures_of_dicom_are_applied_by_their_name(name, tmp_path):
    """Of the views relative to that of the flat field; without one there the name is refused.
    Other inputs of the kind: frames of NeXus, below, and a voltage, to which light is not in
    proportion.
    """
    integrals = _dicom(tmp_path / "scan", name)
    found = opened(tmp_path / "scan", exposure=name, find_bad_pixels=False).whole().views
    np.testing.assert_allclose(found.numpy(), np.broadcast_to(integrals, found.shape), atol=2e-3)
    with pytest.raises(Refused, match=f"expected a positive {name} of the flat field"):
        opened(tmp_path / "scan", exposure=name, flat=FLAT)
    _dicom(tmp_path / "other", name, flat=1)
    with pytest.raises(Refused, match=f"expected a positive {name} of the flat field"):
        opened(tmp_path / "other", exposure=name)
    with pytest.raises(FileNotFoundError):
        opened(tmp_path / "scan", exposure="KVP")


@pytest.mark.parametrize("name", ["count_time", "control/data"])
@pytest.mark.filterwarnings("ignore:.*times that of the")
def test_exposures_of_nexus_are_applied_by_their_name(name, tmp_path):
    """Flat fields of half the exposure, and a beam that decays: integrals are those of a steady
    one.
    """
    stated = np.where(KEYS == 1, 0.05, np.linspace(0.1, 0.08, len(KEYS)))
    place = "control__data" if name == "control/data" else f"instrument__detector__{name}"
    path = tomo(tmp_path / "a.nxs", **{place: stated})
    found = opened(path, exposure=name, find_bad_pixels=False).whole().views
    plain = opened(path, find_bad_pixels=False).whole().views
    relative = np.log(stated[KEYS == 0] / 0.05)[:, None, None]
    np.testing.assert_allclose(found.numpy(), plain.numpy() + relative, atol=1e-5)


@pytest.mark.parametrize(
    ("of_views", "of_flat", "name"),
    [
        ({"ExposureTime": 40}, {"ExposureTime": 20}, "ExposureTime 20, its views have 40"),
        ({"XRayTubeCurrent": 9}, {"XRayTubeCurrent": 18}, "XRayTubeCurrent 18, its views have 9"),
        ({"KVP": 80}, {"KVP": 120}, "KVP 120.0, its views have 80.0"),
        ({"Exposure": 4}, {"Exposure": 4}, None),
        ({"Exposure": 4}, {}, None),
    ],
)
def test_flat_fields_of_another_exposure_or_beam_are_warned_of(of_views, of_flat, name, tmp_path):
    """Views that are alike among themselves, in DICOM. Beside these tried: flat fields of NeXus in
    another file; an exposure that is applied, of which nothing is said.
    """
    for k in range(4):
        dicom_image(tmp_path / f"v_{k}.dcm", np.full((4, 6), 9, "u2"), InstanceNumber=k, **of_views)
    dicom_image(tmp_path / "flat.dcm", np.full((4, 6), 20, "u2"), **of_flat)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        opened(tmp_path, find_bad_pixels=False)
    assert [name in str(one.message) for one in warned] == [True] * (name is not None)
    np.save(tmp_path / "exposures.npy", np.full(4, 2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(tmp_path, find_bad_pixels=False, exposure=tmp_path / "exposures.npy")


def test_flat_fields_of_another_exposure_in_another_file_of_nexus_are_warned_of(tmp_path):
    times = [np.full(len(KEYS), time) for time in (0.1, 0.1, 0.2)]
    views, same, longer = (
        tomo(tmp_path / f"{k}.nxs", instrument__detector__count_time=time)
        for k, time in enumerate(times)
    )
    with pytest.warns(UserWarning, match="2.nxs: the flat field has the count_time 0.2"):
        opened(views, flat=longer, find_bad_pixels=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(views, flat=same, find_bad_pixels=False)
        opened(views, flat=longer, find_bad_pixels=False, exposure="count_time")
