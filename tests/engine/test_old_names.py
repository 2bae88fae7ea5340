"""Runs and checkpoints of earlier versions are read by the names of this one."""

from pathlib import Path

import pytest
from mvrecon.engine.old_names import RIGS, current

from mvrecon.cameras import rigs
from mvrecon.config import compose
from mvrecon.engine import run_folder
from mvrecon.engine.checkpoint_check import check_settings

OLD = {"seed": 3, "camera": {"name": "circular", "views": 8, "sid": 400.0}}
NEW = {"seed": 3, "camera": {"name": "circular", "n_views": 8, "sid": 400.0}}


def test_a_run_that_counts_its_views_by_the_old_name_is_read(tmp_path):
    run_folder.start(tmp_path, OLD)
    assert run_folder.read_settings(tmp_path) == NEW
    run_folder.check(tmp_path, NEW)
    with pytest.raises(ValueError, match="got camera.n_views=9, expected 8"):
        run_folder.check(tmp_path, {**NEW, "camera": {**NEW["camera"], "n_views": 9}})


def test_a_checkpoint_that_counts_its_views_by_the_old_name_is_read():
    method = {"geometry": OLD, "model": {}, "loss": {}, "optimizer": {}, "data_range": 1.0}
    assert check_settings(Path("a.ckpt"), method) == {**method, "geometry": NEW}


def test_the_model_of_one_pass_has_another_name_now(tmp_path):
    model, head = {"name": "cross_view", "rounds": []}, {"head": {"name": "density"}}
    then, now = {"name": "cross_view", **head}, {"name": "single_pass", **head}
    old = {"model": then, "compare": {"a": then, "b": model}}
    assert current(old) == {"model": now, "compare": {"a": now, "b": model}}
    method = {"geometry": {}, "model": then, "loss": {}, "optimizer": {}, "data_range": 1.0}
    assert check_settings(tmp_path / "a.ckpt", method)["model"] == now


@pytest.mark.parametrize(
    "settings",
    [NEW, {"camera": {"name": "helix", "views": 3}}, {"camera": None}, {"camera": "a"}, [], None],
)
def test_other_settings_stay_as_they_are(settings):
    assert current(settings) == settings


def test_every_rig_of_the_table_counts_its_views_now():
    assert all("n_views" in getattr(rigs, name).__annotations__ for name in RIGS)


def test_a_run_before_acquisitions_had_a_perfect_detector():
    """Settings without the key `acquisition` are those of today's default, which they are compared
    with; an evaluation's and a checkpoint's geometry stay as they are.
    """
    settings = compose("experiment=smoke", "loss.rounds=0", "loss.corrected_views=0")
    old = {key: value for key, value in settings.items() if key != "acquisition"}
    old["data"] = {key: value for key, value in settings["data"].items() if key != "overlap"}
    assert current(old) == settings == current(settings)
    late = {"acquisition": "disturbed", "loss": "corrected_views"}
    parts = {key: {k: v for k, v in settings[key].items() if k != new} for key, new in late.items()}
    assert current({**settings, **parts}) == settings
    geometry = {key: settings[key] for key in ("grid", "projector")}
    assert current(geometry) == geometry and current({"checkpoint": "x"}) == {"checkpoint": "x"}
