"""Settings of earlier versions: options that have a new name now."""

from typing import Any

#: Rigs whose number of views was the option `views` up to version 0.1.0.
RIGS = ("arc", "circular", "dome", "parallel")


def current(settings: Any) -> Any:
    """The settings of a run, or the geometry of a checkpoint, with the option names of this
    version; other values are returned unchanged.
    """
    camera = settings.get("camera") if isinstance(settings, dict) else None
    if not isinstance(camera, dict) or camera.get("name") not in RIGS:
        return settings
    renamed = {"n_views" if key == "views" else key: value for key, value in camera.items()}
    return {**settings, "camera": renamed}
