"""Logs in the run folder: `metrics.csv`, and events for TensorBoard."""

import csv
import os
from collections.abc import Mapping
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.fabric.loggers.tensorboard import TensorBoardLogger as FabricTensorBoard
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter

from mvrecon.core.files.atomic import written_whole


class _Continuing(ExperimentWriter):
    """Appends to an existing `metrics.csv`, which Lightning's own writer would delete."""

    def _check_log_dir_exists(self) -> None:
        if os.path.isfile(self.metrics_file_path):
            with open(self.metrics_file_path, newline="") as file:
                self.metrics_keys = next(csv.reader(file), [])

    def _rewrite_with_new_header(self, fieldnames: list[str]) -> None:
        """Lightning's own loses what was there when it is killed meanwhile."""
        with open(self.metrics_file_path, newline="") as file:
            rows = list(csv.DictReader(file))
        self._write(fieldnames, rows)

    def rewind(self, step: int) -> None:
        """Delete the rows from a step on, and a last row that is incomplete."""
        if not os.path.isfile(self.metrics_file_path):
            return
        with open(self.metrics_file_path, newline="") as file:
            lines = [line for line in file if line.endswith("\n")]
        rows = [row for row in csv.DictReader(lines) if int(row["step"]) < step]
        self._write(next(csv.reader(lines), []), rows)

    def _write(self, names: list[str], rows: list[dict[str, Any]]) -> None:
        with written_whole(self.metrics_file_path) as part, open(part, "w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)


class MetricsFile(CSVLogger):
    """Every logged number, as `metrics.csv` flat in a folder; a resumed run adds to it.

    Args:
        save_dir: the folder.
        flush_logs_every_n_steps: how often the file is written.
    """

    def __init__(self, save_dir: str, flush_logs_every_n_steps: int = 100):
        super().__init__(
            save_dir, name="", version="", flush_logs_every_n_steps=flush_logs_every_n_steps
        )

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """The writer behind the logger."""
        if self._experiment is None:
            self._experiment = _Continuing(log_dir=self.log_dir)
        return self._experiment

    def rewind(self, step: int) -> None:
        """Delete what an interrupted run logged from a step on: the resumed run logs it again."""
        self.experiment.rewind(step)


#: What a number is called on the board, by its beginning: TensorBoard sorts its groups by name, and
#: results come first, before `loss`.
ON_BOARD = {
    "val/loss_": "loss_validation/",
    "val/cameras_": "cameras/",
    "val/quality_": "quality/",
    "val/": "figures/",
    "lr-": "optimizer/lr-",
}


class TensorBoard(TensorBoardLogger):
    """TensorBoard's events flat in a folder, without a file of hyper-parameters: `config.yaml` has
    them. Numbers have names of its own (`ON_BOARD`), and the epoch is left out.

    Args:
        save_dir: the folder.
    """

    def __init__(self, save_dir: str):
        super().__init__(save_dir, name="", version="", default_hp_metric=False)

    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Log numbers by their names on the board."""
        shown = {}
        for name, value in metrics.items():
            if name != "epoch":
                start = next((start for start in ON_BOARD if name.startswith(start)), "")
                shown[ON_BOARD.get(start, "") + name[len(start) :]] = value
        super().log_metrics(shown, step)

    def log_session(self, settings: Mapping[str, Any], figures: Mapping[str, float]) -> None:
        """Log settings and figures for the table HPARAMS, without saying which settings there are:
        TensorBoard then takes those of all runs, first those that differ.
        """
        from torch.utils.tensorboard.summary import hparams

        _, begin, end = hparams(dict(settings), dict(figures))
        writer = self.experiment._get_file_writer()
        writer.add_summary(begin)
        writer.add_summary(end)
        for name, value in figures.items():
            self.experiment.add_scalar(name, value, 0)

    def rewind(self, step: int) -> None:
        """Make TensorBoard hide what an interrupted run logged from a step on: the resumed run logs
        it again.
        """
        self._kwargs["purge_step"] = step

    def save(self) -> None:
        """Write what is waiting."""
        FabricTensorBoard.save(self)


def is_tensorboard(node: Mapping[str, Any] | None) -> bool:
    """Whether the settings of a logger are those of `TensorBoard`."""
    return (
        bool(node)
        and node.get("_target_") == f"{TensorBoard.__module__}.{TensorBoard.__qualname__}"
    )
