"""Views of unequal exposures have the line integrals of one object."""

import re
import warnings

import h5py
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image as Pillow

from mvrecon.core.files.checks import Refused
from tests.data.projections.conftest import dicom_image, opened
from tests.data.projections.test_nexus import KEYS, exchange, tomo
from tests.data.projections.test_tiff import written

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
@pytest.mark.filterwarnings("ignore:.*the dark field has")
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
        (
            {"RelativeXRayExposure": 100},
            {"RelativeXRayExposure": 200},
            "RelativeXRayExposure 200, its views have 100",
        ),
        ({"EntranceDose": 10}, {"EntranceDose": 20}, "EntranceDose 20, its views have 10"),
        (
            {"FrameAcquisitionDuration": 10.0},
            {"FrameAcquisitionDuration": 20.0},
            "FrameAcquisitionDuration 20, its views have 10",
        ),
        ({"Grid": "FIXED"}, {"Grid": "NONE"}, "Grid NONE, its views have FIXED"),
        (
            {"Grid": ["FIXED", "FOCUSED"], "GridAbsorbingMaterial": "LEAD"},
            {"Grid": ["FIXED", "FOCUSED"], "GridAbsorbingMaterial": "TUNGSTEN"},
            "GridAbsorbingMaterial TUNGSTEN, its views have LEAD",
        ),
        ({"GridPitch": 0.2}, {"GridPitch": 0.4}, "GridPitch 0.4, its views have 0.2"),
        ({"DetectorMode": "LOW"}, {"DetectorMode": "HIGH"}, "DetectorMode HIGH, its views have"),
        ({"HalfValueLayer": "3"}, {"HalfValueLayer": "9"}, "HalfValueLayer 9, its views have 3"),
        ({"Exposure": 4}, {"Exposure": 4}, None),
        ({"KVP": "80"}, {"KVP": "80.0"}, None),
        ({"KVP": "80"}, {"KVP": "80.05"}, None),
        ({"KVP": "80"}, {"KVP": "81"}, "KVP 81, its views have 80"),
        ({"Grid": ["FIXED", "FOCUSED"]}, {"Grid": ["FOCUSED", "FIXED"]}, None),
        ({"Grid": ["FIXED", "FOCUSED"]}, {"Grid": ["FIXED"]}, "Grid FIXED, its views have"),
        ({"FilterThicknessMinimum": [1, 2]}, {"FilterThicknessMinimum": [2.0, 1.0]}, None),
        (
            {"FilterThicknessMinimum": [1, 2]},
            {"FilterThicknessMinimum": [1, 3]},
            "Minimum [1.0, 3.0]",
        ),
        ({"GridID": "100001"}, {"GridID": "100002"}, "GridID 100002, its views have 100001"),
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


