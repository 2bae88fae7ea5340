"""What is typed on a command line is used, or named in an error before anything is written."""

import re
import sys
from importlib import import_module
from pathlib import Path

import pytest

from mvrecon.apps.config import compose
from mvrecon.apps.eval import evaluate
from mvrecon.apps.settings import EvalSettings

APPS = {
    "eval": "mvrecon.apps.eval",
    "train": "mvrecon.apps.train",
    "simulate": "mvrecon.apps.simulate",
    "reconstruct": "mvrecon.apps.reconstruct",
    "bench": "mvrecon_bench.bench",
    "stress": "mvrecon_bench.stress",
}
UNUSED = [
    ("eval", "+camra.n_views=12"),
    ("eval", "+gird.spacing=2.0"),
    ("eval", "+loss.volume=1"),
    ("eval", "+projector.name=drr"),
    ("eval", "+methods.name=sirt"),
    ("eval", "+seed=5"),
    ("eval", "+resume=x"),
    ("train", "+checkpoint=x"),
    ("train", "+cases=[0]"),
    ("train", "+save=true"),
    ("train", "+camra.n_views=12"),
    ("simulate", "+loss.volume=1"),
    ("reconstruct", "+methods.name=sirt"),
    ("reconstruct", "+loss.volume=1"),
    ("simulate", "+methods.name=sirt"),
    ("bench", "+device=cpu"),
    ("stress", "+bench.name=operators"),
]


@pytest.mark.parametrize(("app", "option"), UNUSED)
def test_a_setting_that_is_not_used_is_an_error(app, option, tmp_path, monkeypatch, capsys):
    """A setting that an app does not use is an error that names it, and nothing is written."""
    needed = ["checkpoint=x"] if app == "eval" else []
    monkeypatch.setattr(sys, "argv", [app, *needed, option, f"hydra.run.dir={tmp_path}/out"])
    with pytest.raises(SystemExit) as stopped:
        import_module(APPS[app]).main()
    assert stopped.value.code == 1
    key = option.lstrip("+").partition("=")[0].partition(".")[0]
    assert re.search(f"(has no option|Key) '{key}'", capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["seed=5", "method=sirt", "loss.volume=2.0", "projector=drr"])
def test_settings_fixed_by_a_run_cannot_be_set_in_its_evaluation(option: str):
    """The seed, the model, the loss and the projector of an evaluation are those of the run, and
    cannot be typed.
    """
    with pytest.raises(
        Exception, match=f"(chooses no|Could not override) '{option.partition('=')[0]}'"
    ):
        compose("checkpoint=x", option, config_name="eval")


def test_an_evaluation_cannot_redefine_a_trained_method(tmp_path: Path):
    """Settings of a method that the run has trained are refused by its evaluation: its checkpoint
    decides.
    """
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "config.yaml").touch()
    (tmp_path / "checkpoints" / "mine.ckpt").touch()
    settings = compose(f"checkpoint={tmp_path}", "+compare.mine={name: sirt}", config_name="eval")
    with pytest.raises(
        ValueError, match=r"compare describes \['mine'\], which the run has trained already"
    ):
        evaluate(EvalSettings(**settings), tmp_path / "out")
