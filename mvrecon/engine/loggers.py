"""Logs flat in the run folder: a table of numbers, and the board."""

import csv
import os
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.fabric.loggers.tensorboard import TensorBoardLogger as FabricBoard
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter


class _Continuing(ExperimentWriter):
    """Goes on with a `metrics.csv` that is there already, where Lightning's own would delete it."""

    def _check_log_dir_exists(self) -> None:
        if os.path.isfile(self.metrics_file_path):
            with open(self.metrics_file_path, newline="") as file:
                self.metrics_keys = next(csv.reader(file), [])


class MetricsFile(CSVLogger):
    """Every logged number, as `metrics.csv` flat in a folder; a resumed run adds to it.

    Args:
        save_dir: the folder.
        flush_logs_every_n_steps: how often the file is written.
    """

    def __init__(self, save_dir: str, flush_logs_every_n_steps: int = 100):
        super().__init__(save_dir, name="", version="", flush_logs_every_n_steps=flush_logs_every_n_steps)

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """The writer behind the logger."""
        if self._experiment is None:
            self._experiment = _Continuing(log_dir=self.log_dir)
        return self._experiment


class Board(TensorBoardLogger):
    """TensorBoard's events flat in a folder, without a file of hyper-parameters: `config.yaml` has them.

    Args:
        save_dir: the folder.
    """

    def __init__(self, save_dir: str):
        super().__init__(save_dir, name="", version="", default_hp_metric=False)

    def save(self) -> None:
        """Write what is waiting."""
        FabricBoard.save(self)