#: What views (of equal or of four unequal values) and the flat field state, by the light of the
#: views relative to the flat field's.
AGREE = {
    "time and current": (
        "ExposureTime*XRayTubeCurrent",
        {"ExposureTime": [40, 20, 40, 80], "XRayTubeCurrent": [9, 18, 36, 9]},
        {"ExposureTime": 20, "XRayTubeCurrent": 18},
        [1, 1, 4, 2],
    ),
    "uAs and their time and current": (
        "ExposureInuAs",
        {
            **{"ExposureInuAs": [360, 720, 180, 360], "ExposureTime": [20, 40, 20, 40]},
            **{"XRayTubeCurrent": [18, 18, 9, 9]},
        },
        {"ExposureInuAs": 720, "ExposureTime": 40, "XRayTubeCurrent": 18},
        [0.5, 1, 0.25, 0.5],
    ),
    "mAs of whole numbers": (
        "ExposureInuAs",
        {"ExposureInuAs": [4400, 8800, 4400, 4400], "Exposure": [4, 9, 4, 4]},
        {"ExposureInuAs": 8800, "Exposure": 9},
        [0.5, 1, 0.5, 0.5],
    ),
    "uAs and another time, of an unknown current": (
        "ExposureInuAs",
        {"ExposureInuAs": [10, 20, 40, 80], "ExposureTime": [5] * 4},
        {"ExposureInuAs": 20, "ExposureTime": 40},
        [0.5, 1, 2, 4],
    ),
    "a steady current": (
        "ExposureTime",
        {"ExposureTime": [40, 20, 40, 80], "XRayTubeCurrentInuA": [900] * 4},
        {"ExposureTime": 20, "XRayTubeCurrentInuA": 900},
        [2, 1, 2, 4],
    ),
    "two units of time": (
        "ExposureTimeInuS",
        {"ExposureTimeInuS": [2600, 5200, 2600, 2600], "ExposureTime": [3, 5, 3, 3]},
        {"ExposureTimeInuS": 5200, "ExposureTime": 5},
        [0.5, 1, 0.5, 0.5],
    ),
    "flat fields in other units": (
        "ExposureTimeInuS*XRayTubeCurrent",
        {"ExposureTimeInuS": [4000, 2000, 4000, 8000], "XRayTubeCurrent": [90, 180, 360, 90]},
        {"ExposureTimeInms": 2.0, "XRayTubeCurrentInuA": 180_000},
        [1, 1, 4, 2],
    ),
    "whole mAs of a flat field": (
        "ExposureTimeInuS",
        {"ExposureTimeInuS": [4400, 8800, 4400, 4400], "ExposureInuAs": [4400, 8800, 4400, 4400]},
        {"ExposureTimeInuS": 8800, "Exposure": 9},
        [0.5, 1, 0.5, 0.5],
    ),
    "frames within the time": (
        "ExposureTime",
        {"ExposureTime": [40, 20, 40, 80], "NumberOfFramesIntegrated": [4, 2, 4, 8]},
        {"ExposureTime": 20, "NumberOfFramesIntegrated": 2},
        [2, 1, 2, 4],
    ),
    "a current that the flat field does not state": (
        "ExposureTime",
        {"ExposureTime": [40, 20, 40, 80], "XRayTubeCurrent": [9] * 4},
        {"ExposureTime": 20},
        [2, 1, 2, 4],
    ),
}
CONTRADICT = {
    "another current": (
        "ExposureTime",
        {"ExposureTime": 40, "XRayTubeCurrent": 9},
        {"ExposureTime": 40, "XRayTubeCurrent": 18},
        "ExposureTime*XRayTubeCurrent",
    ),
    "current as time, both twice": (
        "ExposureTime",
        {"ExposureTime": 40, "XRayTubeCurrent": 18},
        {"ExposureTime": 20, "XRayTubeCurrent": 9},
        "ExposureTime*XRayTubeCurrent",
    ),
    "another time": (
        "XRayTubeCurrentInuA",
        {"XRayTubeCurrentInuA": 9000, "ExposureTimeInuS": 400},
        {"XRayTubeCurrentInuA": 18000, "ExposureTimeInuS": 200},
        "ExposureTimeInuS*XRayTubeCurrentInuA",
    ),
    "another current in another unit": (
        "ExposureTime",
        {"ExposureTime": 400, "XRayTubeCurrentInuA": 9000},
        {"ExposureTime": 400, "XRayTubeCurrent": 18},
        "ExposureTime*XRayTubeCurrentInuA",
    ),
    "other mAs": (
        "ExposureTime",
        {"ExposureTime": 400, "Exposure": 40},
        {"ExposureTime": 400, "Exposure": 80},
        "Exposure",
    ),
    "other uAs": (
        "ExposureTimeInms",
        {"ExposureTimeInms": 40.0, "ExposureInuAs": 360},
        {"ExposureTimeInms": 40.0, "ExposureInuAs": 720},
        "ExposureInuAs",
    ),
    "mAs that are not time times current": (
        "ExposureInmAs",
        {"ExposureInmAs": 40.0, "ExposureTimeInms": 40.0, "XRayTubeCurrentInmA": 1000.0},
        {"ExposureInmAs": 40.0, "ExposureTimeInms": 40.0, "XRayTubeCurrentInmA": 2000.0},
        "ExposureTimeInms*XRayTubeCurrentInmA",
    ),
    "two units of time": (
        "ExposureTime",
        {"ExposureTime": 400, "ExposureTimeInuS": 400_000},
        {"ExposureTime": 400, "ExposureTimeInuS": 800_000},
        "ExposureTimeInuS",
    ),
    "other monitor units": (
        "ExposureTime",
        {"ExposureTime": 400, "MetersetExposure": 1.0},
        {"ExposureTime": 400, "MetersetExposure": 2.0},
        "MetersetExposure",
    ),
    "frames that were summed or averaged": (
        "ExposureTime",
        {"ExposureTime": 40, "NumberOfFramesIntegrated": 4},
        {"ExposureTime": 40, "NumberOfFramesIntegrated": 16},
        "ExposureTime*NumberOfFramesIntegrated",
    ),
    "another entrance dose": (
        "ExposureTime",
        {"ExposureTime": 40, "EntranceDoseInmGy": 1.5},
        {"ExposureTime": 40, "EntranceDoseInmGy": 3.0},
        "EntranceDoseInmGy",
    ),
    "an entrance dose in dGy": (
        "ExposureTime",
        {"ExposureTime": 40, "EntranceDoseInmGy": 3000.0},
        {"ExposureTime": 40, "EntranceDose": 60},
        "EntranceDoseInmGy",
    ),
    "another relative exposure": (
        "ExposureTime",
        {"ExposureTime": 40, "RelativeXRayExposure": 100},
        {"ExposureTime": 40, "RelativeXRayExposure": 300},
        "ExposureTime*RelativeXRayExposure",
    ),
    "frames of another duration": (
        "ExposureTime",
        {"ExposureTime": 40, "FrameAcquisitionDuration": 40.0},
        {"ExposureTime": 40, "FrameAcquisitionDuration": 80.0},
        "ExposureTime*FrameAcquisitionDuration",
    ),
    "pulses": (
        "ExposureTime",
        {"ExposureTime": 40, "AveragePulseWidth": 4.0},
        {"ExposureTime": 40, "AveragePulseWidth": 8.0},
        "ExposureTime*AveragePulseWidth",
    ),
}


