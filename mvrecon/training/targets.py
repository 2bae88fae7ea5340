"""Build the callbacks and loggers of a config: allowed classes by `_target_`, those of installed
plugins by `name`; they may write inside the run folder only.
"""

import inspect
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from mvrecon.core.files.checks import shown
from mvrecon.core.parts import CALLBACKS
from mvrecon.core.registry import Registry
from mvrecon.training.settings import CallbackPart, LoggerPart

#: Packages of the classes allowed as `_target_`, and their base classes.
ALLOWED_PACKAGES = ("lightning.pytorch", "mvrecon.training")
ALLOWED_BASES = ("lightning.pytorch.callbacks.Callback", "lightning.pytorch.loggers.Logger")


def instantiate(
    node: CallbackPart | LoggerPart, folder: Path, known: Registry = CALLBACKS, **options: Any
) -> Any:
    """Build a callback or logger from a node's `_target_`, or else its `name`, with the node's
    other entries as options.

    Args:
        node: `_target_` or `name`, and options; paths among these, such as `dirpath`, are relative
            to `folder`.
        folder: the run folder, which confines all output.
        known: plugins' classes by name, which are trusted as installed.
        options: further options, which are trusted.

    Raises:
        LookupError: an unknown name.
        TypeError: neither a target nor a name.
        PermissionError: the target is not a suitable class defined in one of `ALLOWED_PACKAGES`, is
            part of every run, or its options hold instructions of Hydra's such as another target,
            or lead out of the folder.
    """
    key = "_target_" if "_target_" in node else "name"
    if key not in node:
        raise TypeError(f"A {known.kind} needs a _target_ or a name, got {shown(sorted(node))}")
    make = allowed(str(node[key])) if key == "_target_" else known.get(str(node[key]))
    entries = {option: value for option, value in node.items() if option != key}
    made = make(**placed(entries, folder), **options)
    check_places(made, folder)
    return made


def allowed(target: str) -> type:
    """The class of a target, checked by its bases and module, as a name may lead out of a module
    (`a.b.os.system`), and a function of an allowed library may call any other.

    Raises:
        PermissionError: it is not a suitable class, or part of every run.
    """
    packages, cls = tuple(f"{name}." for name in ALLOWED_PACKAGES), None
    if target.startswith(packages):
        with suppress(ModuleNotFoundError, AttributeError, ValueError):
            cls = resolve_name(":".join(target.rsplit(".", 1)))
    if isinstance(cls, type) and issubclass(cls, tuple(map(resolve_name, ALLOWED_BASES))):
        if getattr(cls, "of_every_run", False):
            raise PermissionError(
                f"_target_ {target!r} is not allowed; expected none that every run has already"
            )
        if cls.__module__.startswith(packages):
            return cls
    raise PermissionError(
        f"_target_ {target!r} is not allowed; expected a class from "
        f"{' or '.join(ALLOWED_PACKAGES)} derived from "
        f"{' or '.join(ALLOWED_BASES)}"
    )


#: Options that are paths; `sub_dir` is relative to another.
PATH_OPTION = re.compile(r"(?!sub_dir$)(.*_)?(dir|dirpath|path)")
#: Paths that a Lightning logger derives from several options.
LOG_PATHS = ("save_dir", "root_dir", "log_dir")
#: URLs of files, which are not paths: file:x, memory://x, simplecache::x; those of web services
#: write no local file.
FILE_URL = re.compile(r"(?!https?://)(file:|.*(:/|::))")


def inside(path: str | os.PathLike[str], folder: Path, what: str) -> Path:
    """Resolve a path's links and check that it lies inside a folder.

    Args:
        path: path of a file or a folder, existing or not.
        folder: the run folder.
        what: name of the path, for the message.

    Raises:
        PermissionError: it lies outside.
    """
    resolved = Path(path).resolve()
    if not resolved.is_relative_to(folder.resolve()):
        raise PermissionError(
            f"{what} leads to {resolved}; expected a place inside the run folder {folder}"
        )
    return resolved


def placed(options: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Make the paths among the options of a callback or logger (`dirpath`, `save_dir`, ...)
    relative to a folder.

    Raises:
        PermissionError: any text that leads elsewhere: an absolute path, `..`, `~`, a URL; an
            instruction of Hydra's.
    """
    if instructions := [key for key in options if str(key).startswith("_")]:
        raise PermissionError(
            f"{shown(instructions)} in the options of a _target_ is not allowed; expected plain "
            f"values"
        )
    return {key: _placed(str(key), value, folder) for key, value in options.items()}


def _placed(key: str, value: Any, folder: Path) -> Any:
    if isinstance(value, Mapping):
        return placed(value, folder)
    if isinstance(value, list | tuple):
        return [_placed(key, item, folder) for item in value]
    if not isinstance(value, str):
        return value
    steps = re.split(r"[/\\]", value)
    if ".." in steps or value.startswith("~") or Path(value).anchor or FILE_URL.match(value):
        raise PermissionError(
            f"The option {key}={shown(value)} leads elsewhere; expected a place inside the run "
            f"folder {folder}"
        )
    return str(folder / value) if PATH_OPTION.fullmatch(key) else value


def check_places(thing: Any, folder: Path) -> None:
    """Check all output paths of a callback or logger.

    Raises:
        PermissionError: one of them lies outside the folder.
    """
    names = [
        name for name in inspect.signature(type(thing)).parameters if PATH_OPTION.fullmatch(name)
    ]
    for name in dict.fromkeys((*names, *LOG_PATHS)):
        place = getattr(thing, name, None)
        if isinstance(place, str | os.PathLike) and str(place):
            inside(place, folder, f"{name} of {type(thing).__name__}")
