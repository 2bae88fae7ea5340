"""Any value of any setting of any app is valid, or is answered by one line that names the setting.

Settings are composed, checked and built, and nothing is computed: every entry of every app's own
settings, with null, an empty text, empty and filled lists and mappings, and a number.
"""

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from mvrecon.apps.config import launch, to_plain
from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.core.signatures import check_arguments
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.geometry.cameras.coverage import fitted
from mvrecon.geometry.grid import Grid
from mvrecon.training import fit
from mvrecon.training.module import methods

VALUES = ("null", "''", "[]", "{}", "[1,2]", "{a: 1}", "3")
#: Words of an answer that says which values a setting has.
WORDS = ("expected ", "Expected ", "Known: ", "must be", "needs ", "no value here yet", "is no ")


def build(settings: dict[str, Any], folder: Path) -> None:
    """Grid, rig, scene and detector of a simulation."""
    Grid.centred(**settings["grid"])
    CAMERAS.from_config(fitted(settings["camera"], settings["grid"]))
    SCENES.from_config(settings["scene"])
    Acquisition.of(settings["acquisition"])
    if settings["projector"]:
        PROJECTORS.check(settings["projector"])


def build_events(settings: dict[str, Any], folder: Path) -> None:
    """Those of a data set of events, and its size."""
    from mvrecon_spect.events.making import EventSettings

    build(settings, folder)
    check_arguments("events.", "mvrecon_spect.events.making:EventSettings", settings["events"])
    EventSettings.of(settings["events"])


def build_training(settings: dict[str, Any], folder: Path) -> None:
    """All parts of a training."""
    settings = {**settings, "camera": fitted(settings["camera"], settings["grid"])}
    data = fit.build_data(settings)
    for method in methods(settings).values():
        module = fit.build_module(settings, method, data.data_range)
        if fit.trainable(module):
            module.build_optimizer()


def nothing(settings: dict[str, Any], folder: Path) -> None:
    """The parts of an evaluation are its run's, and those of a scan need its files."""


def entries(settings: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """The names of all settings, at any depth."""
    for key, value in settings.items():
        if key != "hydra":
            yield f"{path}{key}"
            if isinstance(value, Mapping):
                yield from entries(value, f"{path}{key}.")


@pytest.mark.parametrize(
    ("app", "given", "make"),
    [
        ("train", ("experiment=smoke", "method=cross_view_small"), build_training),
        ("eval", ("checkpoint=x",), nothing),
        ("simulate", (), build),
        ("reconstruct", ("views.path=x", "camera.path=x"), nothing),
        ("events", ("camera=circular_small", "projector=drr"), build_events),
    ],
)
def test_any_value_is_valid_or_answered_by_a_line_that_names_the_setting(
    app, given, make, monkeypatch, tmp_path, capsys
):
    if app == "events":
        pytest.importorskip("mvrecon_spect")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    composed: list[Any] = []

    def keep(config: DictConfig) -> None:
        composed.append(OmegaConf.to_container(config, resolve=False))

    def task(config: DictConfig) -> None:
        make(to_plain(config), tmp_path / "run")

    def answer(task, *overrides: str) -> str:
        monkeypatch.setattr(sys, "argv", [app, *given, *overrides, "hydra.run.dir=."])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mvrecon.apps.config.guard.configure_log", lambda *_: None)
            try:
                launch(task, app)
            except SystemExit:
                return capsys.readouterr().err or "nothing"
            except Exception as error:
                return f"{type(error).__name__}: {error}\ntraceback"
        return ""

    assert not answer(keep)
    wrong = []
    for key in entries(composed[0]):
        for value in VALUES:
            text = answer(task, f"{key}={value}")
            said = [line for line in text.splitlines() if "Warning: " not in line]
            names = len(said) == 1 and key.rpartition(".")[2] in said[0]
            if text and not (names and any(word in said[0] for word in WORDS)):
                wrong.append(f"{key}={value}: {text}")
    assert not wrong, "\n".join(wrong)
