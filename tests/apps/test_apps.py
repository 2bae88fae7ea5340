"""The two apps as a user calls them, on the smoke experiment: seconds, every layer once."""

import csv
import json
import sys

import pytest
import torch
import yaml

import mvrecon.apps.eval
import mvrecon.apps.train
from mvrecon.core.files.runs import folder_of_run
from mvrecon.training import run_folder

FIGURES = ("psnr", "ssim", "nrmse", "psnr_inside", "ssim_inside", "nrmse_inside", "view_nrmse")


def call(app, folder, *options):
    """Run an app's entry point with a command line; its folder and what it wrote."""
    patch = pytest.MonkeyPatch()
    patch.setattr(
        sys, "argv", [app.__name__, *options, f"hydra.run.dir={folder}", "hydra/job_logging=none"]
    )
    try:
        app.main()
    finally:
        patch.undo()
    return json.loads((folder / "results.json").read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "smoke"
    return folder, call(
        mvrecon.apps.train,
        folder,
        "experiment=smoke",
        "seed=3",
        "logger=default",
        "callbacks=default",
        "callbacks.board.cases=1",
        "grid={size: [12, 12, 8], spacing: 10.0}",
    )


def test_a_run_folder_holds_what_it_should(run):
    folder, _ = run
    names = {p.name for p in folder.iterdir()}
    assert {
        "config.yaml",
        "versions.txt",
        "metrics.csv",
        "results.json",
        "checkpoints",
        "review",
    } <= names
    boards = {path.parent.relative_to(folder).as_posix() for path in folder.rglob("events.*")}
    # SIRT, which is not trained, has its figures in the tables alone
    assert boards == {"cross_view_small", "cross_view_small/test"} and not list(
        folder.rglob("hparams.yaml")
    )
    settings = yaml.safe_load((folder / "config.yaml").read_text())
    assert settings["name"] == "smoke" and settings["seed"] == 3 and "hydra" not in settings
    pictures = {
        scene.name: {p.name for p in scene.iterdir()} for scene in (folder / "review").iterdir()
    }
    assert pictures.pop("test") == {"ellipsoids-0-0.png", "ellipsoids-0-1.png"}
    wanted = {"planes.png", "mip.png", "views.png", "per_view.png", "weights.png"}
    assert pictures and all(wanted <= names for names in pictures.values())


def test_the_log_contains_losses_metrics_and_times(run):
    folder, _ = run
    with open(folder / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    names = {name for row in rows for name, value in row.items() if value}
    wanted = {"loss/total", "loss/volume", "val/psnr", "val/ssim", "val/nrmse", "val/view_nrmse"}
    assert wanted | {"time/step_ms", "time/volumes_per_s", "time/seconds", "time/peak_mb"} <= names


def test_the_board_contains_pictures_text_and_hyper_parameters(run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    board = EventAccumulator(str(run[0] / "cross_view_small")).Reload()
    test = EventAccumulator(
        str(run[0] / "cross_view_small/test"), {"images": 0, "tensors": 0}
    ).Reload()
    tags, results = board.Tags(), test.Tags()
    kinds = [tag.split("/")[0] for tag in tags["images"]]
    assert sorted(kinds) == ["mip", "per_view", "planes", "views", "weights"]
    assert [tag.split("/")[0] for tag in results["images"]] == ["slices"] * 2
    slices = test.Images(results["images"][0])
    assert [image.step for image in slices] == list(range(9))
    # a card opens at its last step, where the uppermost slice would be an empty one
    assert slices[-1].encoded_image_string == slices[4].encoded_image_string
    curves = {"loss/total", "figures/psnr", "optimizer/lr-AdamW", "time/step_ms"}
    assert curves <= set(tags["scalars"]) and "epoch" not in tags["scalars"]
    assert min(tags["scalars"]).startswith("figures/")
    costs = {f"test_costs/{name}" for name in ("ms", "peak_mb", "train_seconds")}
    assert set(results["scalars"]) - costs == {"test/psnr", "test/ssim", "test/view_nrmse"}
    assert "text/run/text_summary" in tags["tensors"] and "rig_FACE" in tags["tensors"]
    text = test.Tensors("text/overrides/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "seed=3" in text and "experiment=smoke" in text
    table = test.Tensors("text/results/text_summary")[0].tensor_proto.string_val[0].decode()
    assert table.startswith("| method | PSNR dB |") and "\n| sirt |" in table
    assert "hp_metric" not in tags["scalars"]
    data = test.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    session = HParamsPluginData.FromString(data).session_start_info.hparams
    keys = ("run", "label", "method.name", "scene.name")
    assert {key: session[key].string_value for key in keys} == {
        "run": "smoke",
        "label": "cross_view_small",
        "method.name": "cross_view",
        "scene.name": "ellipsoids",
    }


def test_results_contain_every_metric_with_units_seed_and_versions(run):
    _, found = run
    assert found["seed"] == 3 and found["versions"]["torch"] == torch.__version__
    assert (
        len(found["scenes"]) == 3
        and found["units"]["psnr"] == "dB"
        and found["units"]["ms_per_volume"] == "ms"
    )
    assert list(found["methods"]) == ["cross_view_small", "sirt"]
    for row in found["methods"].values():
        for figure in FIGURES:
            assert len(row[figure]["values"]) == 3
            assert row[figure]["mean"] == pytest.approx(sum(row[figure]["values"]) / 3)
        assert row["ms_per_volume"] > 0
    assert (
        found["methods"]["cross_view_small"]["train_steps"] == 3
        and found["methods"]["cross_view_small"]["parameters"] > 0
    )
    assert (
        found["methods"]["sirt"]["train_steps"] == 0 and found["methods"]["sirt"]["parameters"] == 0
    )


@pytest.mark.parametrize("part", ["", "checkpoints/cross_view_small.ckpt"])
def test_eval_reproduces_the_table(run, part, tmp_path, capsys):
    folder, first = run
    assert folder_of_run(folder / "checkpoints") == folder_of_run(folder / part) == folder.resolve()
    again = call(mvrecon.apps.eval, tmp_path / "eval", f"checkpoint={folder / part}")
    assert again["scenes"] == first["scenes"]
    assert again["scene"] == first["scene"] and first["scene"]["name"] == "ellipsoids"
    for method, row in first["methods"].items():
        for figure in FIGURES:
            # cuDNN may choose other algorithms in another process
            rel = 1e-6 if torch.cuda.is_available() else 0
            assert again["methods"][method][figure]["values"] == pytest.approx(
                row[figure]["values"], rel=rel, abs=1e-6
            )
        assert again["methods"][method]["train_seconds"] == row["train_seconds"]
    printed = capsys.readouterr().out
    assert (
        "cross_view_small" in printed
        and f"{first['methods']['sirt']['psnr']['mean']:.2f}" in printed
    )


def test_eval_on_another_scene_saves_its_cases(run, tmp_path):
    options = ("scene@test_scene=shepp_logan", "+data.sizes.test=1", "save=true")
    found = call(mvrecon.apps.eval, tmp_path / "eval", f"checkpoint={run[0]}", *options)
    assert len(found["scenes"]) == 1 and found["scenes"] != run[1]["scenes"][:1]
    assert found["scene"]["name"] == "shepp_logan"
    case = next((tmp_path / "eval" / "cases").iterdir())
    assert {"views.png", "planes.png", "truth.nii.gz", "cross_view_small.nii.gz"} <= {
        p.name for p in case.iterdir()
    }


def test_resume_continues_in_the_same_folder(run, tmp_path):
    folder, first = run
    found, where = mvrecon.apps.train.resumed(str(folder), []), folder
    assert found == (run_folder.read_settings(folder), where)
    again = mvrecon.apps.train.train(*found)
    assert again["methods"]["cross_view_small"]["psnr"]["values"] == pytest.approx(
        first["methods"]["cross_view_small"]["psnr"]["values"], abs=1e-6
    )
    with pytest.raises(ValueError, match="for more steps; got trainer.max_steps=9"):
        mvrecon.apps.train.resumed(str(folder), ["trainer.max_steps=9"])


@pytest.mark.parametrize(
    ("app", "options", "message"),
    [
        (mvrecon.apps.eval, ["checkpoint=nowhere.ckpt"], "No checkpoint or run folder is at"),
        (mvrecon.apps.train, ["experiment=smoke", "optimizer.lr=1e30"], "is not finite at step"),
        (
            mvrecon.apps.train,
            ["experiment=smoke", "method.name=cros_view"],
            "did you mean 'cross_view'",
        ),
        (
            mvrecon.apps.train,
            ["experiment=smoke", "test_scene=ellipsoids"],
            "by scene@test_scene=ellipsoids",
        ),
        (
            mvrecon.apps.train,
            ["experiment=smoke", "data.sizes.test=0"],
            "data.sizes.test of at least 1",
        ),
        (
            mvrecon.apps.train,
            ["experiment=smoke", "resume=nowhere"],
            "for more steps; got experiment=smoke",
        ),
        (mvrecon.apps.train, ["resume=nowhere"], "No checkpoint or run folder is at"),
    ],
)
def test_errors_are_reported_and_the_exit_status_is_not_zero(
    app, options, message, tmp_path, capsys
):
    with pytest.raises(SystemExit) as stopped:
        call(app, tmp_path, *options)
    assert stopped.value.code != 0
    assert message in capsys.readouterr().err