def stated(folder, of_views, of_flat, light=(1, 1, 1, 1)):
    """Four views in DICOM beside a flat field, and the line integrals of each."""
    integrals = np.linspace(0, 2, 24).reshape(4, 6)
    for k in range(4):
        tags = {n: v[k] if isinstance(v, list) else v for n, v in of_views.items()}
        grey = (5000 * light[k] * np.exp(-integrals)).round().astype("u2")
        dicom_image(folder / f"view_{k}.dcm", grey, InstanceNumber=k, **tags)
    dicom_image(folder / "flat.dcm", np.full((4, 6), 5000, "u2"), **of_flat)
    return integrals


@pytest.mark.parametrize("case", AGREE)
@pytest.mark.filterwarnings("ignore:.*several values")
def test_exposures_by_name_that_all_attributes_explain_are_applied(case, tmp_path):
    """The views have the line integrals of one object, whose light is time times current."""
    name, of_views, of_flat, light = AGREE[case]
    integrals = stated(tmp_path, of_views, of_flat, light)
    found = opened(tmp_path, exposure=name, find_bad_pixels=False).whole().views
    np.testing.assert_allclose(found.numpy(), np.broadcast_to(integrals, found.shape), atol=3e-3)


@pytest.mark.parametrize("case", CONTRADICT)
def test_exposures_by_name_that_another_attribute_contradicts_are_refused(case, tmp_path):
    """By the ratio that would be lost, with the product or the name that has it. A file of
    exposures says what counts.

    Other inputs of the kind: attributes of NeXus, below; views that differ among themselves.
    """
    name, of_views, of_flat, cure = CONTRADICT[case]
    stated(tmp_path, of_views, of_flat)
    with pytest.raises(Refused, match=re.escape(f"views.exposure={cure} if light is")):
        opened(tmp_path, exposure=name, find_bad_pixels=False)
    np.save(tmp_path / "exposures.npy", np.full(4, 2.0))
    assert opened(tmp_path, exposure=tmp_path / "exposures.npy", find_bad_pixels=False).n_views == 4


@pytest.mark.filterwarnings("ignore:.*several values")
def test_one_view_of_another_current_is_refused(tmp_path):
    """Views that differ among themselves, of which one is as the flat field."""
    stated(tmp_path, {"ExposureTime": 40, "XRayTubeCurrent": [9, 9, 9, 18]}, {"ExposureTime": 40})
    assert opened(tmp_path, exposure="ExposureTime", find_bad_pixels=False).n_views == 4
    dicom_image(
        tmp_path / "flat.dcm", np.full((4, 6), 5000, "u2"), ExposureTime=40, XRayTubeCurrent=9
    )
    with pytest.raises(Refused, match=r"ExposureTime\*XRayTubeCurrent to change .* 1 to 2"):
        opened(tmp_path, exposure="ExposureTime", find_bad_pixels=False)


