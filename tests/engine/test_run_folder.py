"""A run's folder is its own: its settings, its rig and its data do not change, and no other process
writes to it.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import mvrecon.eval
import mvrecon.train
from mvrecon.cameras import files
from mvrecon.config import compose
from mvrecon.data import digests
from mvrecon.data.hdf5 import Stored, write_volumes
from mvrecon.engine import checkpoints, fit, run_folder
from mvrecon.engine.checkpoints import Trained
from mvrecon.engine.evaluation import seen_in_training
from mvrecon.files.atomic import new_folder
from mvrecon.files.checks import Refused
from mvrecon.parts import CAMERAS
from tests.engine.lives import METHOD, OPTIONS

pytestmark = pytest.mark.door
RIG = {
    "name": "circular",
    "n_views": 3,
    "sid": 400.0,
    "sdd": 800.0,
    "detector": {"pixels": [12, 12], "pixel_mm": 22.0},
}
NOON = "2026-01-01_12-00-00"


def contents(folder):
    """Every file of a folder, and its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def call(app, *options):
    """Run an app with a command line; its exit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [app.__name__, *options, "hydra/job_logging=none"])
        try:
            app.main()
        except SystemExit as stop:
            return stop.code
    return 0


def crowd(kind, folder):
    """What the processes of a crowd answered, and what they said."""
    command = [sys.executable, "-m", "tests.engine.crowd", kind, str(folder)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    root = Path(__file__).parents[2]
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


def rig_file(folder, shift=0.0):
    """A rig in a file, its sources shifted by some mm along x."""
    cameras = CAMERAS.from_config(RIG)
    shifted = replace(cameras, source=cameras.source + torch.tensor([shift, 0.0, 0.0]))
    files.save(shifted, folder / "rig.json")
    return folder / "rig.json"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run with a rig from a file, and its command line."""
    place = tmp_path_factory.mktemp("run")
    options = [option for option in OPTIONS if not option.startswith("camera")]
    options += [
        "camera=from_file",
        f"camera.path={rig_file(place)}",
        f"hydra.run.dir={place}/run",
        "seed=3",
    ]
    assert call(mvrecon.train, *options) == 0
    return place / "run", options


def test_settings_that_differ_are_named_and_nothing_is_written(run, capsys):
    """A training into the folder of a run with other settings is refused, and not a byte of the
    folder changes.
    """
    folder, options = run
    before = contents(folder)
    assert (
        call(mvrecon.train, *options, "seed=9", "optimizer.lr=0.5", "+compare.sirt.name=sirt") == 1
    )
    message = capsys.readouterr().err
    assert (
        "got seed=9, expected 3" in message
        and "got optimizer.lr=0.5, expected " in message
        and "compare.sirt" in message
    )
    assert "model" not in message.split("other settings:")[1].split("hydra.run.dir")[0]
    assert contents(folder) == before


def test_the_same_settings_go_on_and_tell_so(run, capsys):
    """A training into its own finished folder says that there is nothing left to train, and has the
    same figures.
    """
    folder, options = run
    before = json.loads((folder / "results.json").read_text())
    assert call(mvrecon.train, *options) == 0
    assert f"{METHOD}: its training has ended already" in capsys.readouterr().err
    again = json.loads((folder / "results.json").read_text())
    assert again["methods"][METHOD]["psnr"] == before["methods"][METHOD]["psnr"]


def test_a_run_tells_from_which_step_it_goes_on(tmp_path, monkeypatch, capsys):
    """A training that goes on says from which step; a new one does not."""
    settings, step = compose(*OPTIONS), fit.ReconstructionModule.training_step

    def breaking(module, batch, batch_idx):
        if module.global_step == 7:
            raise RuntimeError("power cut")
        return step(module, batch, batch_idx)

    monkeypatch.setattr(fit.ReconstructionModule, "training_step", breaking)
    with pytest.raises(RuntimeError, match="power cut"):
        mvrecon.train.train(settings, tmp_path)
    assert "going on" not in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"got seed=9, expected 0"):
        mvrecon.train.train({**settings, "seed": 9}, tmp_path)
    monkeypatch.setattr(fit.ReconstructionModule, "training_step", step)
    mvrecon.train.train(settings, tmp_path)
    assert f"{METHOD}: going on from step 6" in capsys.readouterr().err


