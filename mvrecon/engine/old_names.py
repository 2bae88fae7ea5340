"""Settings of earlier versions: options that have a new name now, and what was not an option."""

from dataclasses import asdict
from typing import Any

from mvrecon.acquisition.settings import Acquisition

#: Rigs whose number of views was the option `views` up to version 0.1.0.
RIGS = ("arc", "circular", "dome", "parallel")

#: Terms of the loss that version 0.1.0 did not have.
NEW_TERMS = {"rounds": 0.0, "corrected_views": 0.0, "opinions_gain": 0.0, "uncertainty": 1e-3}


def current_model(model: Any) -> Any:
    """The options of a model by the names of this version: up to 0.1.0 `cross_view` was the model
    of one pass, which has a head of its own.
    """
    if isinstance(model, dict) and model.get("name") == "cross_view" and "head" in model:
        return {**model, "name": "single_pass"}
    return model


def current(settings: Any) -> Any:
    """The settings of a run, or the geometry of a checkpoint, with the option names of this
    version; other values are returned unchanged.

    Runs up to version 0.1.0 had a perfect detector, no case in two sets, and their main method went
    by its class's name.
    """
    if not isinstance(settings, dict):
        return settings
    camera, data = settings.get("camera"), settings.get("data")
    if isinstance(camera, dict) and camera.get("name") in RIGS:
        renamed = {"n_views" if key == "views" else key: value for key, value in camera.items()}
        settings = {**settings, "camera": renamed}
    if "scene" in settings:
        acquisition = {**asdict(Acquisition()), **(settings.get("acquisition") or {})}
        settings = {**settings, "acquisition": acquisition}
    if "scene" in settings and isinstance(settings.get("loss"), dict):
        settings = {**settings, "loss": {**NEW_TERMS, **settings["loss"]}}
    if "scene" in settings and isinstance(model := settings.get("model"), dict):
        settings = {**settings, "label": settings.get("label") or model.get("name")}
    if "model" in settings:
        settings = {**settings, "model": current_model(settings["model"])}
    if isinstance(settings.get("compare"), dict):
        others = {name: current_model(model) for name, model in settings["compare"].items()}
        settings = {**settings, "compare": others}
    if "scene" in settings and isinstance(data, dict):
        settings = {**settings, "data": {"overlap": False, **data}}
    return settings
