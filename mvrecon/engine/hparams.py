"""The board's table of runs: the settings of every method beside its figures on the test scenes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvrecon.engine.fit import BOARD, methods
from mvrecon.engine.loggers import Board
from mvrecon.files.runs import leaves

#: Settings of a run that make no difference to what comes out, or whose place is taken by `model`.
SILENT = ("name", "resume", "plugins", "callbacks", "logger", "compare", "model")
#: Figures of the table by their names in the results; costs, and theirs.
FIGURES = ("psnr", "ssim", "view_nrmse")
COSTS = {"ms": "ms_per_volume", "peak_mb": "peak_mb", "train_seconds": "train_seconds"}


def write(folder: Path, settings: Mapping[str, Any], table: Mapping[str, Any]) -> None:
    """Log settings and test figures of every method, where the run has a board.

    A setting has a name of its own, such as camera.n_views: TensorBoard puts those that differ
    between runs first.
    """
    loggers = (settings["logger"] or {}).values()
    if not any(node and node["_target_"] == BOARD for node in loggers):
        return
    shared = {key: value for key, value in settings.items() if key not in SILENT}
    for label, model in methods(dict(settings)).items():
        row, board = table["methods"][label], Board(str(folder / label))
        figures = {f"test/{name}": row[name]["mean"] for name in FIGURES}
        costs = {f"test/{name}": row[key] for name, key in COSTS.items() if row[key] is not None}
        options = {key: value for key, value in model.items() if key != "name"}
        named = {"method": label, "model": {"": model["name"], **options}}
        values = {".".join(filter(None, keys)): v for keys, v in leaves(named | shared)}
        board.log_hyperparams({k: _plain(v) for k, v in values.items()}, figures | costs)
        board.finalize("success")


def _plain(value: Any) -> bool | float | str:
    return value if isinstance(value, bool | int | float | str) else str(value)
