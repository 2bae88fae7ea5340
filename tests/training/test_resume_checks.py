"""A training resumes with the settings that it began with, from a checkpoint that holds all."""

import importlib
import shutil
import sys
import warnings

import pytest
import yaml

import mvrecon.apps.train
from mvrecon.training import checkpoints, resume, run_folder
from tests.training.lives import METHOD
from tests.training.runs import call, contents


@pytest.fixture
def stopped(run, tmp_path):
    """A run folder whose training has stopped, and the path of its last checkpoint."""
    folder = tmp_path / "run"
    shutil.copytree(run[0], folder)
    done, last = checkpoints.finished(folder, METHOD), checkpoints.unfinished(folder, METHOD)
    checkpoints.write(last, checkpoints.read(done))
    done.unlink()
    (folder / "results.json").unlink()
    return folder, last


def edit(folder, place, value):
    """Set one setting in a run's config.yaml."""
    settings = yaml.safe_load((folder / "config.yaml").read_text())
    *outer, key = place.split(".")
    inside = settings
    for name in outer:
        inside = inside[name]
    inside[key] = value
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("data.batch_size", 5),
        ("data.sizes.train", 8),
        ("seed", 4),
        ("scene.value", 0.03),
        ("acquisition.photons", 100.0),
        ("grid.spacing", 15.0),
        ("optimizer.lr", 0.1),
        ("loss.volume", 7.0),
        ("trainer.precision", "64-true"),
        ("trainer.accumulate_grad_batches", 2),
        ("method.widths", [4, 6]),
        ("callbacks.ema", None),
    ],
)
def test_settings_that_were_edited_in_a_stopped_run_are_refused(place, value, stopped, capsys):
    """The training would go on with both: the batches of one size and the position of another,
    the learning rate of the checkpoint, or a second scene. Nothing is written.
    """
    folder, last = stopped
    edit(folder, place, value)
    before = contents(folder)
    assert call(mvrecon.apps.train, f"resume={folder}") == 1
    said = capsys.readouterr().err
    assert f"{last} is of a training with other settings: got {place}" in said
    assert contents(folder) == before


def test_settings_of_the_machine_may_change_in_a_stopped_run(stopped):
    """And where the data are, whose digests are compared."""
    folder, last = stopped
    for place, value in (
        ("scene.path", "/elsewhere/train.h5"),
        ("data.workers", 2),
        ("data.cache", "/cases"),
        ("trainer.accelerator", "gpu"),
        ("trainer.max_steps", 99),
        ("logger", None),
        ("name", "other"),
    ):
        edit(folder, place, value)
    settings = resume.kept(run_folder.read_settings(folder), METHOD)
    resume.check_resumable(last, checkpoints.read(last), settings)


@pytest.mark.parametrize("key", sorted(resume.NEEDED))
def test_a_checkpoint_that_lacks_what_a_training_resumes_from_is_refused(key, stopped, capsys):
    """One line names what is missing; without it a training would end with a traceback, or begin
    again with trained weights.
    """
    folder, last = stopped
    state = checkpoints.read(last)
    del state[key]
    checkpoints.write(last, state)
    checkpoints.previous(last).unlink()
    before = contents(folder)
    assert call(mvrecon.apps.train, f"resume={folder}") == 1
    said = capsys.readouterr().err
    assert f"{last}: expected a training to resume, got one without ['{key}']" in said
    assert contents(folder) == before


def test_a_run_that_is_continued_with_other_versions_or_code_says_so(tmp_path, monkeypatch):
    """Of mvrecon and torch, of an installed plugin, and of an edited module of `plugins`; not with
    the same ones, on another platform, or of what an earlier version did not note.
    """
    folder, settings = tmp_path / "run", {"plugins": ["edited_of_a_run"]}
    monkeypatch.syspath_prepend(str(tmp_path))
    code = tmp_path / "edited_of_a_run.py"
    code.write_text("import mvrecon\n")
    importlib.import_module("edited_of_a_run")

    def said():
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            with run_folder.run_lock(folder, settings):
                pass
        return " ".join(str(one.message) for one in given)

    assert said() == said() == ""
    path = folder / "versions.txt"
    noted = dict(line.split(" ", 1) for line in path.read_text().splitlines())
    assert noted["edited_of_a_run"].startswith("sha256:")
    for name in ("mvrecon", "torch", "mvrecon-spect", "platform", "numpy"):
        noted[name] = "0.1"
    del noted["numpy"]
    path.write_text("".join(f"{name} {version}\n" for name, version in noted.items()))
    now = run_folder.versions()
    text = said()
    for name in ("mvrecon", "torch", *({"mvrecon-spect"} & set(now))):
        assert f"{name} 0.1 became {now[name]}" in text
    assert "platform" not in text and "numpy" not in text and said() == ""
    code.write_text("import mvrecon  # edited\n")
    assert f"edited_of_a_run {noted['edited_of_a_run']} became sha256:" in said()
    monkeypatch.delitem(sys.modules, "edited_of_a_run")
