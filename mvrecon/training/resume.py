"""Resume a training exactly after an interruption, and extend a finished one to more steps."""

import random
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

import lightning.pytorch as L
import numpy as np
import torch
import yaml
from lightning.pytorch.callbacks import (
    Checkpoint,
    EarlyStopping,
    EMAWeightAveraging,
    ModelCheckpoint,
    Timer,
)
from lightning.pytorch.callbacks.early_stopping import EarlyStoppingReason
from lightning.pytorch.utilities.exceptions import SIGTERMException

from mvrecon.core.files.atomic import claimed
from mvrecon.core.files.checks import Refused
from mvrecon.core.files.runs import RESULTS, SETTINGS, flatten
from mvrecon.core.machine import world
from mvrecon.data.module import SceneData
from mvrecon.training import run_folder
from mvrecon.training.callbacks import tell
from mvrecon.training.checkpoints import (
    TrainingState,
    finished,
    previous,
    read,
    remove,
    unfinished,
    write,
)
from mvrecon.training.module import lr_factor
from mvrecon.training.settings import TrainSettings


class KeepLast(Checkpoint):
    """Writes the checkpoint for resuming: after every validation, or after every epoch without
    validation, when a callback such as a timer stops the training, and on SIGTERM (a single process
    only: several get it at different steps, and stop at once).

    Args:
        path: path of the checkpoint; the previous one stays beside it.
        settings: what `kept` returns; part of the checkpoint.
    """

    of_every_run = True

    def __init__(self, path: Path, settings: Mapping[str, Any]):
        self.path, self.settings = path, dict(settings)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Replace Lightning's handler of SIGTERM, whose broadcast would wait for processes in
        another one; and forget why an extended training has stopped before.
        """
        for hook in _early(trainer):
            hook.stopping_reason = EarlyStoppingReason.NOT_STOPPED
        if trainer.world_size > 1 and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, _stop)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save."""
        if not trainer.sanity_checking:
            self._save(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Save if there is no validation, and before Lightning stops."""
        data: Any = trainer.datamodule  # pyrefly: ignore[missing-attribute]
        validates = trainer.fit_loop.epoch_loop._should_check_val_epoch() and len(data.sets["val"])
        unvalidated = trainer.is_last_batch and not validates
        if unvalidated or trainer.should_stop or trainer.received_sigterm:
            self._save(trainer)

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: TrainingState
    ) -> None:
        """Add the settings; leave out the elapsed times of timers, whose limits are those of a
        call: a resumed training would stop again at once.
        """
        checkpoint["settings"] = self.settings
        for hook in trainer.callbacks:  # pyrefly: ignore[missing-attribute]
            if isinstance(hook, Timer):
                checkpoint["callbacks"].pop(hook.state_key, None)

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: TrainingState
    ) -> None:
        """Find the files of `ModelCheckpoint` in a run folder that has moved: it would forget which
        is the best, and replace it by the next one.
        """
        for hook in trainer.callbacks:  # pyrefly: ignore[missing-attribute]
            state = checkpoint["callbacks"].get(hook.state_key)
            if isinstance(hook, ModelCheckpoint) and state and state["dirpath"]:
                moved = _moved(state, Path(state["dirpath"]), Path(hook.dirpath or self.path))
                checkpoint["callbacks"][hook.state_key] = moved

    def _save(self, trainer: L.Trainer) -> None:
        for logger in trainer.loggers:  # else values that they hold back would be lost
            logger.save()
        trainer.save_checkpoint(self.path)


def _moved(state: Any, before: Path, now: Path) -> Any:
    """The state of a callback whose paths in one folder lead into another."""
    if isinstance(state, dict):
        return {_moved(k, before, now): _moved(v, before, now) for k, v in state.items()}
    if isinstance(state, str) and Path(state).is_relative_to(before):
        return str(now / Path(state).relative_to(before))
    return state


#: Settings of a run, and within `data` and `trainer`, that a resumed training may change.
CHANGEABLE = {
    *("name", "label", "compare", "test_scene", "plugins", "device", "init_from", "resume"),
    *("logger", "workers", "cache"),
    *("max_steps", "max_epochs", "max_time", "accelerator", "devices", "num_nodes", "strategy"),
    *("log_every_n_steps",),
}
#: What a checkpoint must hold to resume from it.
NEEDED = {
    *("state_dict", "hyper_parameters", "global_step", "epoch", "pytorch-lightning_version"),
    *("loops", "callbacks", "optimizer_states", "lr_schedulers", SceneData.__qualname__),
}


def kept(settings: TrainSettings, method: str) -> dict[str, Any]:
    """The settings that determine the training of a method, by their full names; not paths, as the
    digests of their files and cases are compared.
    """
    own = {**vars(settings), "method": settings.methods().get(method)}
    plain = yaml.safe_load(yaml.safe_dump(own))  # as read from a run folder
    return {
        ".".join(map(str, keys)): value
        for keys, value in flatten(plain)
        if keys[-1] != "path"
        and not CHANGEABLE.intersection(keys[: 1 + (keys[0] in ("data", "trainer"))])
    }


def check_resumable(path: Path, checkpoint: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Check that a training can be resumed from a checkpoint.

    Args:
        path: path of the checkpoint.
        checkpoint: what is read from it.
        settings: what `kept` returns.

    Raises:
        Refused: it lacks something.
        ValueError: the training began with other settings.
    """
    if missing := sorted(NEEDED - {*checkpoint}):
        raise Refused(f"{path}: expected a training to resume, got one without {missing}")
    changed = run_folder.differences(settings, checkpoint.get("settings", settings))
    if changed:
        raise ValueError(
            f"{path} is of a training with other settings: {'; '.join(changed)}; restore them in "
            f"{SETTINGS}, or begin another run with init_from=<this one>"
        )


class AveragedWeights(EMAWeightAveraging):
    """Lightning's exponential moving average of the weights, which also stores the last averaged
    epoch, and leaves the trained weights beside the averages when the training ends.

    A checkpoint of an epoch's last step precedes the epoch's end, which a resumed Lightning skips.
    One of a finished training has the averages as its weights, like any other, and the trained ones
    beside them, from which a training to more steps continues.
    """

    def state_dict(self) -> dict[str, Any]:
        """State for a checkpoint beside the averages."""
        return super().state_dict() | {"latest_update_epoch": self._latest_update_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Resume from a checkpoint."""
        super().load_state_dict(state_dict)
        self._latest_update_epoch = state_dict["latest_update_epoch"]

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Average the weights of an epoch whose end was interrupted."""
        last = trainer.current_epoch - 1
        if last > self._latest_update_epoch and self.should_update(epoch_idx=last):
            assert self._average_model is not None
            self._average_model.update_parameters(pl_module)
            self._latest_update_epoch = last

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Keep the trained weights, which Lightning would replace by the averages."""


class RandomStates(TypedDict):
    """Random states as plain values and tensors."""

    python: list[Any]
    numpy: list[Any]
    torch: torch.Tensor
    cuda: list[torch.Tensor]


class RandomNumbers(L.Callback):
    """Stores the global random states of Python, NumPy and torch in checkpoints, for layers that
    use them.

    Data, order and augmentation do not: they are pure functions of seed, epoch and index.
    """

    of_every_run = True

    def __init__(self) -> None:
        self._loaded: RandomStates | None = None

    def state_dict(self) -> RandomStates:
        """Return the random states."""
        version, words, gauss = random.getstate()
        kind, keys, place, has, cached = np.random.get_state(legacy=True)
        return {
            "python": [version, torch.tensor(words), gauss],
            "numpy": [
                kind,
                torch.tensor(np.asarray(keys, np.int64)),
                int(place),
                int(has),
                float(cached),
            ],
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        }

    def load_state_dict(self, state_dict: RandomStates) -> None:
        """Keep the states until training starts, as the setup may draw random numbers."""
        self._loaded = state_dict

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Restore the random states of the interrupted run."""
        if self._loaded is None:
            return
        state, self._loaded = self._loaded, None
        version, words, gauss = state["python"]
        random.setstate((version, tuple(words.tolist()), gauss))
        kind, keys, *rest = state["numpy"]
        np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))
        torch.set_rng_state(state["torch"])
        if len(state["cuda"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state["cuda"])


def complete(trainer: L.Trainer) -> bool:
    """Whether a training has ended by itself: after its number of steps or epochs, or by
    `EarlyStopping`; not if a timer or another callback has stopped it before.
    """
    steps, epochs = trainer.max_steps, trainer.max_epochs
    return (
        0 <= steps <= trainer.global_step
        or (epochs is not None and 0 <= epochs <= trainer.current_epoch)
        or any(h.stopping_reason is not EarlyStoppingReason.NOT_STOPPED for h in _early(trainer))
    )


def _early(trainer: L.Trainer) -> list[EarlyStopping]:
    return [hook for hook in trainer.callbacks if isinstance(hook, EarlyStopping)]  # pyrefly: ignore[missing-attribute]


@contextmanager
def report_checkpoint(last: Path) -> Iterator[None]:
    """Context that adds the path of the last good checkpoint to the error of an interrupted
    training, including SIGTERM and Ctrl-C. SIGTERM has Lightning's handler alone, which calls one
    from before at once, and the training would end before it writes the checkpoint of that step.

    Raises:
        SystemExit: on SIGTERM or Ctrl-C, where Lightning would exit silently or with success; its
            code is 128 plus the number of the signal, as of other commands.
    """
    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL) if main else None
    try:
        yield
    except SIGTERMException as stop:
        raise _end(signal.SIGTERM, "SIGTERM", last) from stop
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):  # Lightning ends the process itself
            raise _end(signal.SIGINT, "Ctrl-C", last) from stop
        raise
    except Exception as error:
        if last.exists() or previous(last).exists():
            error.add_note(_kept(last))
        raise
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)


