"""Files of a run folder by name; its settings one by one, and its table of results."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mvrecon.files.checks import Refused, blaming, shown, text_of

SETTINGS, EVALUATION, VERSIONS, RESULTS = "config.yaml", "eval.yaml", "versions.txt", "results.json"


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


def leaves(settings: Any, keys: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """List the values of nested mappings, each with its keys from the outermost on; an empty
    mapping is a value.
    """
    if isinstance(settings, Mapping) and settings:
        for key, value in settings.items():
            yield from leaves(value, (*keys, key))
    else:
        yield keys, settings
