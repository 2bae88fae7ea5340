"""`mvrecon-simulate` as called by a user: files contain the scene's measurements."""

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
import torch
import yaml
from PIL import Image as Pillow

import mvrecon.apps.simulate
from mvrecon.apps.config import compose
from mvrecon.apps.reconstruct import read_scan
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.data.projections import writing
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.volume_files import read_volume, save_volume
from mvrecon.geometry.cameras.camera import VECTORS
from mvrecon.geometry.cameras.files import save
from mvrecon.geometry.grid import Grid

GRID = ("grid.size=[16,16,16]", "grid.spacing=8")
PARALLEL = (
    "camera=parallel",
    "camera.n_views=3",
    "camera.detector.pixels=[40,44]",
    "camera.detector.pixel_mm=3.2",
)


def call(folder, *options):
    """Run the app with a command line; the settings that it wrote down."""
    patch = pytest.MonkeyPatch()
    patch.setattr(
        sys,
        "argv",
        ["mvrecon-simulate", *options, f"hydra.run.dir={folder}", "hydra/job_logging=none"],
    )
    try:
        mvrecon.apps.simulate.main()
    finally:
        patch.undo()
    return yaml.safe_load((folder / "config.yaml").read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "simulate"
    return folder, call(folder, *GRID, *PARALLEL, "seed=7", "cases=[4,1]")


def views(folder):
    """By case: the views, their attributes, and their images."""
    found = {}
    for case in sorted((folder / "cases").iterdir()):
        with h5py.File(case / "views.h5") as file:
            numbers, attributes, name = (
                file["views"][:],
                dict(file["views"].attrs),
                file.attrs["name"],
            )
        found[name] = (
            numbers,
            attributes,
            [np.asarray(Pillow.open(p)) for p in sorted(case.glob("*.png"))],
        )
    return found


def test_the_folder_contains_cases_rig_settings_and_versions(run):
    folder, settings = run
    assert {"cases", "config.yaml", "rig.json", "versions.txt"} <= {
        p.name for p in folder.iterdir()
    }
    measured = {"grid", "scene", "camera", "projector", "acquisition"}
    assert set(settings) == {"name", "seed", "cases", "rtk", "picture", "plugins"} | measured
    for case in (folder / "cases").iterdir():
        assert sorted(p.name for p in case.iterdir()) == [
            "scan.yaml",
            "truth.nii.gz",
            *(f"view_00{m}.png" for m in range(3)),
            "views.h5",
        ]


def test_a_mosaic_shows_all_views_at_once(tmp_path, capsys):
    call(tmp_path / "a", *GRID, *PARALLEL, "picture=mosaic")
    (case,) = (tmp_path / "a" / "cases").iterdir()
    picture = np.asarray(Pillow.open(case / "mosaic.png"))
    assert picture.shape[1] > 3 * 300 and picture.max() == 255
    assert [p.name for p in case.glob("*.png")] == ["mosaic.png"]
    with pytest.raises(SystemExit):
        call(tmp_path / "b", *GRID, *PARALLEL, "picture=collage")
    assert "picture: expected mosaic or null, got 'collage'" in capsys.readouterr().err


def test_the_files_of_the_first_cases_are_printed(tmp_path, capsys):
    call(tmp_path, *GRID, *PARALLEL, "cases=[0,1,2,3,4]")
    first, *cases, last = capsys.readouterr().out.splitlines()[-5:]
    assert first == f"5 case(s) and rig.json written to {tmp_path}" and last == "and 2 more"
    for line in cases:
        where, _, files = line.partition(": ")
        names = files.replace("3 pictures view_*.png", "view_000.png, view_001.png, view_002.png")
        assert names.startswith("views.h5, scan.yaml, truth.nii.gz")
        assert set(names.split(", ")) == {p.name for p in Path(where).iterdir()}


def test_the_numbers_are_the_scene_s_own_with_their_unit(run):
    folder, settings = run
    grid, cameras = Grid.centred(**settings["grid"]), CAMERAS.from_config(settings["camera"])
    scene = SCENES.from_config(settings["scene"])
    found = views(folder)
    for index in (4, 1):
        sample = scene.sample(index, 7, grid, cameras)
        numbers, attributes, _ = found.pop(sample.name)
        assert numbers.dtype == np.float32 and np.array_equal(numbers, sample.views[0].numpy())
        assert attributes == {"axes": "camera, v, u", "unit": "1/mm * mm"}
    assert not found


def test_counts_of_line_integrals_are_stored_as_counts_with_dose_and_duration(tmp_path):
    """Read as line integrals of the scene's unit, whose means pixels join."""
    options = ("acquisition=counts", "acquisition.counts=2e5", "acquisition.duration_s=40")
    cone = ("camera=circular", "camera.n_views=4", "camera.detector.pixels=24")
    cone += ("camera.detector.pixel_mm=12", "projector=drr", "picture=mosaic")
    settings = call(tmp_path, *GRID, *cone, *options)
    grid, cameras = Grid.centred(**settings["grid"]), CAMERAS.from_config(settings["camera"])
    scene, seed = SCENES.from_config(settings["scene"]), settings["seed"]
    ideal = scene.sample(0, seed, grid, cameras).views[0].double()
    ((numbers, attributes, _),) = views(tmp_path).values()
    assert np.array_equal(numbers, numbers.round())
    assert numbers.sum() == pytest.approx(2e5, abs=5 * 2e5**0.5)
    dose = 2e5 / ideal.sum().item()
    assert attributes.pop("dose") == pytest.approx(dose)
    assert attributes == {
        "axes": "camera, v, u",
        "unit": "counts",
        "unit_per_dose": "1/mm * mm",
        "duration": 40.0,
    }
    (path,) = tmp_path.glob("cases/*/views.h5")
    options = (f"views.path={path}", "camera=from_file", f"camera.path={tmp_path}/rig.json")
    for binning in (1, 2):
        more = (f"views.binning={binning}", "grid.size=[16,16,16]", "grid.spacing=8")
        config = compose(*options, *more, config_name="reconstruct")
        scan = read_scan(ReconstructSettings(**config))
        found = scan.measured.whole().views.double()
        assert scan.unit == "1/mm" and not scan.counts
        assert found.mean().item() == pytest.approx(ideal.mean().item(), rel=0.02)


def test_every_parallel_view_contains_the_whole_mass(run):
    for numbers, _, _ in views(run[0]).values():
        mass = numbers.sum(axis=(1, 2)) * 3.2**2
        assert mass == pytest.approx(np.full(3, mass.mean()), rel=0.02) and mass.mean() > 1e3


def test_images_are_bright_for_large_integrals(run):
    for numbers, _, images in views(run[0]).values():
        assert all(image.dtype == np.uint8 and image.shape == (40, 44, 3) for image in images)
        levels = np.stack(images)[..., 0]
        assert np.abs(levels - 255 * numbers / numbers.max()).max() <= 0.5 + 1e-3
        assert levels.max() == 255 and (levels[numbers == 0] == 0).all() and (numbers == 0).any()


def test_the_rig_round_trips_and_measures_the_same(run, tmp_path):
    folder, settings = run
    rig, again = folder / "rig.json", tmp_path / "again"
    cameras, read = (
        CAMERAS.from_config(settings["camera"]),
        CAMERAS.build("from_file", path=str(rig)),
    )
    assert all(torch.equal(getattr(cameras, name), getattr(read, name)) for name in VECTORS)
    call(again, *GRID, "camera=from_file", f"camera.path={rig}", "seed=7", "cases=[1]")
    (name,) = views(again)
    assert np.array_equal(views(again)[name][0], views(folder)[name][0])


def test_the_saved_truth_can_be_trained_on_in_its_position(tmp_path):
    """A patient off the centre of its file, cropped to the middle of the rig: `truth.nii.gz` is the
    same object at the same place, and `placement.json` leads back to the file.
    """
    source = Grid.centred((16, 16, 16), 8.0, (40.0, -24.0, 8.0))
    hu = torch.full(source.shape, -1000.0)
    hu[4:12, 4:12, 4:10] = 40.0
    hu[6:9, 5:7, 4:8] = 700.0
    save_volume(tmp_path / "patient.nii.gz", hu, source)
    options = ("scene=volumes", f"scene.path={tmp_path}/patient.nii.gz")
    call(tmp_path / "first", *GRID, *options)
    (case,) = (tmp_path / "first" / "cases").iterdir()
    again = ("scene=volumes", f"scene.path={case}/truth.nii.gz", "scene.crop=none")
    call(tmp_path / "second", *GRID, *again)
    (one,), (other,) = (views(tmp_path / run).values() for run in ("first", "second"))
    assert np.linalg.norm(one[0] - other[0]) < 0.02 * np.linalg.norm(one[0])
    (case_again,) = (tmp_path / "second" / "cases").iterdir()
    truths = [read_volume(c / "truth.nii.gz")[0] for c in (case, case_again)]
    assert (truths[0] - truths[1]).abs().max() < 1e-2
    placement = json.loads((case / "placement.json").read_text())
    # the middle of the patient's box (x 4..10, y and z 4..12 voxels), which comes to the origin
    assert placement["shift_mm"] == pytest.approx([-40.0 + 8.0, 24.0, -8.0])


def test_projector_and_detector_generate_the_views_and_are_recorded(tmp_path):
    options = ("camera.n_views=2", "projector=drr", "acquisition=photons", "scene.value=0.02")
    settings = call(tmp_path, *GRID, *options)
    assert settings["acquisition"]["photons"] == 1e4 and settings["projector"]["name"] == "drr"
    ((numbers, attributes, _),) = views(tmp_path).values()
    counts = 1e4 * np.exp(-numbers.astype(float))
    assert np.abs(counts - counts.round()).max() < 0.01 and attributes["unit"] == "1/mm * mm"


def test_the_rig_for_rtk_turns_about_the_axis_that_rtk_s_fdk_takes_its_angles_about(tmp_path):
    """A circle about z: RTK's gantry goes round in equal steps, its detector is not tilted."""
    call(
        tmp_path,
        *GRID,
        "camera.n_views=6",
        "camera.arc_degrees=360",
        "scene.value=0.02",
        "rtk=true",
    )
    views = ElementTree.parse(tmp_path / "geometry.xml").getroot().findall("Projection")
    gantry = torch.tensor([float(view.findtext("GantryAngle")) for view in views])
    assert torch.allclose(gantry.diff() % 360, torch.tensor(60.0), atol=1e-4)
    for tilt in ("OutOfPlaneAngle", "InPlaneAngle"):
        assert all(abs(float(view.findtext(tilt))) < 1e-9 for view in views)


def contents(folder):
    """The bytes of every file of a run's cases by their names."""
    cases = folder / "cases"
    return {f.relative_to(cases): f.read_bytes() for f in cases.rglob("*") if f.is_file()}


@pytest.mark.parametrize("written", [3, 9])
def test_an_interrupted_run_with_grey_values_continues(written, tmp_path, monkeypatch):
    """In the first case and in the second: whole cases stay whole, and no folder has a part of its
    images; what a killed process leaves is removed, other files stay.
    """
    options = (*GRID, "camera.n_views=3", "scene.value=0.02", "rtk=true", "cases=[0,1]")
    call(tmp_path / "whole", *options)
    left, write = [written], writing._write

    def interrupted(path, grey):
        left[0] -= 1
        if left[0] < 0:
            path.write_bytes(b"half")
            raise KeyboardInterrupt
        write(path, grey)

    monkeypatch.setattr(writing, "_write", interrupted)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        call(tmp_path / "run", *options)
    monkeypatch.undo()
    folders = [*(tmp_path / "run").rglob("projections")]
    assert len(folders) == written // 5 and all(len([*f.iterdir()]) == 5 for f in folders)
    case = next((tmp_path / "run" / "cases").iterdir())
    (case / ".projections.99.part").mkdir()
    (case / ".projections.99.part" / "view_00000.tif").write_bytes(b"half")
    mine = {case / "note.txt", *(folder / "view_00000.txt" for folder in folders)}
    for path in mine:
        path.write_text("mine")
    call(tmp_path / "run", *options)
    assert all(path.read_text() == "mine" for path in mine)
    for path in mine:
        path.unlink()
    found, expected = (contents(tmp_path / name) for name in ("run", "whole"))
    images = {name for name in expected if name.suffix == ".tif"}
    assert found.keys() == expected.keys() and len(images) == 10
    assert all(found[name] == expected[name] for name in images)


def test_fewer_views_than_an_earlier_run_had_leave_none_of_these(tmp_path):
    """Of a rig in a file that has changed since."""
    rig = {
        "name": "circular",
        "sid": 400.0,
        "sdd": 800.0,
        "detector": {"pixels": 24, "pixel_mm": 12},
    }
    save(CAMERAS.from_config({**rig, "n_views": 4}), tmp_path / "rig.json")
    options = (*GRID, "camera=from_file", f"camera.path={tmp_path}/rig.json", "scene.value=0.02")
    call(tmp_path / "run", *options, "rtk=true")
    save(CAMERAS.from_config({**rig, "n_views": 3}), tmp_path / "rig.json")
    call(tmp_path / "run", *options, "rtk=true")
    (folder,) = (tmp_path / "run").rglob("projections")
    assert len([*folder.glob("view_*.tif")]) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["scene=volumes", "scene.path=nowhere.nii"], "nowhere.nii: no such file"),
        (["cases=[-1]"], "cases: expected [int >= 0, ...], got [-1]"),
        (["cases=3"], "cases"),
        (["method=sirt"], "method"),
        (["scene.unti=1"], "unti"),
    ],
)
def test_errors_are_reported_and_the_exit_status_is_not_zero(options, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        call(tmp_path, *GRID, *PARALLEL, *options)
    assert stopped.value.code != 0
    assert message in capsys.readouterr().err


def test_the_pictures_of_a_case_are_not_read_as_its_views(run):
    case = next((run[0] / "cases").iterdir())
    with pytest.raises(Refused, match="expected .*views.h5, whose values the pictures"):
        open_projections(case)


def test_a_corrected_command_may_use_the_folder_of_one_that_failed(tmp_path, capsys):
    with pytest.raises(SystemExit):
        call(tmp_path, *GRID, *PARALLEL, "cases=[-1]")
    call(tmp_path, *GRID, *PARALLEL, "cases=[1]")
    assert len(views(tmp_path)) == 1
    with pytest.raises(SystemExit):  # but not that of one that has results
        call(tmp_path, *GRID, *PARALLEL, "cases=[2]")
    assert "choose another folder" in capsys.readouterr().err


def test_the_app_works_in_unusual_paths(root, tmp_path):
    """mvrecon-simulate works in the locale C, in folders with spaces and foreign letters, without a
    home.
    """
    here, out, home = tmp_path / "où ça", tmp_path / "ausgabe für 目录", tmp_path / "home"
    here.mkdir()
    home.touch()
    options = ("grid.size=[4,4,4]", "camera.n_views=1", "camera.detector.pixels=[4,4]", "cases=[0]")
    place = {
        "PYTHONPATH": str(root),
        "HOME": str(home),
        "LC_ALL": "C",
        "LANG": "C",
        "PYTHONIOENCODING": "ascii",
    }
    command = [sys.executable, "-m", "mvrecon.apps.simulate", *options, f"hydra.run.dir='{out}'"]
    done = subprocess.run(
        command,
        cwd=here,
        env={**os.environ, **place},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert len(list(out.rglob("views.h5"))) == 1 and not list(here.iterdir())


def test_cases_whose_folders_would_be_one_keep_their_files(tmp_path):
    """Patients named "a b", "a_b" and "a(b": each has its own views and truth."""
    grid = Grid.centred(16, spacing=8.0)
    for hu, name in enumerate(("a b", "a_b", "a(b")):
        volume = torch.full(grid.shape, -1000.0)
        volume[4:12, 4:12, 4:12] = 100.0 * hu
        save_volume(tmp_path / "in" / f"{name}.nii.gz", volume, grid)
    given = "scene=volumes", f"scene.path={tmp_path / 'in'}", "cases=[0,1,2]", *GRID, *PARALLEL
    call(tmp_path / "run", *given)
    cases = sorted((tmp_path / "run" / "cases").iterdir())
    assert [case.name for case in cases] == ["a_b", "a_b_2", "a_b_3"]
    tops = [read_volume(case / "truth.nii.gz")[0].max().item() for case in cases]
    assert sorted(tops) == pytest.approx([0.0, 100.0, 200.0], abs=1.0)
