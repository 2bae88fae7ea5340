"""A run's folder is its own: its settings do not change, and no other process writes to it."""

import json
import os
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace

import pytest
import yaml

import mvrecon.apps.eval
import mvrecon.apps.train
from mvrecon.apps.config import compose
from mvrecon.core.files.atomic import new_folder
from mvrecon.training import fit, run_folder
from mvrecon.training.settings import TrainSettings
from tests.training.lives import METHOD, OPTIONS
from tests.training.runs import NOON, call, contents, crowd


def test_settings_that_differ_are_named_and_nothing_is_written(run, capsys):
    """A training into the folder of a run with other settings is refused, and not a byte of the
    folder changes.
    """
    folder, options = run
    before = contents(folder)
    assert (
        call(mvrecon.apps.train, *options, "seed=9", "optimizer.lr=0.5", "+compare.sirt.name=sirt")
        == 1
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
    assert call(mvrecon.apps.train, *options) == 0
    assert f"{METHOD}: training has finished already" in capsys.readouterr().err
    again = json.loads((folder / "results.json").read_text())
    assert again["methods"][METHOD]["psnr"] == before["methods"][METHOD]["psnr"]


def test_a_run_tells_from_which_step_it_goes_on(tmp_path, monkeypatch, capsys):
    """A training that goes on says from which step; a new one does not."""
    settings, step = TrainSettings(**compose(*OPTIONS)), fit.ReconstructionModule.training_step

    def breaking(module, batch, batch_idx):
        if module.global_step == 7:
            raise RuntimeError("power cut")
        return step(module, batch, batch_idx)

    monkeypatch.setattr(fit.ReconstructionModule, "training_step", breaking)
    with pytest.raises(RuntimeError, match="power cut"):
        mvrecon.apps.train.train(settings, tmp_path)
    assert "resuming" not in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"got seed=9, expected 0"):
        mvrecon.apps.train.train(replace(settings, seed=9), tmp_path)
    monkeypatch.setattr(fit.ReconstructionModule, "training_step", step)
    mvrecon.apps.train.train(settings, tmp_path)
    assert f"{METHOD}: resuming at step 6" in capsys.readouterr().err


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
    assert call(mvrecon.apps.eval, f"checkpoint={folder}", f"hydra.run.dir={folder}") == 1
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
    assert call(mvrecon.apps.train, f"resume={folder}") == 0
    assert list(tmp_path.iterdir()) == [] and not list(folder.glob(".hydra"))


#: Is at work in a run folder until its input ends.
AT_WORK = """
import sys
from pathlib import Path
from mvrecon.core.files.atomic import claimed
with claimed(Path(sys.argv[1])):
    print("at work", flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(os.name != "posix", reason="folders are locked on POSIX systems alone")
def test_a_run_that_another_process_is_at_work_on_is_not_resumed(run, root, capsys):
    """It keeps its results."""
    folder, _ = run
    before = (folder / "results.json").read_bytes()
    command = [sys.executable, "-c", AT_WORK, str(folder)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, cwd=root, text=True, **pipes) as other:
        assert other.stdout.readline() == "at work\n"
        code = call(mvrecon.apps.train, f"resume={folder}")
        other.stdin.close()
    assert code == 1 and other.returncode == 0
    assert f"is in use by process {other.pid} on" in capsys.readouterr().err
    assert (folder / "results.json").read_bytes() == before


@pytest.mark.parametrize(
    ("file", "written"), [(run_folder.SETTINGS, True), ("evaluation.yaml", False)]
)
def test_a_rig_in_an_evaluations_folder_is_no_file_that_it_writes(file, written, tmp_path):
    settings = {"camera": {"path": str(tmp_path / "rig.json")}}
    with (
        pytest.raises(ValueError, match="camera.path") if written else nullcontext(),
        run_folder.run_lock(tmp_path, settings, file),
    ):
        pass
