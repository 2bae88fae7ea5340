"""Any value of any setting of any app is valid, or is answered by one line that names the setting.

Settings are composed, checked and built, and nothing is computed: every entry of every app's own
settings, with null, an empty text, empty and filled lists and mappings, and a number.
"""

import sys
from collections.abc import Iterator, Mapping
from copy import deepcopy
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig

from mvrecon.apps.config import compose, launch, to_plain
from mvrecon.apps.config.errors import PROGRAM_FAULTS, USER_ERRORS, sentence
from mvrecon.apps.settings import RECORDS, TrainSettings
from mvrecon.core.options import check
from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.core.registry import from_options
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.geometry.cameras.coverage import fitted
from mvrecon.geometry.grid import Grid
from mvrecon.training import fit

VALUES: tuple[Any, ...] = (None, "", [], {}, [1, 2], {"a": 1}, 3)
#: Sections whose further checks are those of Lightning and torch.
NOT_BUILT = ("trainer", "callbacks", "logger", "optimizer")
#: Words of an answer that says which values a setting has.
WORDS = ("expected ", "Expected ", "Known: ", "must be", "needs ", "must ", "has no ", "got ")


def build(settings: dict[str, Any], folder: Path) -> None:
    """Grid, rig, scene and detector of a simulation."""
    Grid.centred(**settings["grid"])
    CAMERAS.from_config(fitted(settings["camera"], settings["grid"]))
    SCENES.from_config(settings["scene"])
    Acquisition.of(settings.get("acquisition"))
    if settings.get("projector"):
        PROJECTORS.check(settings["projector"])


def build_events(settings: dict[str, Any], folder: Path) -> None:
    """Those of a data set of events, and its size."""
    from mvrecon_spect.events.making import EventSettings

    build(settings, folder)
    from_options(EventSettings, "events", settings["events"])


def build_training(settings: dict[str, Any], folder: Path) -> None:
    """All parts of a training."""
    settings = {**settings, "camera": fitted(settings["camera"], settings["grid"])}
    run = TrainSettings(**settings)
    data = fit.build_data(run)
    for method in run.methods().values():
        module = fit.build_module(run, method, data.data_range)
        if fit.trainable(module):
            module.build_optimizer()


def nothing(settings: dict[str, Any], folder: Path) -> None:
    """The parts of an evaluation are its run's, those of a scan need its files, and a benchmark
    runs.
    """


def entries(settings: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """The names of all settings, at any depth."""
    for key, value in settings.items():
        if key != "hydra":
            yield f"{path}{key}"
            if isinstance(value, Mapping):
                yield from entries(value, f"{path}{key}.")


APPS = {
    "train": (("experiment=smoke", "method=cross_view_small"), build_training),
    "eval": (("checkpoint=x",), nothing),
    "simulate": ((), build),
    "reconstruct": (("views.path=x", "camera.path=x"), nothing),
    "events": (("camera=circular_small", "projector=drr"), build_events),
    "bench": ((), nothing),
    "stress": ((), nothing),
}
#: Plugins that bring apps.
OF_PLUGINS = {"events": "mvrecon_spect", "bench": "mvrecon_bench", "stress": "mvrecon_bench"}


def record_of(app: str) -> type:
    """The record of an app's settings."""
    if app == "events":
        from mvrecon_spect.events.app import EventsSettings as record
    elif app == "bench":
        from mvrecon_bench.bench import BenchSettings as record
    elif app == "stress":
        from mvrecon_bench.stress import StressSettings as record
    else:
        record = RECORDS[app]
    return record


@pytest.fixture
def answer(monkeypatch, tmp_path, capsys):
    """What an app writes to the error stream for a command line, "" for a valid one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr("mvrecon.apps.config.guard.configure_log", lambda *_: None)

    def run(app: str, make, *overrides: str) -> str:
        def task(config: DictConfig) -> None:
            make(to_plain(config), tmp_path)

        monkeypatch.setattr(sys, "argv", [app, *overrides, "hydra.run.dir=."])
        try:
            launch(task, app, record_of(app))
        except SystemExit:
            return capsys.readouterr().err or "nothing"
        except Exception as error:
            return f"{type(error).__name__}: {error}\ntraceback"
        return ""

    return run


def test_a_detector_is_a_mapping_or_fits_the_grid():
    settings = compose("camera.detector=fit")
    check(settings, TrainSettings)
    settings["camera"]["detector"] = "fitted"
    with pytest.raises(TypeError, match=r"^camera.detector: expected a mapping or fit, got"):
        check(settings, TrainSettings)


def unclear(key: str, value: Any, text: str) -> list[str]:
    """The answer to a setting, if it is neither "" nor one line with the name and what is valid."""
    lines = [line for line in text.splitlines() if "Warning: " not in line]
    clear = (
        len(lines) == 1 and key in lines[0].casefold() and any(word in lines[0] for word in WORDS)
    )
    return [] if clear or not text else [f"{key}={value}: {text}"]


@pytest.mark.parametrize("turn", [0, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "app", [pytest.param(a, marks=[pytest.mark.slow] * (a == "train")) for a in APPS]
)
def test_null_and_a_list_are_valid_or_answered_by_a_line_that_names_the_setting(app, turn, answer):
    """Every top-level setting of an app on its command line, with either in turn, built where it is
    valid.
    """
    if app in OF_PLUGINS:
        pytest.importorskip(OF_PLUGINS[app])
    given, make = APPS[app]
    composed: list[dict[str, Any]] = []
    assert not answer(app, lambda settings, _: composed.append(settings), *given)
    wrong, values = [], ("null", "[1,2]")
    for n, key in enumerate(composed[0]):
        value = values[(n + turn) % 2]
        wrong += unclear(key, value, answer(app, make, *given, f"{key}={value}"))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("turn", [0, *(pytest.param(k, marks=pytest.mark.long) for k in (1, 2))])
@pytest.mark.parametrize(
    "app", [pytest.param(a, marks=[pytest.mark.slow] * (a == "train")) for a in APPS]
)
def test_every_entry_of_another_type_is_answered_by_a_line_that_names_it(app, turn):
    """Null, an empty text, empty and filled lists and mappings, a number, every third of them in
    turn: whatever passes the checks is built.
    """
    if app in OF_PLUGINS:
        pytest.importorskip(OF_PLUGINS[app])
    given, make = APPS[app]
    settings, wrong = compose(*given, config_name=app), []
    for n, path in enumerate(entries(settings)):
        for value in VALUES[(n + turn) % 3 :: 3]:
            changed = deepcopy(settings)
            *parents, key = path.split(".")
            reduce(getitem, parents, changed)[key] = value
            text = ""
            try:
                check(changed, record_of(app))
                if parents and parents[0] not in NOT_BUILT:
                    make(changed, Path())
            except USER_ERRORS as error:
                text = sentence(error)
                if isinstance(error, PROGRAM_FAULTS):
                    text += "\ntraceback"
            if parents:
                wrong += unclear(key, value, text)
    assert not wrong, "\n".join(wrong)
