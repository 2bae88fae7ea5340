"""A volume with NaN or infinity is an error of its method: counted, shown, and never the best."""

import json
import math

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.files.atomic import write_text
from mvrecon.core.parts import METRICS
from mvrecon.methods.classical.sirt import backprojection
from mvrecon.methods.method import Reconstruction, Solver
from mvrecon.report import result_table as report
from mvrecon.report.comparison import read
from mvrecon.training import evaluation, fit, run_folder
from mvrecon.training.settings import TrainSettings
from tests.training.test_evaluation import shown


@pytest.fixture
def settings():
    """Four test scenes, two methods that learn nothing."""
    return TrainSettings(
        **compose("experiment=smoke", "method=backprojection", "data.sizes.test=4")
    )


@pytest.fixture
def spoilt(monkeypatch):
    """Lets one voxel of backprojection fail in each second scene."""
    solve, scenes = Solver.forward, []

    def forward(method, views, A):
        out = solve(method, views, A)
        if method.solve is not backprojection:
            return out
        scene = views.sum().item()
        scenes.extend([scene] if scene not in scenes else [])
        volume = out.volume.clone()
        volume[..., 0, 0, 0] = [0.0, math.nan, 0.0, math.inf][scenes.index(scene)]
        return Reconstruction(volume, sigma=torch.ones_like(volume))

    monkeypatch.setattr(Solver, "forward", forward)


def test_a_failed_volume_is_counted_and_shown_but_never_averaged(settings, spoilt, tmp_path):
    found = evaluation.results(settings, tmp_path, fit.build_data(settings))
    first, second = found["methods"].values()
    assert first["failed"] == found["scenes"][1::2] and second["failed"] == []
    for name in METRICS.names():
        values = [math.isnan(value) for value in first[name]["values"]]
        assert values == [False, True, False, True] and math.isnan(first[name]["mean"])
        assert math.isfinite(second[name]["mean"])
    assert all(math.isnan(q["mean"]) for q in first["quality"].values() if "mean" in q)
    text = shown(found)
    assert text.count("2 of 4") == text.count("failed") == len(METRICS.names())
    (line,) = report.remarks(found)
    assert all(name in line for name in first["failed"])

    write_text(tmp_path / "config.yaml", "{}")
    run_folder.write_results(tmp_path, found)
    assert [row.failed for row in read([tmp_path])] == [2, 0]


def test_a_method_that_raises_on_a_later_scene_loses_no_result(settings, monkeypatch, tmp_path):
    """The others' figures and its own of other scenes are kept; on the first scene it raises."""
    solve, calls = Solver.forward, []

    def forward(method, views, A):
        if method.solve is backprojection:
            calls.append(views)
            if len(calls) in raising:  # three calls for the first scene
                raise RuntimeError("out of memory")
        return solve(method, views, A)

    monkeypatch.setattr(Solver, "forward", forward)
    raising = (5,)
    with pytest.warns(UserWarning, match="failed on .* RuntimeError: out of memory"):
        found = evaluation.results(settings, tmp_path, fit.build_data(settings))
    first, second = found["methods"].values()
    assert first["failed"] == found["scenes"][2:3] and second["failed"] == []
    assert [math.isnan(value) for value in first["psnr"]["values"]] == [False, False, True, False]
    assert math.isfinite(second["psnr"]["mean"]) and first["ms_per_volume"] > 0
    raising = range(100)
    with pytest.raises(RuntimeError, match="out of memory"):
        evaluation.results(settings, tmp_path, fit.build_data(settings))


def test_a_failed_validation_is_the_worst_of_a_sweep(settings, spoilt, tmp_path):
    score = evaluation.validation_psnr(settings, tmp_path, fit.build_data(settings))
    run_folder.write_results(tmp_path, {"validation_psnr": score})
    written = json.loads((tmp_path / "results.json").read_text())["validation_psnr"]
    assert float(written) == -math.inf


def test_a_scene_without_an_object_is_not_a_failure(settings, monkeypatch, tmp_path):
    data, empty = fit.build_data(settings), evaluation.metrics.case_metrics

    def without(volume, views, case, data_range):
        return empty(volume, views, {**case, "inside": case["inside"] & False}, data_range)

    monkeypatch.setattr(evaluation.metrics, "case_metrics", without)
    found = evaluation.results(settings, tmp_path, data)
    for row in found["methods"].values():
        assert row["failed"] == [] and math.isfinite(row["psnr"]["mean"])
        assert all(map(math.isnan, row["psnr_inside"]["values"]))


def test_a_plugins_metric_is_never_computed_for_a_failed_volume(
    settings, spoilt, monkeypatch, tmp_path
):
    def figure(volume, truth, inside, data_range):
        assert volume.isfinite().all()
        return 1.0

    monkeypatch.setattr(METRICS, "_parts", {**METRICS._parts, "mine": figure})
    first, _ = evaluation.results(settings, tmp_path, fit.build_data(settings))["methods"].values()
    assert first["mine"]["values"][::2] == [1.0, 1.0] and math.isnan(first["mine"]["mean"])


@pytest.mark.parametrize("name", ["q[/b]", "x [b] ü", "[red]", "[b]x[/b]"])
def test_names_with_brackets_are_printed_as_they_are(settings, name, tmp_path, capsys):
    """Of a run, a method and a folder; closing, opening and escaped tags of the terminal."""
    found = evaluation.results(settings, tmp_path, fit.build_data(settings))
    methods = {f"{name} {k}": row for k, row in enumerate(found["methods"].values())}
    report.show({**found, "name": name, "methods": methods}, tmp_path / name)
    printed = capsys.readouterr().out
    assert f"{name}: 4" in printed and f"{name} 0" in printed and f"/{name}\n" in printed
