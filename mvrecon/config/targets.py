"""Build the callbacks and loggers that a config names by `_target_`; only allowed classes, which
write inside the run folder.
"""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from mvrecon.files.checks import shown
from mvrecon.files.places import check_places, placed

#: Where the classes that a `_target_` may name are defined, and what they must be.
ALLOWED = ("lightning.pytorch", "mvrecon.engine")
BASES = ("lightning.pytorch.callbacks.Callback", "lightning.pytorch.loggers.Logger")


def instantiate(node: Mapping[str, Any], folder: Path, **options: Any) -> Any:
    """Build the callback or the logger that a node's `_target_` names, with the node's other
    entries as options.

    Args:
        node: `_target_` and options; places among these, such as `dirpath`, are taken from
            `folder`.
        folder: the run folder, out of which nothing is written.
        options: further options, which are trusted.

    Raises:
        PermissionError: the target is not a class of that kind that is defined below one of
            `ALLOWED`, every run has it already, or the options hold instructions of Hydra's such as
            another target, or lead out of the folder.
    """
    entries = {key: value for key, value in node.items() if key != "_target_"}
    if instructions := _instructions(entries):
        raise PermissionError(
            f"{shown(instructions)} in the options of a _target_ is not allowed; expected plain "
            f"values"
        )
    made = _allowed(str(node["_target_"]))(**placed(entries, folder), **options)
    check_places(made, folder)
    return made


def _instructions(node: Any) -> list[str]:
    if isinstance(node, Mapping):
        keys = [str(key) for key in node if str(key).startswith("_")]
        return keys + [key for value in node.values() for key in _instructions(value)]
    return (
        [key for value in node for key in _instructions(value)]
        if isinstance(node, list | tuple)
        else []
    )


def _allowed(target: str) -> type:
    """The class that a target names. Its bases and its module decide, not the name: a name may lead
    out of a module (`a.b.os.system`), and a function of an allowed library may call any other.
    """
    cls = _attribute(target) if target.startswith(tuple(f"{name}." for name in ALLOWED)) else None
    if isinstance(cls, type) and issubclass(cls, tuple(map(_attribute, BASES))):
        if getattr(cls, "of_every_run", False):
            raise PermissionError(
                f"_target_ {target!r} is not allowed; expected none that every run has already"
            )
        if cls.__module__.startswith(tuple(f"{name}." for name in ALLOWED)):
            return cls
    raise PermissionError(
        f"_target_ {target!r} is not allowed; expected a class from {' or '.join(ALLOWED)} "
        f"derived from "
        f"{' or '.join(BASES)}"
    )


def _attribute(target: str) -> Any:
    module, _, name = target.rpartition(".")
    try:
        return getattr(import_module(module), name, None)
    except ModuleNotFoundError:
        return None
