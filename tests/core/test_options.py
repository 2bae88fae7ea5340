"""Options are recognised by their types and by what mvrecon passes, never by their names."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import pytest

import mvrecon.apps.train
from mvrecon.apps.config import absolute_paths
from mvrecon.apps.settings import EvalSettings, ReconstructSettings, TrainSettings
from mvrecon.core.options import check, with_paths
from mvrecon.core.parts import METHODS, PROJECTORS, describe
from mvrecon.core.quantities import Pair
from mvrecon.methods.method import build_method
from tests.faults.plugins import plugin
from tests.training.lives import OPTIONS
from tests.training.runs import call

#: Options that are called as mvrecon's own paths and as arguments that it passes.
NAMES = (
    *("path", "dark", "flat", "like", "out", "checkpoint", "init_from", "lower", "upper"),
    *("task", "params", "projector", "grid", "cameras", "inputs", "outputs", "counts", "read"),
)
METHOD = f"""
from pathlib import Path
from typing import Literal

from mvrecon.methods.classical.sirt import sirt

def solved(operator, measured, {", ".join(f"{name}: str = 'sirt'" for name in NAMES)},
           file: str | Path | None = None, files: list[Path] = (),
           limits: Literal["auto"] | Path = "auto", shape: Path | tuple[float, float] = (1, 2)):
    '''SIRT.'''
    return sirt(operator, measured, iterations=2)

class Net:
    '''Two weights.'''
    def __init__(self, A: float = 1.0, views: int = 3, self_: str = "a"):
        pass
"""


@pytest.fixture
def installed(tmp_path):
    """An installed plugin's methods: a function with `NAMES`, and a class."""
    points = {"method.solved": "named_options:solved", "method.net": "named_options:Net"}
    with plugin(tmp_path / "site", points, {"named_options": METHOD}):
        yield tmp_path


def test_an_option_may_have_any_name(installed, monkeypatch):
    """`like=sirt` stays a word and `task` exists, for a function's options and for a class's that
    are called as the arguments passed to functions.
    """
    monkeypatch.chdir(installed)
    options = dict.fromkeys(NAMES, "auto")
    settings = {"method": {"name": "solved", **options}, "compare": {"b": {"name": "net"}}}
    check(settings, TrainSettings)
    assert absolute_paths(settings, TrainSettings) == settings
    assert list(describe("method", "solved").options)[: len(NAMES)] == list(NAMES)
    assert list(describe("method", "net").options) == ["A", "views", "self_"]
    build_method(settings["method"])
    for wrong in ({"operator": 1}, {"taks": "x"}):
        with pytest.raises(TypeError, match="has no option"):
            check({"method": {"name": "solved", **wrong}}, TrainSettings)


def test_a_path_is_an_option_of_that_type(installed, monkeypatch):
    """Alone, in a list, beside other types, of a method that is compared and of a part's part."""
    monkeypatch.chdir(installed)
    given = {"name": "solved", "file": "a.h5", "files": ["b", "/c"], "limits": "lim", "like": "a"}
    here = {**given, "file": f"{installed}/a.h5", "limits": f"{installed}/lim"}
    here["files"] = [f"{installed}/b", "/c"]
    for settings in (
        {"method": given},
        {"compare": {"x": given, "none": None}},
        {"method": {"name": "aligned", "method": given}},
        {"method": {"name": "cross_view", "start": given}},
        {"method": {"name": "uncertain", "method": {"name": "aligned", "method": given}}},
    ):
        expected = json.loads(json.dumps(settings).replace(json.dumps(given), json.dumps(here)))
        assert absolute_paths(settings, TrainSettings) == expected != settings
    words = {"name": "solved", "limits": "auto", "shape": [1, 2], "file": None}
    assert absolute_paths({"method": words}, TrainSettings) == {"method": words}