def test_work_without_its_settings_is_nobody_s(tmp_path):
    """A folder with checkpoints or results whose settings are missing is refused."""
    for name in ("checkpoints", "results.json"):
        folder = tmp_path / f"run with {name}"
        (folder / name).mkdir(parents=True)
        with pytest.raises(
            FileExistsError, match=rf"holds {name} of another run without its config.yaml"
        ):
            run_folder.check(folder, {"seed": 0})
    run_folder.check(tmp_path, {"seed": 0})


def test_an_evaluation_does_not_write_into_a_run(run, capsys):
    """An evaluation into the folder of a run is refused, and the run's own table stays."""
    folder, _ = run
    before = (folder / "results.json").read_bytes()
    assert call(mvrecon.eval, f"checkpoint={folder}", f"hydra.run.dir={folder}") == 1
    assert "of another run without its eval.yaml" in capsys.readouterr().err
    assert (folder / "results.json").read_bytes() == before


def test_a_missing_setting_is_as_one_that_is_null():
    """Settings are compared by value: null is as missing, and the order does not matter."""
    assert run_folder.differences({"a": None, "b": {"c": 1, "d": 2}}, {"b": {"d": 2, "c": 1}}) == []
    assert run_folder.differences({"b": {"c": 1}}, {"b": {"c": 2}, "e": [1]}) == [
        "got b.c=1, expected 2",
        "got e=None, expected [1]",
    ]


