"""A run on a file of patients records its training patients and refuses a modified file."""

import json

import numpy as np
import pytest

import mvrecon.apps.eval
import mvrecon.apps.train
from mvrecon.data import digests
from mvrecon.data.hdf5 import Stored, write_volumes
from mvrecon.training.evaluation import seen_in_training
from mvrecon.training.trained import Trained
from tests.training.lives import OPTIONS
from tests.training.runs import call


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
    assert call(mvrecon.apps.train, *options) == 0
    return place


def volume(name, rng):
    """A CT volume of noise in soft tissue."""
    return Stored(name, rng.integers(-50, 50, (8, 8, 8)).astype(np.int16), (16.0, 16.0, 16.0))


def test_no_scene_is_called_unseen_without_information_in_the_checkpoint(run):
    """Without training cases in the checkpoint, unseen scenes are unknown; SIRT has seen none."""
    folder, _ = run
    assert json.loads((folder / "results.json").read_text())["seen_in_training"] == []
    trained, sirt = Trained(None, 1.0, 14, ["p1", "p2"]), Trained(None, 0.0, 0)
    assert seen_in_training([trained, sirt], ["p2", "p3"]) == ["p2"]
    assert seen_in_training([sirt], ["p2"]) == []
    assert seen_in_training([sirt, Trained(None, 1.0, 14, None)], ["p2"]) is None


def test_training_patients_are_not_called_unseen(patients, tmp_path, capsys):
    """An evaluation names the patients whose volumes trained the model, and its table does not call
    them unseen.
    """
    sizes = [
        f"+data.sizes.{part}={size}" for part, size in {"train": 0, "val": 0, "test": 5}.items()
    ]
    assert (
        call(
            mvrecon.apps.eval,
            f"checkpoint={patients}/run",
            *sizes,
            f"hydra.run.dir={tmp_path}/eval",
        )
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


def test_training_patients_are_recognised_under_other_names(patients, tmp_path, capsys):
    """An evaluation reports training volumes under any path and name, and a detector that is not
    the run's.
    """
    rng = np.random.default_rng(0)
    write_volumes(tmp_path / "copies.h5", (volume(f"q{k}", rng) for k in range(7)))
    scene = ("scene@test_scene=hdf5", f"test_scene.path={tmp_path}/copies.h5")
    options = (*scene, "test_scene.crop=none", "+data.sizes.test=5", "acquisition=photons")
    assert (
        call(
            mvrecon.apps.eval,
            f"checkpoint={patients}/run",
            *options,
            f"hydra.run.dir={tmp_path}/eval",
        )
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
        (mvrecon.apps.eval, [f"checkpoint={patients}/run", f"hydra.run.dir={tmp_path}/eval"]),
        (mvrecon.apps.train, [f"resume={patients}/run"]),
    ):
        assert call(app, *options) == 1
        assert f"{path}: got sha256 {got[:16]}, expected {expected[:16]}" in capsys.readouterr().err
    path.write_bytes(whole)
    assert (
        call(mvrecon.apps.eval, f"checkpoint={patients}/run", f"hydra.run.dir={tmp_path}/again")
        == 0
    )
