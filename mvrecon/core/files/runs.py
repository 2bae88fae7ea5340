"""Files of a run folder by name; its settings one by one, and its table of results."""

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mvrecon.core.files.atomic import check_plain
from mvrecon.core.files.checks import Refused, blaming, shown, text_of

SETTINGS, EVALUATION, VERSIONS, RESULTS = "config.yaml", "eval.yaml", "versions.txt", "results.json"


def folder_of_run(path: str | Path) -> Path:
    """The run folder that a path names: itself, its `checkpoints` folder, or a checkpoint in it.

    Raises:
        FileNotFoundError: the path is not there, or no run folder is around it.
        PermissionError: anything but files and folders is in the run folder.
    """
    if not Path(path).expanduser().exists():
        raise FileNotFoundError(f"No checkpoint or run folder is at {os.path.abspath(path)}")
    folder = run_around(path)
    if folder is None:
        raise FileNotFoundError(
            f"Expected a checkpoint in a run folder (one with {SETTINGS}), got {path}"
        )
    check_plain(folder)
    return folder.resolve()


def run_around(path: str | Path) -> Path | None:
    """The folder with a run's settings that a path names or lies in, three levels deep at most;
    None: there is none.
    """
    path = Path(os.path.abspath(Path(path).expanduser()))  # links in it are not followed yet
    folders = (path, *path.parents[:3])
    return next((folder for folder in folders if (folder / SETTINGS).is_file()), None)


def read_results(folder: Path) -> dict[str, Any]:
    """Read the table of results that a run has written.

    Raises:
        Refused: it has none, or the file is none of a run's.
    """
    path = folder / RESULTS
    with blaming(path, "is no table of results"):
        table = json.loads(text_of(path))
    if not isinstance(table, dict) or "methods" not in table:
        raise Refused(f"{path}: expected a table of results, got {shown(table)}")
    return table


def flatten(settings: Any, keys: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """List the values of nested mappings, each with its keys from the outermost on; an empty
    mapping is a value.
    """
    if isinstance(settings, Mapping) and settings:
        for key, value in settings.items():
            yield from flatten(value, (*keys, key))
    else:
        yield keys, settings
