"""Keep the files of callbacks and loggers inside the run folder, whatever their options or a
checkpoint say.
"""

import inspect
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvrecon.core.files.checks import shown

#: Options whose value is a file or a folder of its own; `sub_dir` is one below another.
PLACE = re.compile(r"(?!sub_dir$)(.*_)?(dir|dirpath|path)")
#: Places that a logger of Lightning works out of several options.
LOGS = ("save_dir", "root_dir", "log_dir")
#: Addresses of files that are no paths: file:x, memory://x, simplecache::x; those of a web service
#: write no file here.
ADDRESS = re.compile(r"(?!https?://)(file:|.*(:/|::))")
#: Trained weights that are part of mvrecon.
WEIGHTS = Path(__file__).parents[2] / "weights"


def inside(path: str | os.PathLike[str], folder: Path, what: str) -> Path:
    """Resolve the links of a path and check that it lies inside a folder.

    Args:
        path: to a file or a folder, there or not.
        folder: the run folder.
        what: leads there, for the message.

    Raises:
        PermissionError: it lies elsewhere.
    """
    resolved = Path(path).resolve()
    if not resolved.is_relative_to(folder.resolve()):
        raise PermissionError(
            f"{what} leads to {resolved}; expected a place inside the run folder {folder}"
        )
    return resolved


def placed(options: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Options of a callback or a logger, each place among them (`dirpath`, `save_dir`, ...) taken
    from a folder.

    Raises:
        PermissionError: a text that would lead elsewhere, under whatever name: an absolute path,
            `..`, `~`, an address.
    """
    return {key: _placed(str(key), value, folder) for key, value in options.items()}


def _placed(key: str, value: Any, folder: Path) -> Any:
    if isinstance(value, Mapping):
        return placed(value, folder)
    if isinstance(value, list | tuple):
        return [_placed(key, item, folder) for item in value]
    if not isinstance(value, str):
        return value
    steps = re.split(r"[/\\]", value)
    if ".." in steps or value.startswith("~") or Path(value).anchor or ADDRESS.match(value):
        raise PermissionError(
            f"The option {key}={shown(value)} leads elsewhere; expected a place inside the run "
            f"folder {folder}"
        )
    return str(folder / value) if PLACE.fullmatch(key) else value


def check_places(thing: Any, folder: Path) -> None:
    """Check every path that a callback or a logger would write to.

    Raises:
        PermissionError: one of them lies outside the folder.
    """
    names = [name for name in inspect.signature(type(thing)).parameters if PLACE.fullmatch(name)]
    for name in dict.fromkeys((*names, *LOGS)):
        place = getattr(thing, name, None)
        if isinstance(place, str | os.PathLike) and str(place):
            inside(place, folder, f"{name} of {type(thing).__name__}")


def shipped_weights() -> dict[str, Path]:
    """The files of trained weights that are part of mvrecon, by name."""
    return {path.stem: path for path in sorted(WEIGHTS.glob("*.safetensors"))}


def of_weights(path: str | os.PathLike[str]) -> Path:
    """The absolute path of a checkpoint; a name at which nothing is may be that of weights that are
    part of mvrecon.
    """
    local = Path(path).expanduser()
    return (
        local.absolute() if local.exists() else shipped_weights().get(str(path), local.absolute())
    )
