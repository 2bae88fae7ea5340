"""What the board is told at the end of a run: the settings of every method beside its figures, the
result table, and test scenes slice by slice.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from mvrecon.core.files.runs import flatten
from mvrecon.geometry.grid import Grid
from mvrecon.report.comparison.rows import rows_of
from mvrecon.report.comparison.tables import Cells, cells, markdown
from mvrecon.report.viz import review
from mvrecon.training.callbacks import named
from mvrecon.training.export import file_name
from mvrecon.training.fit import is_board, methods
from mvrecon.training.loggers import Board

#: Settings of a run that make no difference to what comes out, or whose place is taken by `method`.
SILENT = ("name", "resume", "plugins", "callbacks", "logger", "compare", "method", "label")
#: Figures of the table by their names in the results; costs, and theirs.
FIGURES = ("psnr", "ssim", "view_nrmse")
COSTS = {"ms": "ms_per_volume", "peak_mb": "peak_mb", "train_seconds": "train_seconds"}
#: Folder of the test's events in a method's.
TEST = "test"
#: The most test scenes that are shown, and the most slices of each.
CASES, SLICES = 2, 16


def wanted(settings: Mapping[str, Any]) -> bool:
    """Whether a run has a board."""
    loggers = (settings["logger"] or {}).values()
    return any(map(is_board, loggers))


def close(
    folder: Path, settings: Mapping[str, Any], table: Mapping[str, Any], overrides: Sequence[str]
) -> None:
    """Log settings and test figures of every method, the result table and the run's overrides,
    where the run has a board.

    A setting has the name that it has on the command line, such as camera.n_views; method.name is a
    class, which may serve several labels. TensorBoard puts those that differ between runs first.
    Beside them it shows all numbers of the folder, so that the test's have one of their own.
    """
    if not wanted(settings):
        return
    shared = {key: value for key, value in settings.items() if key not in SILENT}
    for label, method in methods(dict(settings)).items():
        row, board = table["methods"][label], Board(str(folder / label / TEST))
        figures = {f"test/{name}": row[name]["mean"] for name in FIGURES}
        costs = {
            f"test_costs/{name}": row[key] for name, key in COSTS.items() if row[key] is not None
        }
        settled = {"label": label, "method": method}
        values = {".".join(keys): v for keys, v in flatten(settled | shared)}
        board.log_session({k: _plain(v) for k, v in values.items()}, figures | costs)
        if label == next(iter(table["methods"])):
            rows = list(rows_of(table, settings["name"], folder))
            head, body = cells(rows, rows[0])
            narrow = Cells(head[1:], [line[1:] for line in body])  # of this run alone
            board.experiment.add_text("text/results", markdown(narrow))
            lines = [f"    {line}" for line in overrides] or ["none"]
            board.experiment.add_text("text/overrides", "\n".join(lines))
        board.finalize("success")


class Slices:
    """Logs the first test scenes slice by slice on the board of a run's main method: the steps of
    TensorBoard's slider are the numbers of the slices, from the feet to the head; its last step,
    where a card opens, is the middle slice once more.

    Args:
        folder: of the run.
        settings: of the run; without a board nothing is logged.
        grid: of the volumes.
        data_range: of the values.
        unit: of the values.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, Any], grid: Grid, data_range: float, unit: str
    ):
        self.folder, self.label = folder, next(iter(methods(dict(settings))))
        self.case = review.Case("", grid, data_range, unit)
        self.left = CASES if wanted(settings) else 0

    def __call__(self, scene: Mapping[str, Any], volumes: Mapping[str, Tensor]) -> None:
        """Log a scene and its reconstructions by label, unless there were enough before."""
        if not self.left:
            return
        self.left -= 1
        truth, case = scene["volume"][0, 0], self.case._replace(name=scene["name"][0])
        shown = {
            named(label, volume[0], scene, 0, case.data_range): volume[0, 0]
            for label, volume in volumes.items()
        }
        board = Board(str(self.folder / self.label / TEST))
        distance, tag = -(-len(truth) // SLICES), f"slices/{file_name(case.name)}"
        levels = range(distance // 2, len(truth), distance)
        middle = levels[len(levels) // 2]
        for step, z in (*zip(levels, levels, strict=True), (len(truth), middle)):
            image = review.slices(case, truth, shown, z)
            board.experiment.add_image(tag, image, step, dataformats="HWC")
        board.finalize("success")


def _plain(value: Any) -> bool | float | str:
    return value if isinstance(value, bool | int | float | str) else str(value)
