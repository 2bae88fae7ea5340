"""Options are recognised by their types and by what mvrecon passes, never by their names."""

import json
from pathlib import Path

import pytest
from mvrecon.core.signatures import change_paths, check_parts, describe

import mvrecon.apps.train
from mvrecon.core.parts import METHODS
from mvrecon.core.quantities import with_paths
from mvrecon.methods.method import build_method
from mvrecon.training.run_folder import absolute_paths
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
    check_parts(settings)
    assert absolute_paths(settings) == settings
    assert list(describe("method", "solved").options)[: len(NAMES)] == list(NAMES)
    assert list(describe("method", "net").options) == ["A", "views", "self_"]
    build_method(settings["method"])
    for wrong in ({"operator": 1}, {"taks": "x"}):
        with pytest.raises(TypeError, match="has no option"):
            check_parts({"method": {"name": "solved", **wrong}})


def test_a_path_is_an_option_of_that_type(installed, monkeypatch):
    """Alone, in a list, beside other types, of a method that is compared and of a part's part."""
    monkeypatch.chdir(installed)
    given = {"name": "solved", "file": "a.h5", "files": ["b", "/c"], "limits": "lim", "like": "a"}
    here = {**given, "file": f"{installed}/a.h5", "limits": f"{installed}/lim"}
    here["files"] = [f"{installed}/b", "/c"]
    for place in ("method", "start"):
        assert absolute_paths({place: given}) == {place: here}
    assert absolute_paths({"compare": {"x": given}})["compare"]["x"] == here
    assert absolute_paths({"method": {"name": "aligned", "method": given}})["method"] == {
        "name": "aligned",
        "method": here,
    }
    words = {"name": "solved", "limits": "auto", "shape": [1, 2], "file": None}
    assert absolute_paths({"method": words}) == {"method": words}


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
        ("Path", "a", "/a"),
        ("pathlib.Path | None", "a", "/a"),
        ("str", "a", "a"),
        ("str | Path", "a", "/a"),
        ("float | str | Path | None", 3.0, 3.0),
        ("Literal['auto', 'none'] | str | Path", "auto", "auto"),
        ("Literal['auto', 'none'] | str | Path", "a", "/a"),
        ("Sequence[Path] | Path | None", ["a", "b"], ["/a", "/b"]),
        ("tuple[str, Path]", ["a", "b"], ["a", "/b"]),
        ("dict[str, Path]", {"a": "b"}, {"a": "/b"}),
        ("Anything", "a", "a"),
        ("", "a", "a"),
    ],
)
def test_paths_in_values_of_a_type(type, value, expected):
    assert with_paths(value, type, lambda path, _: f"/{path}") == expected


def test_the_paths_of_mvrecons_own_parts_and_settings():
    """Every option that is a path, with those of scenes in a list and of an attenuation map."""
    settings = {
        "out": "a",
        "init_from": "a",
        "checkpoint": "a",
        "resume": None,
        "label": "a",
        "grid": {"like": "a"},
        "views": {"path": "a", "dark": "a", "flat": 5.0, "pattern": "a"},
        "camera": {"name": "rtk_xml", "path": "a"},
        "scene": {
            "name": "mixture",
            "scenes": [{"name": "hdf5", "path": "a"}, {"name": "volumes", "path": "a"}],
        },
        "projector": {"name": "spect", "mu": "a"},
        "scatter": {"name": "tew", "lower": "a", "upper": "a", "widths_kev": [1, 2, 3]},
        "method": {"name": "trained", "checkpoint": "a", "method": "a"},
    }
    changed = change_paths(settings, lambda path, _: "X")
    found = sorted(place for place, value in _leaves(changed) if value == "X")
    spect = "spect" in mvrecon.core.parts.PROJECTORS.names()
    of_spect = ["projector.mu", "scatter.lower", "scatter.upper"] if spect else []
    assert found == sorted(
        [
            *("out", "init_from", "checkpoint", "grid.like", "views.path", "views.dark"),
            *("camera.path", "scene.scenes.0.path", "scene.scenes.1.path", "method.checkpoint"),
            *of_spect,
        ]
    )
    scans = change_paths({"projector": {"name": "spect", "mu": "x/*/mu.nii.gz"}}, _star)
    assert not spect or scans["projector"]["mu"] == "x/a/mu.nii.gz"
    for word in ("case", "measured"):
        kept = {"projector": {"name": "spect", "mu": word}}
        assert change_paths(kept, lambda path, _: "X") == kept


def _star(path, _):
    return path.replace("*", "a")


def _leaves(value, place=""):
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            yield from _leaves(item, f"{place}.{key}".lstrip("."))
    else:
        yield place, value


def test_weights_are_named_or_are_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for place in ("init_from", "checkpoint"):
        assert Path(absolute_paths({place: "any_rig"})[place]).is_file()
        assert absolute_paths({place: "mine"})[place] == str(tmp_path / "mine")
    made = absolute_paths({"method": {"name": "trained", "checkpoint": "any_rig"}})
    assert Path(made["method"]["checkpoint"]).is_file()