def test_a_new_folder_is_never_one_that_is_there(tmp_path):
    """A new folder takes the next free number, beside files and folders alike."""
    (tmp_path / "a" / "b_2").mkdir(parents=True)
    (tmp_path / "a" / "b_3").touch()
    assert [new_folder(tmp_path / "a" / "b").name for _ in range(3)] == ["b", "b_4", "b_5"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
def test_apps_of_the_same_second_have_folders_of_their_own(tmp_path):
    """Two trainings, two evaluations and two simulations of the same second each keep their own
    results.
    """
    answers, message = crowd("apps", tmp_path)
    assert [code for code, _ in answers] == [0] * 6, message
    outputs, folders = tmp_path / "outputs", (NOON, f"{NOON}_2")
    for name in ("train", "eval", "simulate"):
        assert sorted(path.name for path in (outputs / name).iterdir()) == [*folders]
    for name in ("train", "simulate"):
        assert {
            yaml.safe_load((outputs / name / f / "config.yaml").read_text())["seed"]
            for f in folders
        } == {1, 2}
    tables = {
        name: [json.loads((outputs / name / f / "results.json").read_text()) for f in folders]
        for name in ("train", "eval")
    }
    assert {table["seed"] for table in tables["train"]} == {1, 2}
    assert {len(table["scenes"]) for table in tables["eval"]} == {1, 2}


def test_a_resumed_run_makes_no_other_folder(run, tmp_path, monkeypatch):
    """A resumed run leaves no folder but its own."""
    folder, _ = run
    monkeypatch.chdir(tmp_path)
    assert call(mvrecon.train, f"resume={folder}") == 0
    assert list(tmp_path.iterdir()) == [] and not list(folder.glob(".hydra"))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
def test_a_run_that_another_process_resumes_is_refused(run):
    """A run that another process is at work on cannot be resumed meanwhile, and keeps its
    results.
    """
    folder, _ = run
    before = (folder / "results.json").read_bytes()
    answers, message = crowd("resuming", folder)
    assert [code for code, _ in answers] == [0, 1]
    assert "is in use by process" in message and (folder / "results.json").read_bytes() == before


def test_a_run_keeps_its_rig_and_the_digests_of_rig_and_data(run):
    """The run folder keeps the rig, number for number, and the checkpoint has its digest and the
    training cases.
    """
    folder, options = run
    kept = files.from_file(folder / "rig.json")
    assert all(
        torch.equal(getattr(kept, v), getattr(CAMERAS.from_config(RIG), v)) for v in files.VECTORS
    )
    trained = checkpoints.load(checkpoints.finished(folder, METHOD))
    assert (
        trained.digests
        == json.loads((folder / "digests.json").read_text())
        == {"rig": digests.of_rig(kept)}
    )
    assert trained.cases == [f"ellipsoids-5-{k}" for k in range(10)]
    state = torch.load(checkpoints.finished(folder, METHOD))
    assert state["SceneData"]["cases"] == trained.cases


@pytest.mark.parametrize("kept", ["folder", "checkpoint"])
def test_a_rig_that_has_changed_is_refused(run, kept, tmp_path, capsys):
    """A rig file that has changed since is an error of evaluation and of resumption, by folder and
    by checkpoint.
    """
    folder, _ = run
    path = Path(run_folder.read_settings(folder)["camera"]["path"])
    expected, whole = digests.of_rig(files.from_file(path)), (folder / "digests.json").read_bytes()
    try:
        if kept == "checkpoint":
            (folder / "digests.json").unlink()
        rig_file(path.parent, shift=5.0)
        got = digests.of_rig(files.from_file(path))
        for app, options in (
            (mvrecon.eval, [f"checkpoint={folder}", f"hydra.run.dir={tmp_path}/eval"]),
            (mvrecon.train, [f"resume={folder}"]),
        ):
            assert call(app, *options) == 1
            assert (
                f"rig: got sha256 {got[:16]}, expected {expected[:16]}" in capsys.readouterr().err
            )
    finally:
        rig_file(path.parent)
        (folder / "digests.json").write_bytes(whole)
    assert call(mvrecon.eval, f"checkpoint={folder}", f"hydra.run.dir={tmp_path}/again") == 0


def test_a_digest_of_a_rig_tells_every_part_of_the_record():
    """Each part of a camera record changes its digest; a millionth of a micrometre, which a
    processor may, does not.
    """
    rig = CAMERAS.from_config(RIG)
    others = [replace(rig, **{name: getattr(rig, name) * (1 + 1e-6)}) for name in files.VECTORS]
    others += [
        replace(rig, shape=(12, 13)),
        replace(rig, extent="ahead"),
        replace(rig, parallel=True),
    ]
    assert len({digests.of_rig(one) for one in (rig, *others)}) == 8
    assert digests.of_rig(replace(rig, source=rig.source + 1e-13)) == digests.of_rig(rig)


def test_a_digest_of_a_file_is_told_by_its_contents(tmp_path):
    """A data file that changes at the same path is refused, and one that is only copied or touched
    is not.
    """
    path = tmp_path / "a.h5"
    path.write_bytes(b"first")
    scene = {
        "name": "mixture",
        "scenes": [{"name": "hdf5", "path": str(path)}, {"name": "ellipsoids"}],
    }
    assert list(digests.files_in(scene)) == [str(path)]
    before = {str(path): digests.of_file(path)}
    os.utime(path, (0, 0))
    digests.compare({str(path): digests.of_file(path)}, before, "run")
    path.write_bytes(b"other")
    with pytest.raises(
        Refused, match=r"as run tells: .*a\.h5: got sha256 [0-9a-f]{16}, expected [0-9a-f]{16}"
    ):
        digests.compare({str(path): digests.of_file(path)}, before, "run")


def test_no_scene_is_called_unseen_where_a_checkpoint_does_not_tell(run):
    """A checkpoint that does not tell its training cases leaves it open which scenes are unseen;
    SIRT has seen none.
    """
    folder, _ = run
    assert json.loads((folder / "results.json").read_text())["seen_in_training"] == []
    trained, sirt = Trained(None, 1.0, 14, ["p1", "p2"]), Trained(None, 0.0, 0)
    assert seen_in_training([trained, sirt], ["p2", "p3"]) == ["p2"]
    assert seen_in_training([sirt], ["p2"]) == []
    assert seen_in_training([sirt, Trained(None, 1.0, 14, None)], ["p2"]) is None


@pytest.fixture(scope="module")
def patients(tmp_path_factory):
    """A finished run on a file of seven volumes: p0 is its test case, p1, p2 and p3 those of its
    training.
    """
    place = tmp_path_factory.mktemp("patients")
    rng = np.random.default_rng(0)
    write_volumes(place / "ct.h5", (volume(f"p{k}", rng) for k in range(7)))
    options = [
        *OPTIONS,
        "scene=hdf5",
        f"scene.path={place}/ct.h5",
        "scene.crop=none",
        "data.batch_size=1",
    ]
    options += ["data.sizes={train: 3, val: 1, test: 1}", f"hydra.run.dir={place}/run"]
    assert call(mvrecon.train, *options) == 0
    return place


def volume(name, rng):
    """A CT volume of noise in soft tissue."""
    return Stored(name, rng.integers(-50, 50, (8, 8, 8)).astype(np.int16), (16.0, 16.0, 16.0))


def test_patients_of_the_training_are_not_called_unseen(patients, tmp_path, capsys):
    """An evaluation names the patients whose volumes trained the model, and its table does not call
    them unseen.
    """
    sizes = [
        f"+data.sizes.{part}={size}" for part, size in {"train": 0, "val": 0, "test": 5}.items()
    ]
    assert (
        call(mvrecon.eval, f"checkpoint={patients}/run", *sizes, f"hydra.run.dir={tmp_path}/eval")
        == 0
    )
    table = json.loads((tmp_path / "eval" / "results.json").read_text())
    assert table["scenes"] == [f"p{k}" for k in range(5)] and table["seen_in_training"] == [
        "p1",
        "p2",
        "p3",
    ]
    printed = capsys.readouterr().out
    assert "5 scenes, 3 of them seen in training" in printed and "unseen" not in printed


def test_patients_of_the_training_are_known_under_other_names(patients, tmp_path, capsys):
    """An evaluation names the volumes that trained the model wherever they come from and whatever
    they are called, and tells a detector that is not the run's.
    """
    rng = np.random.default_rng(0)
    write_volumes(tmp_path / "copies.h5", (volume(f"q{k}", rng) for k in range(7)))
    scene = ("scene@test_scene=hdf5", f"test_scene.path={tmp_path}/copies.h5")
    options = (*scene, "test_scene.crop=none", "+data.sizes.test=5", "acquisition=photons")
    assert (
        call(mvrecon.eval, f"checkpoint={patients}/run", *options, f"hydra.run.dir={tmp_path}/eval")
        == 0
    )
    table = json.loads((tmp_path / "eval" / "results.json").read_text())
    assert table["seen_in_training"] == ["q1", "q2", "q3"]
    assert table["acquisition"]["photons"] == 1e4
    assert table["acquisition_of_run"]["photons"] is None
    printed = capsys.readouterr().out
    assert "The views' detector: photons 10000" in printed
    assert "The run's detector was another: perfect" in printed


def test_data_that_have_changed_are_refused(patients, tmp_path, capsys):
    """A data file that has changed since the training is an error of evaluation and of
    resumption.
    """
    path = patients / "ct.h5"
    expected, whole = digests.of_file(path), path.read_bytes()
    rng = np.random.default_rng(1)
    write_volumes(path, (volume(f"p{k}", rng) for k in range(7)))
    got = digests.of_file(path)
    for app, options in (
        (mvrecon.eval, [f"checkpoint={patients}/run", f"hydra.run.dir={tmp_path}/eval"]),
        (mvrecon.train, [f"resume={patients}/run"]),
    ):
        assert call(app, *options) == 1
        assert f"{path}: got sha256 {got[:16]}, expected {expected[:16]}" in capsys.readouterr().err
    path.write_bytes(whole)
    assert call(mvrecon.eval, f"checkpoint={patients}/run", f"hydra.run.dir={tmp_path}/again") == 0