def test_another_voltage_is_warned_of_beside_an_exposure_by_name(tmp_path):
    """To which light is not in proportion. Dark fields of another time are warned of as well."""
    stated(tmp_path, {"ExposureTime": 40, "KVP": 80}, {"ExposureTime": 20, "KVP": 120})
    dicom_image(tmp_path / "dark.dcm", np.zeros((4, 6), "u2"), ExposureTime=20, XRayTubeCurrent=0)
    with pytest.warns(UserWarning) as warned:
        opened(tmp_path, exposure="ExposureTime", find_bad_pixels=False)
    texts = " ".join(str(one.message) for one in warned)
    assert len(warned) == 2 and "KVP 120.0, its views have 80.0" in texts
    assert "the dark field has the ExposureTime 20, its views have 40" in texts


FLAT_OF = np.where(KEYS == 1, 0.05, 0.1)
DECAY = np.linspace(1, 0.8, len(KEYS))
NEXUS = {
    "a steady beam": ("count_time", {"count_time": FLAT_OF, "control/data": 300.0}, FLAT_OF),
    "counts of a steady beam": (
        "control/data",
        {"count_time": FLAT_OF, "control/data": 7 * FLAT_OF},
        FLAT_OF,
    ),
    "time and current": (
        "count_time*control/data",
        {"count_time": FLAT_OF, "control/data": DECAY},
        FLAT_OF * DECAY,
    ),
    "counts and current": (
        "control/data",
        {"control/data": DECAY, "instrument/source/current": 300 * DECAY},
        DECAY,
    ),
    "a current of views of one time": (
        "instrument/source/current",
        {"count_time": 0.1, "instrument/source/current": DECAY},
        DECAY,
    ),
    "one time": ("count_time", {"count_time": 0.1}, np.ones(len(KEYS))),
    "one time in an array": ("count_time", {"count_time": [[0.2]]}, np.ones(len(KEYS))),
}
NEXUS_REFUSED = {
    "a beam that decays": ("count_time", {"count_time": FLAT_OF, "control/data": DECAY}),
    "a current that decays": (
        "count_time",
        {"count_time": 0.1, "instrument/source/current": DECAY},
    ),
    "a flux that decays": (
        "count_time",
        {"count_time": 0.1, "instrument/beam/incident_flux": DECAY},
    ),
    "a current of other times": ("control/data", {"count_time": FLAT_OF, "control/data": 300.0}),
    "a current of other times, by its name": (
        "instrument/source/current",
        {"count_time": FLAT_OF, "instrument/source/current": 300.0},
    ),
    "summed frames": ("count_time", {"count_time": 0.1, "number_of_cycles": np.where(KEYS, 8, 2)}),
}


def monitored(path, sets):
    """A file of NXtomo with exposures by the names of the option."""
    detector = ("count_time", "number_of_cycles")
    places = {f"instrument/detector/{n}" if n in detector else n: v for n, v in sets.items()}
    return tomo(path, **{name.replace("/", "__"): value for name, value in places.items()})


@pytest.mark.parametrize("case", NEXUS)
def test_exposures_of_nexus_that_all_monitors_explain_are_applied(case, tmp_path):
    """One number for all frames, one of each frame, and products by name."""
    name, sets, light = NEXUS[case]
    path = monitored(tmp_path / "a.nxs", sets)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = opened(path, exposure=name, find_bad_pixels=False).whole().views.numpy()
    plain = opened(tomo(tmp_path / "b.nxs"), find_bad_pixels=False).whole().views.numpy()
    relative = light[KEYS == 0] / light[KEYS == 1].mean()
    np.testing.assert_allclose(found, plain + np.log(relative)[:, None, None], atol=1e-5)


@pytest.mark.parametrize("case", NEXUS_REFUSED)
def test_exposures_of_nexus_that_a_monitor_contradicts_are_refused(case, tmp_path):
    """Other inputs of the kind: a monitor of views alone, which is warned of."""
    name, sets = NEXUS_REFUSED[case]
    path = monitored(tmp_path / "a.nxs", sets)
    with pytest.raises(Refused, match="expected .* to change as .* between the flat field"):
        opened(path, exposure=name, find_bad_pixels=False)