def _stop(*_: Any) -> None:
    raise SIGTERMException


def _end(number: signal.Signals, name: str, last: Path) -> SystemExit:
    """The exit of a signal, which is said: a code that is a number is not."""
    stop = SystemExit(f"Stopped by {name}; {_kept(last)}")
    sys.stderr.write(f"{stop}\n")
    stop.code = 128 + number
    return stop


def _kept(last: Path) -> str:
    run = last.parents[2]
    checkpoint = next((path for path in (last, previous(last)) if path.exists()), None)
    if checkpoint is None:
        return f"there is no checkpoint yet: mvrecon-train resume={run} starts again"
    return f"the last good checkpoint is {checkpoint}: mvrecon-train resume={run} resumes it"


def extended(settings: TrainSettings, folder: Path, steps: int) -> TrainSettings:
    """Return a run's settings with more steps; writes nothing.

    Args:
        settings: settings of the run.
        folder: folder of the run.
        steps: the new `trainer.max_steps`.

    Raises:
        ValueError: fewer steps than before, a run without a number of steps, or several processes.
    """
    before = settings.trainer["max_steps"]
    if steps == before:
        return settings
    if world() > 1:
        raise ValueError(f"Expected one process to extend a training, got {world()}")
    if not 0 < before < steps:
        raise ValueError(
            f"{folder} was started with trainer.max_steps={before}; expected more, got {steps}"
        )
    return replace(settings, trainer={**settings.trainer, "max_steps": steps})


