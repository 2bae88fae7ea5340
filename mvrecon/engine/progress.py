"""Progress on the terminal."""

import logging
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.callbacks import ProgressBar
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

SHORT = {"loss/total": "loss", "val/psnr": "psnr"}


def silence_libraries() -> None:
    """Leave libraries' own lines about devices, seeds and fonts out; their warnings stay."""
    for library in ("lightning.pytorch", "lightning.fabric", "matplotlib"):
        logging.getLogger(library).setLevel(logging.WARNING)


class StepProgress(ProgressBar):
    """One line for each method in training: steps, time taken and left, loss, PSNR of the last
    validation.
    """

    def __init__(self) -> None:
        super().__init__()
        self._lines: Progress | None = None
        self._shown = True

    def disable(self) -> None:
        """Show nothing (Lightning asks for it on all but the first of several processes)."""
        self._shown = False

    def enable(self) -> None:
        """Show the line."""
        self._shown = True

    def on_train_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Open the line; a resumed training starts where it was left."""
        if not self._shown:
            return
        figures = TextColumn("{task.fields[figures]}")
        times = (TimeElapsedColumn(), TimeRemainingColumn())
        self._lines = Progress(
            TextColumn("{task.description}"), BarColumn(16), MofNCompleteColumn(), *times, figures
        )
        name, total = pl_module.hparams["model"]["name"], trainer.estimated_stepping_batches
        self._lines.add_task(name, total=total, completed=trainer.global_step, figures="")
        self._lines.start()

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Move on by a step; figures at the steps that are logged, since a GPU is waited for."""
        if self._lines is None:
            return
        task, step = self._lines.task_ids[0], trainer.global_step
        self._lines.update(task, completed=step)
        if step % max(1, trainer.log_every_n_steps) == 0:  # pyright: ignore[reportAttributeAccessIssue]
            shown = "  ".join(
                f"{SHORT.get(name, name)} {value:.4g}"
                for name, value in trainer.progress_bar_metrics.items()
            )
            self._lines.update(task, figures=shown)

    def on_train_end(self, *_: Any) -> None:
        """Stop the line; it stays visible."""
        self._close()

    def on_exception(self, *_: Any) -> None:
        """Stop the line and restore the terminal."""
        self._close()

    def _close(self) -> None:
        if self._lines is not None:
            self._lines.stop()
            self._lines = None
