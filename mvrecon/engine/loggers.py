"""The table of logged numbers in the run folder."""

import csv
import os
from typing import Any

from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.loggers.logger import rank_zero_experiment


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
