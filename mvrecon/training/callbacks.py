"""Callbacks and loggers of every training: progress, run time and memory, path checks, compilation
and activation checkpointing; `metrics.csv` and TensorBoard's events.
"""

import csv
import os
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.fabric.loggers.tensorboard import TensorBoardLogger as FabricTensorBoard
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from rich import progress
from rich.console import Console
from torch import nn
from torch.utils.checkpoint import checkpoint

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.runs import read_rows
from mvrecon.core.machine import peak, rank, restarted_peak
from mvrecon.training.loop import optimizer_steps
from mvrecon.training.settings import LoggerPart
from mvrecon.training.targets import check_places

SHORT_NAMES = {"loss/total": "loss", "val/psnr": "psnr"}


def tell(line: str) -> None:
    """Write a line to stderr, from the first process."""
    Console(quiet=rank() > 0, stderr=True, markup=False, highlight=False).print(
        line, soft_wrap=True
    )


class StepProgress(ProgressBar):
    """One line for each method: steps, elapsed and remaining time, loss, last validation PSNR."""

    label = ""  # of the method in the run's table
    _lines: progress.Progress | None = None
    _shown = True

    def disable(self) -> None:
        """Hide the line, as in all but the first of several processes."""
        self._shown = False

    def enable(self) -> None:
        """Show the line."""
        self._shown = True

    def on_train_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Open the line, at the step of a resumed training."""
        if not self._shown:
            return
        figures = progress.TextColumn("{task.fields[figures]}")
        times = (progress.TimeElapsedColumn(), progress.TimeRemainingColumn())
        self._lines = progress.Progress(
            progress.TextColumn("{task.description}"),
            progress.BarColumn(16),
            progress.MofNCompleteColumn(),
            *times,
            figures,
        )
        total = optimizer_steps(trainer)
        self._lines.add_task(self.label, total=total, completed=trainer.global_step, figures="")
        self._lines.start()

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Advance by a step; update figures at logged steps only, which synchronises with a GPU."""
        if self._lines is None:
            return
        task, step = self._lines.task_ids[0], trainer.global_step
        self._lines.update(task, completed=step)
        if step % max(1, trainer.log_every_n_steps) == 0:  # pyrefly: ignore[missing-attribute]
            shown = "  ".join(
                f"{SHORT_NAMES.get(name, name)} {value:.4g}"
                for name, value in trainer.progress_bar_metrics.items()
            )
            self._lines.update(task, figures=shown)

    def on_train_end(self, *_: Any) -> None:
        """Stop the line and restore the terminal; the line stays visible."""
        if self._lines is not None:
            self._lines.stop()
            self._lines = None

    def on_exception(self, *_: Any) -> None:
        """Stop the line."""
        self.on_train_end()


CONVOLUTIONS = (nn.Conv1d, nn.Conv2d, nn.Conv3d, nn.ConvTranspose2d, nn.ConvTranspose3d)


class Recompute(L.Callback):
    """Activation checkpointing: stores only the inputs of the networks' blocks, and recomputes the
    rest for the gradients (Chen et al. 2016, arXiv:1604.06174).

    Same gradients in less memory; a step takes about a third longer.
    """

    def setup(self, trainer: L.Trainer, pl_module: Any, stage: str) -> None:
        """Replace the blocks' forward; names of parameters stay."""
        if stage == "fit":
            for block in blocks(pl_module.method):
                block.forward = partial(checkpoint, block.forward, use_reentrant=False)


def blocks(model: nn.Module) -> Iterator[nn.Module]:
    """The innermost modules with convolutions whose classes are not torch's own: their forward is
    certainly called.
    """
    inner = [block for child in model.children() for block in blocks(child)]
    torchs = type(model).__module__.startswith("torch.")
    convolves = not torchs and any(isinstance(module, CONVOLUTIONS) for module in model.modules())
    yield from inner or ([model] if convolves else [])


class Clock(L.Callback):
    """Logs `time/*`: milliseconds per step, volumes per second, seconds of training so far, peak
    memory of the GPU or else of this process in units of 2^20 bytes (not on Windows).

    Excludes validation and pictures. The seconds are part of the checkpoint, so a resumed run adds
    to them.
    """

    of_every_run = True

    def __init__(self) -> None:
        self.seconds = 0.0
        self._mark = 0.0

    def state_dict(self) -> dict[str, float]:
        """State for a checkpoint."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Resume from a checkpoint."""
        self.seconds = state_dict["seconds"]

    def on_train_start(self, *_: Any) -> None:
        """Start."""
        restarted_peak()  # one process trains several methods
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        self._mark = time.perf_counter()

    def on_validation_end(self, *_: Any) -> None:
        """Exclude the time of the validation."""
        self._mark = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log one step, including its data loading."""
        now = time.perf_counter()
        step, self._mark = now - self._mark, now
        self.seconds += step
        count = len(batch["views"])
        speed = count * trainer.world_size / step
        figures = {"step_ms": 1e3 * step, "volumes_per_s": speed, "seconds": self.seconds}
        most = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else peak()
        figures |= {} if most is None else {"peak_mb": most / 2**20}
        # as CPU tensors: Lightning would copy plain numbers to a GPU, and synchronise
        logged = {f"time/{name}": torch.tensor(value) for name, value in figures.items()}
        pl_module.log_dict(logged, batch_size=count)


class Confined(L.Callback):
    """Stops a training whose callbacks or loggers would write outside the run folder.

    Their options were checked when built, but a checkpoint may restore other paths.

    Args:
        folder: the run folder.
    """

    of_every_run = True

    def __init__(self, folder: Path):
        self.folder = folder

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Check the paths after all states are restored.

        Raises:
            PermissionError: a place outside the folder.
        """
        for thing in (*trainer.callbacks, *trainer.loggers):  # pyrefly: ignore[missing-attribute]
            check_places(thing, self.folder)


