"""The command line as Hydra reads it."""

from collections.abc import Collection, Sequence
from pathlib import Path

#: What an unquoted value of Hydra's must not have in it.
SIGNS = set("=,;()[]{}' ")


def with_paths_quoted(arguments: Sequence[str]) -> list[str]:
    """Arguments in which each value that is the path of a file or folder is quoted where it has to
    be: the run of a sweep is called camera.n_views=4,model=sirt.
    """
    return [_with_path_quoted(argument) for argument in arguments]


def _with_path_quoted(argument: str) -> str:
    key, sign, value = argument.partition("=")
    if not sign or key.startswith("-") or not SIGNS & set(value):
        return argument
    try:
        is_path = Path(value).expanduser().exists()
    except (OSError, ValueError):  # too long for a path
        return argument
    return f"{key}={quoted(value)}" if is_path else argument


def with_options_added(arguments: Sequence[str], sections: Collection[str]) -> list[str]:
    """Arguments in which an option of one of these sections, such as camera.n_views=12, is set
    whether the app's own file has it or not, as by Hydra's ++.
    """
    return [
        f"++{argument}"
        if "." in (key := argument.partition("=")[0]) and key.partition(".")[0] in sections
        else argument
        for argument in arguments
    ]


def with_flag_first(arguments: Sequence[str]) -> list[str]:
    """Arguments with the flag of a sweep before all settings: between two of them Hydra would not
    know those behind it.
    """
    return sorted(arguments, key=lambda argument: argument not in ("-m", "--multirun"))


def quoted(value: str | Sequence[str]) -> str:
    """A value in the grammar of Hydra's command line."""
    if not isinstance(value, str):
        return f"[{','.join(map(quoted, value))}]"
    return "'" + value.replace("'", r"\'") + "'"
