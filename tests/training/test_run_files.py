"""The files of a run folder."""

import csv
import json
import math

import pytest
import torch
import yaml

from mvrecon.apps.config import absolute_paths
from mvrecon.apps.settings import ReconstructSettings, TrainSettings
from mvrecon.core.files.atomic import write_text
from mvrecon.training import run_folder
from mvrecon.training.callbacks import MetricsFile


def test_settings_round_trip_as_plain_values_in_order(tmp_path):
    settings = {
        "name": "a",
        "seed": 3,
        "grid": {"shape": [1, 2, 3], "spacing": 0.5},
        "resume": None,
    }
    run_folder.start(tmp_path / "run", settings)
    text = (tmp_path / "run" / "config.yaml").read_text()
    assert run_folder.read_settings(tmp_path / "run") == TrainSettings(**settings)
    assert list(yaml.safe_load(text)) == list(settings)
    assert "torch 2." in (tmp_path / "run" / "versions.txt").read_text()


def test_paths_mean_the_same_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {
        "scene": {"name": "hdf5", "path": "a.h5"},
        "test_scene": {"name": "mixture", "scenes": [{"name": "hdf5", "path": "/b.h5"}]},
        "name": "path",
    }
    measured = {
        "views": {"path": "scan", "dark": "dark.tif", "flat": 5e4},
        "grid": {"like": "ct.nii.gz"},
    }
    found = absolute_paths(given, TrainSettings)
    assert found["scene"] == {"name": "hdf5", "path": str(tmp_path / "a.h5")}
    assert found["test_scene"] == given["test_scene"]
    assert found["name"] == "path" and absolute_paths(found, TrainSettings) == found
    (tmp_path / "dark.tif").touch()  # what is no file may be a name in the scan's
    found = absolute_paths(measured, ReconstructSettings)
    assert found["views"]["dark"] == str(tmp_path / "dark.tif") and found["views"]["flat"] == 5e4
    assert found["grid"]["like"] == str(tmp_path / "ct.nii.gz")


def test_results_are_strict_json_with_versions(tmp_path):
    run_folder.write_results(
        tmp_path, {"psnr": math.inf, "values": [math.nan, 1.5], "deep": {"x": -math.inf}}
    )
    found = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
    assert found["values"] == [None, 1.5], "nan is missing"
    assert float(found["psnr"]) == math.inf == -float(found["deep"]["x"]), "infinity is not"
    assert found["versions"]["mvrecon"] and found["command"]


def test_the_version_of_torch_includes_its_build(monkeypatch):
    """A run's versions include the build of torch, which the metadata of an installed wheel
    omit.
    """
    monkeypatch.setattr(torch, "__version__", "2.13.0+cu130")
    monkeypatch.setattr(run_folder.metadata, "version", lambda name: "2.13.0")
    assert run_folder.versions()["torch"] == "2.13.0+cu130"


def test_versions_of_other_distributions_are_listed_after_those_of_mvrecon():
    own, found = run_folder.versions(), run_folder.versions(others=("pytest", "no-such-thing"))
    assert found == own | {"pytest": pytest.__version__, "no-such-thing": "not installed"}


def test_a_failed_write_keeps_the_old_file(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(tmp_path / "a.txt", "new \udcff")
    assert (tmp_path / "a.txt").read_text() == "old"


def test_a_folder_that_is_not_a_run_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config.yaml in it, got .*elsewhere"):
        run_folder.read_settings(tmp_path / "elsewhere")


def test_a_second_logger_adds_to_the_table(tmp_path):
    for step, figures in ((1, {"loss": 0.5}), (2, {"loss": 0.25, "psnr": 30.0})):
        logger = MetricsFile(str(tmp_path))
        logger.log_metrics(figures, step)
        logger.finalize("success")
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["step"], row["loss"], row["psnr"]) for row in rows] == [
        ("1", "0.5", ""),
        ("2", "0.25", "30.0"),
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]