def test_one_time_of_all_views_is_compared_with_that_of_flat_fields_elsewhere(tmp_path):
    """Tried beside it: times of another number than frames or views, and names of which views state
    none, which are refused for what they are.
    """
    views = monitored(tmp_path / "a.nxs", {"count_time": 0.1})
    longer = monitored(tmp_path / "b.nxs", {"count_time": 0.2})
    with pytest.warns(UserWarning, match="b.nxs: the flat field has the count_time 0.2"):
        plain = opened(views, flat=longer, find_bad_pixels=False).whole().views
    halved = opened(views, flat=longer, exposure="count_time", find_bad_pixels=False)
    np.testing.assert_allclose(halved.whole().views, plain + np.log(0.5), atol=1e-5)
    for name in ("control/data", "times.txt"):
        with pytest.raises(FileNotFoundError, match=f"{name}.*each view states count_time"):
            opened(views, exposure=name)
    with pytest.raises(Refused, match="expected a positive count_time of the flat field"):
        opened(views, flat=60_000, exposure="count_time")
    some = monitored(tmp_path / "c.nxs", {"count_time": [0.1, 0.2, 0.1]})
    with pytest.warns(UserWarning, match="one of each of 19 frames or 12 views, got 3"):
        with pytest.raises(FileNotFoundError, match="by name, each view states no exposure"):
            opened(some, exposure="count_time")


@pytest.mark.parametrize("differs", ["Different", "Same", 1, 0, None])
def test_flat_fields_of_another_exposure_in_data_exchange(differs, tmp_path):
    """As tomoscan writes it: a time of the views, one of the flat fields, and whether it counts."""
    path, flats = exchange(tmp_path / "a.h5"), "process/acquisition/flat_fields"
    plain = opened(path, find_bad_pixels=False).whole().views
    with h5py.File(path, "a") as file:
        file["measurement/instrument/detector/exposure_time"] = [0.1]
        file[f"{flats}/flat_exposure_time"] = 0.05
        if differs is not None:
            file[f"{flats}/different_flat_exposure"] = differs
    same = differs in ("Same", 0)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        opened(path, find_bad_pixels=False)
    words = "the flat field has the exposure_time 0.05, its views have 0.1"
    assert [words in str(one.message) for one in warned] == [True] * (not same)
    found = opened(path, exposure="exposure_time", find_bad_pixels=False).whole().views
    np.testing.assert_allclose(found, plain + (0 if same else np.log(2)), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "own", "other"),
    [
        ("RelativeXRayExposure", 100, 200),
        ("EntranceDoseInmGy", 1.5, 3.0),
        ("FrameAcquisitionDuration", 10.0, 20.0),
        ("Grid", "FIXED", "NONE"),
        ("GridThickness", 2.0, 3.0),
    ],
)
def test_views_of_several_doses_or_grids_are_warned_of(name, own, other, tmp_path):
    for k in range(3):
        tags = {"InstanceNumber": k, name: other if k == 2 else own}
        dicom_image(tmp_path / f"v_{k}.dcm", np.full((4, 6), 9, "u2"), **tags)
    with pytest.warns(UserWarning, match=f"views have several values of {name}"):
        opened(tmp_path, flat=20.0, find_bad_pixels=False)


@pytest.mark.filterwarnings("ignore:.*several values")
def test_exposure_times_of_tiff_are_applied_by_their_name(tmp_path):
    """Of EXIF's tags, in files of their own; those of the pages of one file as well."""
    integrals = scan(tmp_path / "scan")
    tags = [[(33434, "2I", 1, (round(10 * e), 100), True)] for e in (*EXPOSURES, 1.0)]
    for k, tag in enumerate(tags[:-1]):
        with Pillow.open(tmp_path / f"scan/view_{k}.tif") as image:
            written(tmp_path / f"scan/view_{k}.tif", np.asarray(image), extratags=tag)
    written(tmp_path / "scan/flat.tif", np.full((4, 6), FLAT, "u2"), extratags=tags[-1])
    options = {"dark": DARK, "exposure": "ExposureTime", "find_bad_pixels": False}
    pages = tmp_path / "pages.tif"
    with tifffile.TiffWriter(pages) as file:
        for k, tag in enumerate(tags[:-1]):
            page = tifffile.imread(tmp_path / f"scan/view_{k}.tif")
            file.write(page, extratags=tag, metadata=None, contiguous=False)
    for path, flat in ((tmp_path / "scan", None), (pages, str(tmp_path / "scan/flat.tif"))):
        found = opened(path, flat=flat, **options).whole().views.numpy()
        np.testing.assert_allclose(found, np.broadcast_to(integrals, found.shape), atol=2e-3)