def test_a_run_with_such_a_plugin_keeps_its_words(installed):
    """The command line, `config.yaml` and the method itself have the same words."""
    options = [option for option in OPTIONS if not option.startswith("trainer.")]
    few = ("trainer.max_steps=1", "trainer.val_check_interval=1", "trainer.accelerator=cpu")
    words = "{name: solved, like: sirt, upper: auto, task: denoise, params: few, out: softplus}"
    folder = installed / "run"
    arguments = [*options, *few, f"+compare.mine={words}", f"hydra.run.dir={folder}"]
    assert call(mvrecon.apps.train, *arguments) == 0
    kept = mvrecon.apps.train.read_results(folder)
    assert "mine" in kept["methods"]
    text = (folder / "config.yaml").read_text()
    assert "like: sirt\n" in text and "out: softplus\n" in text and "params: few\n" in text
    assert json.dumps(kept) and "mine" not in METHODS.names()


@pytest.mark.parametrize(
    ("type", "value", "expected"),
    [
        (Path, "a", "/a"),
        (Path | None, "a", "/a"),
        (str, "a", "a"),
        (str | Path, "a", "/a"),
        (float | str | Path | None, 3.0, 3.0),
        (Literal["auto", "none"] | str | Path, "auto", "auto"),
        (Literal["auto", "none"] | str | Path, "a", "/a"),
        (Sequence[Path] | Path | None, ["a", "b"], ["/a", "/b"]),
        (Pair[Path], ["a", "b"], ["/a", "/b"]),
        (tuple[str, Path], ["a", "b"], ["a", "/b"]),
        (dict[str, Path], {"a": "b"}, {"a": "/b"}),
        (Any, "a", "a"),
        (Path, "${out}", "${out}"),
    ],
)
def test_paths_in_values_of_a_type(type, value, expected):
    assert with_paths(value, type, lambda path, _: f"/{path}") == expected


#: Every option that is a path, by app, with those of scenes in a list and of an attenuation map;
#: "x" is a path.
RUN = {
    "init_from": "x",
    "resume": None,
    "label": "a",
    "camera": {"name": "rtk_xml", "path": "x"},
    "scene": {
        "name": "mixture",
        "scenes": [{"name": "hdf5", "path": "x"}, {"name": "volumes", "path": "x"}],
    },
    "method": {"name": "trained", "checkpoint": "x", "method": "a"},
}
SCAN = {
    "out": "x",
    "grid": {"like": "x"},
    "views": {"path": "x", "dark": "x", "flat": 5.0, "pattern": "a"},
}
SPECT = {
    "projector": {"name": "spect", "mu": "x"},
    "scatter": {"name": "tew", "lower": "x", "upper": "x", "widths_kev": [1, 2, 3]},
}


@pytest.mark.parametrize(
    ("settings", "record"),
    [
        (RUN, TrainSettings),
        (SCAN, ReconstructSettings),
        (SPECT, ReconstructSettings),
        ({"checkpoint": "x"}, EvalSettings),
    ],
)
def test_the_paths_of_mvrecons_own_parts_and_settings(settings, record):
    if settings is SPECT and "spect" not in PROJECTORS.names():
        pytest.skip("the plugin mvrecon-spect is not installed")
    changed = with_paths(settings, record, lambda path, _: f"{path}!")
    assert changed == json.loads(json.dumps(settings).replace('"x"', '"x!"'))
    for word in ("case", "measured"):
        kept = {"projector": {"name": "spect", "mu": word}}
        assert with_paths(kept, record, lambda path, _: "X") == kept


def test_weights_are_named_or_are_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for place, record in {"init_from": TrainSettings, "checkpoint": EvalSettings}.items():
        assert Path(absolute_paths({place: "any_rig"}, record)[place]).is_file()
        assert absolute_paths({place: "mine"}, record)[place] == str(tmp_path / "mine")
    made = {"method": {"name": "trained", "checkpoint": "any_rig"}}
    made = absolute_paths(made, TrainSettings)
    assert Path(made["method"]["checkpoint"]).is_file()