class CompileModel(L.Callback):
    """Compiles the network, not the LightningModule, whose logging must not be traced, before
    training.

    Args:
        mode: mode of `torch.compile`; "reduce-overhead" records CUDA graphs.
    """

    def __init__(self, mode: str | None = None):
        self.mode = mode

    def setup(self, trainer: L.Trainer, pl_module: Any, stage: str) -> None:
        """Compile in place; names of parameters stay."""
        if stage == "fit":
            pl_module.method.compile(mode=self.mode)


class _Continuing(ExperimentWriter):
    """Appends to an existing `metrics.csv`, which Lightning's own writer would delete."""

    def _check_log_dir_exists(self) -> None:
        if os.path.isfile(self.metrics_file_path):
            with open(self.metrics_file_path, newline="") as file:
                self.metrics_keys = next(csv.reader(file), [])

    def _rewrite_with_new_header(self, fieldnames: list[str]) -> None:
        """Rewrite atomically; Lightning's own loses all rows if killed meanwhile."""
        self._write(fieldnames, read_rows(self.metrics_file_path))

    def rewind(self, step: int) -> None:
        """Delete the rows from a step on, and an incomplete last row."""
        if not os.path.isfile(self.metrics_file_path):
            return
        with open(self.metrics_file_path, newline="") as file:
            lines = [line for line in file if line.endswith("\n")]
        rows = [row for row in csv.DictReader(lines) if int(row["step"]) < step]
        self._write(next(csv.reader(lines), []), rows)

    def _write(self, names: list[str], rows: list[dict[str, str]]) -> None:
        with written_whole(self.metrics_file_path) as part, open(part, "w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)


class MetricsFile(CSVLogger):
    """Logs every number to `metrics.csv` in a folder; a resumed run appends.

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
        """The writer of the logger."""
        if self._experiment is None:
            self._experiment = _Continuing(log_dir=self.log_dir)
        return self._experiment

    def rewind(self, step: int) -> None:
        """Delete an interrupted run's rows from a step on, which the resumed run logs again."""
        self.experiment.rewind(step)


#: Prefixes of names in TensorBoard, which sorts its groups by name: results come first, before
#: `loss`.
TENSORBOARD_NAMES = {
    "val/loss_": "loss_validation/",
    "val/cameras_": "cameras/",
    "val/quality_": "quality/",
    "val/": "figures/",
    "lr-": "optimizer/lr-",
}


class TensorBoard(TensorBoardLogger):
    """TensorBoard's events in a folder, without hyper-parameters, which are in `config.yaml`, and
    epochs. Numbers are renamed by `TENSORBOARD_NAMES`.

    Args:
        save_dir: the folder.
    """

    def __init__(self, save_dir: str):
        super().__init__(save_dir, name="", version="", default_hp_metric=False)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log numbers under their TensorBoard names."""
        shown = {}
        for name, value in metrics.items():
            if name != "epoch":
                start = next((start for start in TENSORBOARD_NAMES if name.startswith(start)), "")
                shown[TENSORBOARD_NAMES.get(start, "") + name[len(start) :]] = value
        super().log_metrics(shown, step)

    def log_session(self, settings: Mapping[str, object], figures: Mapping[str, float]) -> None:
        """Log settings and figures for the table HPARAMS, without listing the settings, so that
        TensorBoard collects those of all runs, differing ones first.
        """
        from torch.utils.tensorboard.summary import hparams

        _, begin, end = hparams(dict(settings), dict(figures))
        writer = self.experiment._get_file_writer()
        writer.add_summary(begin)
        writer.add_summary(end)
        for name, value in figures.items():
            self.experiment.add_scalar(name, value, 0)

    def rewind(self, step: int) -> None:
        """Hide an interrupted run's events from a step on, which the resumed run logs again."""
        self._kwargs["purge_step"] = step

    def save(self) -> None:
        """Flush pending events."""
        FabricTensorBoard.save(self)


def is_tensorboard(node: LoggerPart | None) -> bool:
    """Whether the settings of a logger are those of `TensorBoard`."""
    return (
        bool(node)
        and node.get("_target_") == f"{TensorBoard.__module__}.{TensorBoard.__qualname__}"
    )