@pytest.mark.parametrize(("own", "other", "warned"), [((28, 10), (14, 5), 0), ((4, 1), (28, 5), 1)])
def test_f_numbers_are_compared_as_ratios(own, other, warned, tmp_path):
    """As one camera or another states them; also tried: a denominator of 0, which is a text."""
    for name, ratio in (("view", own), ("flat", other)):
        tag = [(33437, "2I", 1, ratio, True)]
        written(tmp_path / f"{name}.tif", np.full((4, 6), 900, "u2"), extratags=tag)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(tmp_path / "view.tif", flat=str(tmp_path / "flat.tif"), find_bad_pixels=False)
    assert sum("has the FNumber" in str(one.message) for one in caught) == warned


@pytest.mark.parametrize(("unit", "factor"), [("s", 1), ("ms", 1e3), (b"us", 1e6), ("min", 1 / 60)])
def test_times_of_two_files_are_compared_in_one_unit(unit, factor, tmp_path):
    """Of views in s; of currents as well."""
    views = monitored(tmp_path / "a.nxs", {"count_time": 0.1, "instrument/source/current": 0.2})
    sets = {"count_time": 0.1 * factor, "instrument/source/current": 200.0}
    flats = monitored(tmp_path / "b.nxs", sets)
    with h5py.File(flats, "a") as file:
        file["entry/instrument/detector/count_time"].attrs["units"] = unit
        file["entry/instrument/source/current"].attrs["units"] = "mA"
    plain = opened(views, find_bad_pixels=False).whole().views
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = opened(views, flat=flats, exposure="count_time", find_bad_pixels=False)
    np.testing.assert_allclose(found.whole().views, plain, atol=1e-5)


UNITS = {
    "msec": 1e3,
    "milliseconds": 1e3,
    "Microseconds": 1e6,
    "μs": 1e6,
    "sec": 1,
    "Minutes": 1 / 60,
    "SECS": 1,
    "Second(s)": 1,
    "millisecond(s)": 1e3,
}


@pytest.mark.parametrize("unit", UNITS)
def test_times_of_one_file_are_compared_in_one_unit(unit, tmp_path):
    """Of Data Exchange, whose views and flat fields state units of their own; also tried: hours,
    nanoseconds, and currents in milliamperes.
    """
    path = exchange(tmp_path / "a.h5")
    plain = opened(path, find_bad_pixels=False).whole().views
    places = {
        "measurement/instrument/detector/exposure_time": (0.1 * UNITS[unit], unit),
        "process/acquisition/flat_fields/flat_exposure_time": (0.05, "s"),
    }
    with h5py.File(path, "a") as file:
        for name, (value, text) in places.items():
            file[name] = value
            file[name].attrs["units"] = text
    found = opened(path, exposure="exposure_time", find_bad_pixels=False).whole().views
    np.testing.assert_allclose(found, plain + np.log(2), atol=1e-5)


ATTENUATED = np.where(KEYS == 1, 0.5, 1.0)
SHARES = ("instrument/attenuator", "instrument/filter_2")


@pytest.mark.parametrize("where", SHARES)
def test_attenuators_of_nexus_are_applied_by_their_name(where, tmp_path):
    """A flat field behind an attenuator is warned of; a time without it is refused, with their
    product.
    """
    name = f"{where}/attenuator_transmission"
    path = monitored(tmp_path / "a.nxs", {name: ATTENUATED, "count_time": FLAT_OF})
    plain = opened(tomo(tmp_path / "b.nxs"), find_bad_pixels=False).whole().views.numpy()
    with pytest.warns(UserWarning, match=f"the flat field has the {name} 0.5, its views have 1"):
        opened(path, find_bad_pixels=False)
    with pytest.raises(Refused, match=rf"views.exposure=count_time\*{name} if light"):
        opened(path, exposure="count_time", find_bad_pixels=False)
    found = opened(path, exposure=f"count_time * {name}", find_bad_pixels=False).whole().views
    np.testing.assert_allclose(found.numpy(), plain + np.log(4), atol=1e-5)


def test_two_attenuators_multiply_the_light(tmp_path):
    one, two = (f"{where}/attenuator_transmission" for where in SHARES)
    path = monitored(tmp_path / "a.nxs", {one: ATTENUATED, two: np.where(KEYS == 1, 1.0, 0.2)})
    with pytest.raises(Refused, match=re.escape(f"views.exposure={one}*{two} if light")):
        opened(path, exposure=one, find_bad_pixels=False)
    plain = opened(tomo(tmp_path / "b.nxs"), find_bad_pixels=False).whole().views.numpy()
    found = opened(path, exposure=f"{two}*{one}", find_bad_pixels=False).whole().views
    np.testing.assert_allclose(found.numpy(), plain + np.log(0.4), atol=1e-5)