def extend_training(settings: TrainSettings, longer: TrainSettings, folder: Path) -> None:
    """Replace a run's settings by those with more steps; every method resumes from its last
    checkpoint, also of a finished training.

    The learning rate follows the schedule over all steps, so a cosine's rises again. The result
    table of the shorter training is removed. All checkpoints are read and written before anything
    is removed.

    Args:
        settings: settings of the run.
        longer: the longer run's settings, as `extended` returns them.
        folder: folder of the run.

    Raises:
        RuntimeError: another process uses the folder.
        DamagedCheckpoint: a checkpoint that cannot be read.
        OSError: no space for the checkpoints; the run stays as it was.
    """
    with claimed(folder):
        run_folder.check(folder, vars(settings))
        pairs = [(finished(folder, name), unfinished(folder, name)) for name in settings.methods()]
        ready = [(done, last) for done, last in pairs if done.exists()]
        states = [_resumable(read(done)) for done, _ in ready]
        try:
            for (_, last), state in zip(ready, states, strict=True):
                write(last, state)
        except OSError:
            for _, last in ready:  # a finished method has none
                remove(last)
            raise
        for done, _ in ready:
            done.unlink()
        (folder / RESULTS).unlink(missing_ok=True)
        # last: an interruption before leaves the run unchanged
        run_folder.start(folder, vars(longer))
    optimizer = settings.optimizer
    before, steps = (one.trainer["max_steps"] for one in (settings, longer))
    name, warmup = optimizer.get("schedule", "cosine"), optimizer.get("warmup", 0.0)
    old, new = (lr_factor(name, before, n, warmup) for n in (before, steps))
    tell(
        f"{before} steps become {steps}: the learning rate follows the schedule {name!r} over all "
        f"{steps}, at step {before} with {new:.0%} of its highest in place of {old:.0%}"
    )


def _resumable(checkpoint: TrainingState) -> TrainingState:
    """Convert a finished training's checkpoint to one inside its last epoch, if that was cut short,
    or else at the start of the next one.

    When training ends, Lightning marks an epoch as complete, but keeps its count of batches, by
    which a resumed training would skip the next epoch.
    """
    loops = checkpoint["loops"]["fit_loop"]
    progress = loops["epoch_progress"]
    if progress["current"]["processed"] < progress["current"]["ready"]:
        return checkpoint  # stopped after its last step, and ended when it was resumed
    data: Any = checkpoint.get(SceneData.__qualname__, {})
    if not data.get("seen"):
        batches = loops["epoch_loop.batch_progress"]
        none = dict.fromkeys(batches["current"], 0)
        fresh = {**batches, "current": none, "is_last_batch": False}
        fit_loop = {**loops, "epoch_loop.batch_progress": fresh}
        return {**checkpoint, "loops": {**checkpoint["loops"], "fit_loop": fit_loop}}
    for counts in (progress["total"], progress["current"]):
        for stage in ("processed", "completed"):
            counts[stage] -= 1
    return {**checkpoint, "epoch": checkpoint["epoch"] - 1}
