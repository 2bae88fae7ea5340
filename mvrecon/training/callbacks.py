"""Callbacks of every training: progress on the terminal, run time and memory, paths,
compilation and activation checkpointing.
"""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
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
from torch import nn
from torch.utils.checkpoint import checkpoint

from mvrecon.core.machine import peak, rank, restarted_peak
from mvrecon.core.targets import check_places

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
        """Stop the line and restore the terminal; the line stays visible."""
        if self._lines is not None:
            self._lines.stop()
            self._lines = None

    def on_exception(self, *_: Any) -> None:
        """Stop the line, too."""
        self.on_train_end()


CONVOLUTIONS = (nn.Conv1d, nn.Conv2d, nn.Conv3d, nn.ConvTranspose2d, nn.ConvTranspose3d)


class Recompute(L.Callback):
    """Activation checkpointing: stores only what goes into each block of the networks, and computes
    the rest again for the gradients (Chen et al. 2016, arXiv:1604.06174).

    Same gradients in less memory; a step takes about a third longer.
    """

    def setup(self, trainer: L.Trainer, pl_module: Any, stage: str) -> None:
        """Replace the blocks' forward; names of parameters stay."""
        if stage == "fit":
            for block in blocks(pl_module.method):
                block.forward = partial(checkpoint, block.forward, use_reentrant=False)


def blocks(model: nn.Module) -> Iterator[nn.Module]:
    """The innermost modules with convolutions in them whose classes are not torch's own: of these
    it is sure that their forward is called.
    """
    inner = [block for child in model.children() for block in blocks(child)]
    torchs = type(model).__module__.startswith("torch.")
    convolves = not torchs and any(isinstance(module, CONVOLUTIONS) for module in model.modules())
    yield from inner or ([model] if convolves else [])


class Clock(L.Callback):
    """Logs `time/*`: milliseconds per step, volumes per second, seconds of training so far, peak
    memory of the GPU or else of this process in units of 2^20 bytes.

    Validation and pictures do not count. The seconds go into the checkpoint, so a resumed run adds
    to them. Windows does not tell the memory.
    """

    of_every_run = True

    def __init__(self) -> None:
        self.seconds = 0.0
        self._mark = 0.0

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
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
        """One step, its data included."""
        now = time.perf_counter()
        step, self._mark = now - self._mark, now
        self.seconds += step
        count = len(batch["views"])
        speed = count * trainer.world_size / step
        figures = {"step_ms": 1e3 * step, "volumes_per_s": speed, "seconds": self.seconds}
        most = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else peak()
        figures |= {} if most is None else {"peak_mb": most / 2**20}
        # as tensors in main memory: Lightning would copy plain numbers to a GPU, and wait for it
        logged = {f"time/{name}": torch.tensor(value) for name, value in figures.items()}
        pl_module.log_dict(logged, batch_size=count)


class Confined(L.Callback):
    """Refuses a training whose callbacks or loggers would write outside the run folder.

    Their options were looked at when they were built; a checkpoint to go on from may hold other
    places.

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
        for thing in (*trainer.callbacks, *trainer.loggers):  # pyright: ignore[reportAttributeAccessIssue]
            check_places(thing, self.folder)


class CompileModel(L.Callback):
    """Compiles the network before training. Never the LightningModule, whose logging must not be
    traced.

    Args:
        mode: of `torch.compile`; "reduce-overhead" records CUDA graphs.
    """

    def __init__(self, mode: str | None = None):
        self.mode = mode

    def setup(self, trainer: L.Trainer, pl_module: Any, stage: str) -> None:
        """Compile in place; names of parameters stay."""
        if stage == "fit":
            pl_module.method.compile(mode=self.mode)
