"""The apps warn of a rig that sees little of its grid, fit a detector to it, and choose a grid that
so many of the views see.
"""

import json
import re
import warnings

import pytest

import mvrecon.apps.reconstruct
import mvrecon.apps.simulate
import mvrecon.apps.train
from mvrecon.core.files.checks import yaml_of
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras import files
from mvrecon.geometry.cameras.coverage import coverage
from mvrecon.geometry.cameras.field import auto_grid, full_fan
from mvrecon.geometry.grid import Grid
from tests.training.runs import call

PATIENT = "grid={size: [16,16,16], spacing: 24.0}"
DISTANT = ("camera.sid=1000", "camera.sdd=1500")
FAN = (
    "scene=ellipsoids",
    "camera.n_views=24",
    "camera.arc_degrees=360",
    "camera.detector={pixels: [12, 24], pixel_mm: 16.0, offset_mm: [0.0, 130.0]}",
    "grid={size: [16,16,16], spacing: 16.0}",
)


@pytest.fixture(autouse=True)
def quick(monkeypatch, blank_pictures):
    monkeypatch.setattr("mvrecon.apps.sanity_checks.sanity_checks", lambda *_: [])


def test_one_number_is_a_cube_as_in_python(tmp_path):
    """For the commands that make views and that reconstruct them."""
    cube = ("grid.size=12", "grid.spacing=20")
    made, out = tmp_path / "made", tmp_path / "out.nii"
    rig = ("camera.n_views=2", "camera.sid=600", "camera.sdd=900")
    panel = "camera.detector={pixels: [8, 8], pixel_mm: 60.0}"
    options = ("scene=ellipsoids", *cube, *rig, panel)
    assert call(mvrecon.apps.simulate, *options, f"hydra.run.dir={made}") == 0
    truth = read_volume(next(made.glob("cases/*/truth.nii.gz")))[1]
    options = (f"scan={made}", *cube, "method=cgls", "method.iterations=1", f"out={out}")
    assert call(mvrecon.apps.reconstruct, *options, f"hydra.run.dir={tmp_path}/run") == 0
    for grid in (truth, read_volume(out)[1]):
        assert (grid.shape, grid.spacing) == ((12, 12, 12), (20.0, 20.0, 20.0))


@pytest.mark.pairwise(
    app=[mvrecon.apps.train, mvrecon.apps.simulate],
    fit=["detector", "detector.pixel_mm", "detector.pixels", None],
)
def test_a_small_detector_is_named_and_a_fitted_one_sees_the_grid(tmp_path, capsys, app, fit):
    """In training and simulation, with each spelling of fit; the folder's settings have numbers."""
    options = (PATIENT, *DISTANT, f"hydra.run.dir={tmp_path}")
    if app is mvrecon.apps.train:
        options += ("experiment=smoke", "trainer.max_steps=1", "camera.detector.pixel_mm=5.5")
    else:
        options += ("camera=circular_small", "camera.detector.pixel_mm=5.5")
    if fit == "detector.pixel_mm":
        options = tuple(o for o in options if "pixel_mm" not in o)
    if fit == "detector":
        options = tuple(o for o in options if "pixel_mm" not in o)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert call(app, *options, *([f"camera.{fit}=fit"] if fit else [])) == 0
    words = [str(w.message) for w in told if "sees little" in str(w.message)]
    assert len(words) == (fit is None)
    if fit is None:
        numbers = r"seen by all views.*by at least half.*% by none.*of the mass.*\d+ x \d+ pixels"
        assert re.search(numbers, words[0]) and "camera.detector.pixels=fit" in words[0]
        return
    detector = yaml_of(tmp_path / "config.yaml")["camera"]["detector"]
    assert "fit" not in str(detector)
    rig = files.from_file(tmp_path / "rig.json")
    assert coverage(rig, Grid.centred(16, spacing=24.0)).half > 0.99


@pytest.fixture(scope="module")
def fan(tmp_path_factory):
    """A scan with an offset detector all around: its options."""
    folder = tmp_path_factory.mktemp("fan")
    assert call(mvrecon.apps.simulate, *FAN, f"hydra.run.dir={folder}") == 0
    views = next(folder.glob("cases/*/views.h5"))
    return (f"views.path={views}", f"camera.path={folder}/rig.json", "method=fdk"), folder


@pytest.mark.parametrize(
    ("options", "field"), [((), full_fan), (("grid.seen_by=1.0",), lambda rig: rig)]
)
def test_the_grid_of_a_half_fan_is_what_its_views_measure_together(fan, tmp_path, options, field):
    """By itself, or by the share that is asked for; without a warning."""
    scan, folder = fan
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert call(mvrecon.apps.reconstruct, *scan, *options, f"hydra.run.dir={tmp_path}") == 0
    expected = auto_grid(field(files.from_file(folder / "rig.json")))
    table = json.loads((tmp_path / "results.json").read_text())
    assert tuple(table["grid"]["shape"]) == expected.shape
    assert not [w for w in told if re.search("sees little|not measured", str(w.message))]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("grid.seen_by=0.5", PATIENT), "alone"),
        (("grid.seen_by=1.5",), "a share of the views"),
        (("grid.seen_by=0",), "> 0"),
        (("grid.seen_by=half",), "half"),
        (("camera=circular", *DISTANT, "camera.arc_degrees=360", "camera.detector=fit"), "fit"),
    ],
)
def test_a_wrong_share_is_refused(fan, tmp_path, capsys, options, message):
    scan = fan[0] if "camera=circular" not in options else (fan[0][0], fan[0][2])
    assert call(mvrecon.apps.reconstruct, *scan, *options, f"hydra.run.dir={tmp_path}") == 1
    assert message in capsys.readouterr().err


def test_a_grid_that_the_scan_does_not_see_is_warned_of(fan, tmp_path):
    box = "grid={size: [16,16,16], spacing: 60.0}"
    with pytest.warns(UserWarning, match="sees little of the grid of 960 x 960 x 960.*seen_by"):
        run = (*fan[0], box, "method=sirt", "method.iterations=1", f"hydra.run.dir={tmp_path}")
        assert call(mvrecon.apps.reconstruct, *run) == 0