BEAMS = {
    "gain_setting": ("high", "low"),
    "threshold_energy": (6000.0, 9000.0),
    "flatfield_applied": (True, False),
    "countrate_correction_applied": (1, 0),
    "pixel_mask_applied": (np.bool_(True), np.bool_(False)),
    "instrument/beam/incident_energy": (25.0, 30.0),
    "instrument/source/voltage": (80.0, 120.0),
}


@pytest.mark.parametrize("name", BEAMS)
def test_other_settings_of_nexus_are_warned_of(name, tmp_path):
    """Of fields in another file, and of views among themselves."""
    own, other = BEAMS[name]
    place = (name if "/" in name else f"instrument/detector/{name}").replace("/", "__")
    views, same, flats = (
        tomo(tmp_path / f"{k}.nxs", **{place: value}) for k, value in enumerate((own, own, other))
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(views, flat=same, find_bad_pixels=False)
    with pytest.warns(UserWarning, match=f"2.nxs: the flat field has the {name} "):
        opened(views, flat=flats, find_bad_pixels=False)
    if not isinstance(own, str):
        several = np.where(np.arange(len(KEYS)) < 9, own, other)
        with pytest.warns(UserWarning, match=f"views have several values of {name}"):
            opened(tomo(tmp_path / "3.nxs", **{place: several}), find_bad_pixels=False)


ENERGIES = [
    *(("8 keV", "8 KeV", False), ("8 keV", "8.0 keV", False), ("8 keV", "8.004 keV", False)),
    *(("8 keV", "8.1 keV", True), ("8 keV", "8 MeV", True), ("8 meV", "8 MeV", True)),
    *(("high", "High", False), ("high", "low", True)),
]


@pytest.mark.parametrize(("own", "other", "warned"), ENERGIES)
def test_settings_in_other_words_are_the_same(own, other, warned, tmp_path):
    views, flats = (
        tomo(tmp_path / f"{k}.nxs", instrument__beam__incident_energy=text)
        for k, text in enumerate((own, other))
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(views, flat=flats, find_bad_pixels=False)
    found = ["has the instrument/beam/incident_energy" in str(one.message) for one in caught]
    assert found == [True] * warned


@pytest.mark.parametrize(("last", "warned"), [(8.001, False), (8.1, True)])
def test_energies_that_differ_by_less_than_a_thousandth_are_not_warned_of(last, warned, tmp_path):
    energies = np.linspace(8, last, len(KEYS))
    views = tomo(tmp_path / "a.nxs", instrument__beam__incident_energy=energies)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(views, find_bad_pixels=False)
    assert any("several values" in str(one.message) for one in caught) is warned


@pytest.mark.parametrize("kind", ["S4", h5py.string_dtype()])
def test_settings_of_nexus_as_a_text_of_each_frame_are_warned_of(kind, tmp_path):
    """They are not compared."""
    texts = np.array([b"high", b"low"] * len(KEYS))[: len(KEYS)].astype(kind)
    path = tomo(tmp_path / "a.nxs")
    with h5py.File(path, "a") as file:
        file.create_dataset("entry/instrument/detector/gain_setting", data=texts, dtype=kind)
    with pytest.warns(UserWarning, match="gain_setting: expected one .* it is not used"):
        opened(path, find_bad_pixels=False)


TEXTS = {
    "a number": ("0.1", 2),
    "in s": ("0.1 s", 2),
    "in ms": (b"100 ms", 2),
    "none": ("unknown", None),
    "several": (np.array([b"0.1", b"0.1"]), None),
    "two numbers": ([0.1, 0.2], None),
    "nothing": (h5py.Empty("f8"), None),
}


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("layout", ["Data Exchange", "NXtomo"])
def test_exposure_times_as_texts_do_not_refuse_a_file_that_does_not_need_them(
    layout, case, tmp_path
):
    """Of the views; a text that is a number is one. Needed, what is none is refused by name."""
    value, ratio = TEXTS[case]
    if layout == "NXtomo":
        path, name = monitored(tmp_path / "a.h5", {"count_time": value}), "count_time"
        flat = monitored(tmp_path / "b.h5", {"count_time": 0.05})
    else:
        path, name, flat = exchange(tmp_path / "a.h5"), "exposure_time", None
        with h5py.File(path, "a") as file:
            file[f"measurement/instrument/detector/{name}"] = value
            file["process/acquisition/flat_fields/flat_exposure_time"] = 0.05
    options = {"flat": flat, "find_bad_pixels": False}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plain = opened(path, **options).whole().views
    assert any("it is not used" in str(one.message) for one in caught) is (ratio is None)
    if ratio is None:
        with pytest.raises(FileNotFoundError, match=f"{name}.*each view states no exposure"):
            opened(path, exposure=name, **options)
    else:
        found = opened(path, exposure=name, **options).whole().views
        np.testing.assert_allclose(found, plain + np.log(ratio), atol=1e-5)


@pytest.mark.parametrize("unit", ["m", "frames", "1e-3 s", "mA"])
def test_times_of_unknown_units_are_warned_of_and_not_applied(unit, tmp_path):
    """They would be taken for seconds; also tried: currents in seconds."""
    path = monitored(tmp_path / "a.nxs", {"count_time": 0.1, "control/data": 300.0})
    with h5py.File(path, "a") as file:
        file["entry/instrument/detector/count_time"].attrs["units"] = unit
        file["entry/control/data"].attrs["units"] = unit  # of a monitor, any
    with pytest.warns(UserWarning, match=f"count_time: expected .* such as s or ms, got '{unit}'"):
        views = opened(path, exposure="control/data", find_bad_pixels=False)
    assert views.whole().views.isfinite().all()
    with pytest.warns(UserWarning, match="not used"):
        with pytest.raises(FileNotFoundError, match="by name, each view states control/data"):
            opened(path, exposure="count_time")


@pytest.mark.parametrize(
    ("key", "own", "other"),
    [
        ("ImagerPixelSpacing", [0.2, 0.2], [0.4, 0.4]),
        ("FieldOfViewOrigin", [0, 0], [4, 0]),
        ("DetectorBinning", [1, 1], [2, 2]),
    ],
)
@pytest.mark.parametrize("field", ["flat", "dark"])
def test_fields_of_other_pixels_of_the_detector_are_refused(field, key, own, other, tmp_path):
    """As views that differ are; fields that state the same, or nothing, are applied."""
    grey = np.full((4, 6), FLAT // 2, "u2")
    for k in range(2):
        dicom_image(tmp_path / f"view_{k}.dcm", grey, InstanceNumber=k, **{key: own})
    for name, value in (("flat", FLAT), ("dark", 10)):
        dicom_image(tmp_path / f"{name}.dcm", np.full((4, 6), value, "u2"), **{key: own})
    plain = opened(tmp_path).whole().views
    values = np.full((4, 6), {"flat": FLAT, "dark": 10}[field], "u2")
    dicom_image(tmp_path / f"{field}.dcm", values)
    assert opened(tmp_path).whole().views.equal(plain)
    dicom_image(tmp_path / f"{field}.dcm", values, **{key: other})
    with pytest.raises(Refused, match=f"expected a {field} field with the {key}"):
        opened(tmp_path)


@pytest.mark.parametrize("brighter", [1.1, 2.0, 257.0])
@pytest.mark.parametrize("kind", ["intensities", "integrals"])
def test_views_brighter_than_their_flat_field_are_named(brighter, kind, tmp_path):
    """Whatever the cause: a longer exposure that no file states, a flat field of 8 bits beside
    views of 16, another current. Line integrals of such views have no flat field to compare.
    """
    grey = np.full((4, 6, 8), 200.0 * brighter, np.float32)
    grey[:, :2, :2] /= 2 * brighter  # an object of a few pixels
    options = {"flat": 200.0, "dark": 0.0, "kind": "intensities"}
    if kind == "integrals":
        grey, options = -np.log(grey / 200), {"kind": "integrals"}
    np.save(tmp_path / "views.npy", grey)
    with pytest.warns(UserWarning, match=r"176 of 192 line integrals are below -0.05"):
        opened(tmp_path / "views.npy", find_bad_pixels=False, **options).whole()


def test_noise_around_air_is_not_brighter_than_the_flat_field(tmp_path):
    """100 photons: a third of the pixels of air are below -0.05."""
    grey = np.random.default_rng(0).poisson(100.0, (8, 16, 16)).astype(np.float32)
    assert 0.25 < (-np.log(grey / 100) < -0.05).mean() < 0.4
    np.save(tmp_path / "views.npy", grey)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(
            tmp_path / "views.npy", kind="intensities", flat=100.0, find_bad_pixels=False
        ).whole()
