"""Progress on the terminal."""

from typing import Any

import lightning.pytorch as L
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from mvrecon.core.machine import rank

SHORT = {"loss/total": "loss", "val/psnr": "psnr"}


def tell(line: str) -> None:
    """Write a line about the training to the error stream; of several processes the first does."""
    Console(quiet=rank() > 0, stderr=True, markup=False, highlight=False).print(
        line, soft_wrap=True
    )


class StepProgress(ProgressBar):
    """One line for each method in training: steps, time taken and left, loss, PSNR of the last
    validation.

    Args:
        label: of the method in the run's table; "" before it is known.
    """

    def __init__(self, label: str = "") -> None:
        super().__init__()
        self.label = label
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
        total = trainer.estimated_stepping_batches
        self._lines.add_task(self.label, total=total, completed=trainer.global_step, figures="")
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
