"""One run: its data, its methods, the training of every method that has weights to learn, and the
other processes of a training on several devices.

These are started as torchrun starts them, so that Lightning finds them there: one for each device,
its number in the environment. The first process is the one that the user has started; it alone
holds the lock of the run folder and makes the result table. The others read their settings from the
run folder.
"""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import LearningRateMonitor, ProgressBar
from torch import distributed

from mvrecon.core.machine import silence_libraries, world
from mvrecon.core.parts import LOGGERS
from mvrecon.core.registry import import_plugins
from mvrecon.data.module import SceneData
from mvrecon.kernels.threads import in_one_order
from mvrecon.training import callbacks, checkpoints, run_folder
from mvrecon.training.module import ReconstructionModule, Settings, methods
from mvrecon.training.resume import KeepLast, RandomNumbers, report_checkpoint
from mvrecon.training.targets import instantiate
from mvrecon.training.tensorboard import TensorBoardReview
from mvrecon.training.trained import begin_from

#: Ways of Lightning to train on several devices that keep one file for each checkpoint.
STRATEGIES = ("auto", "ddp", "ddp_find_unused_parameters_true")
#: Seconds that the first process has to end by itself after another one has died.
GRACE = 60.0
#: Seconds in which a process that has died is known to be dead.
MOMENT = 1.0
LOOPBACK = "127.0.0.1"


def build_data(settings: Settings) -> SceneData:
    """The training, validation and test scenes of a run.

    Raises:
        TypeError: a test scene that is a bare word, as from `test_scene=<name>` on a command line.
    """
    scenes = {"train": settings["scene"], "test": settings["test_scene"] or settings["scene"]}
    if isinstance(scenes["test"], str):
        raise TypeError(
            f"test_scene holds a scene's settings; choose a file by "
            f"scene@test_scene={scenes['test']}"
        )
    keys = ("grid", "camera", "projector", "acquisition")
    measurement = {key: settings[key] for key in keys}
    return SceneData(scenes, measurement, seed=settings["seed"], **settings["data"])


def build_module(settings: Settings, method: Settings, data_range: float) -> ReconstructionModule:
    """A method of a run, with fresh weights.

    Its key `assume` has options of the projector that are this method's alone: what it takes the
    measurement for.

    Raises:
        TypeError: an assumption that is no mapping.
    """
    geometry = {key: settings[key] for key in ("grid", "camera", "projector")}
    method = dict(method)
    if not isinstance(assumed := method.pop("assume", None) or {}, Mapping):
        raise TypeError(f"Expected options of the projector for assume, got {assumed!r}")
    geometry["projector"] = {**geometry["projector"], **assumed}
    if rigs := settings["data"].get("rigs", 0):
        geometry["rigs"] = rigs
    return ReconstructionModule(
        geometry, method, settings["loss"], settings["optimizer"], data_range
    )


def trainable(module: L.LightningModule) -> bool:
    """Whether a method has weights to learn."""
    return any(p.requires_grad and p.numel() for p in module.parameters())


def fit_all(settings: Settings, data: SceneData, folder: Path) -> None:
    """Train every method of a run, one after the other; see `fit`."""
    for method in methods(settings):
        fit(method, settings, data, folder)


def fit(method: str, settings: Settings, data: SceneData, folder: Path) -> None:
    """Train one method of a run and write `checkpoints/<method>.ckpt`; do nothing if that file
    exists or the method has no weights to learn.

    Goes on from the method's last checkpoint where there is one, and on the CPU ends with the same
    bits as a run that never broke off on as many threads; with `trainer.deterministic`, on any
    number. Every method starts from the same seed and sees the same scenes in the same order; the
    main one with the weights of `init_from`, a run or a file, where that is given.

    Raises:
        FloatingPointError: a loss that is not finite.
        ValueError: weights of `init_from` that are not this method's.
        DamagedCheckpoint: neither the last checkpoint nor the one before it can be read.
        SystemExit: SIGTERM came; the checkpoint of that step is written.
    """
    done, last = checkpoints.finished(folder, method), checkpoints.unfinished(folder, method)
    models = methods(settings)
    if done.exists():
        return callbacks.tell(f"{method}: its training has ended already, in {done}")
    L.seed_everything(settings["seed"], workers=True, verbose=False)
    module = build_module(settings, models[method], data.data_range)
    if not trainable(module):
        return
    begun = last.exists() or checkpoints.previous(last).exists()
    weights = settings.get("init_from")
    if weights and not begun and method == next(iter(models)):
        begin_from(weights, module)
        callbacks.tell(f"{method}: beginning with the weights of {weights}")
    L.seed_everything(
        settings["seed"], workers=True, verbose=False
    )  # initial weights have used up random numbers
    trainer = build_trainer(settings, folder, method)
    step = checkpoints.read_newest(last)["global_step"] if begun else 0
    if begun:
        callbacks.tell(f"{method}: going on from step {step} of {settings['trainer']['max_steps']}")
    for logger in trainer.loggers:
        if isinstance(logger, callbacks.TensorBoard | callbacks.MetricsFile):
            logger.rewind(step)
    with in_one_order(settings["trainer"].get("deterministic", False)), report_checkpoint(last):
        trainer.fit(
            module, datamodule=data, ckpt_path=str(last) if begun else None, weights_only=True
        )
        trainer.save_checkpoint(done)
    if trainer.is_global_zero:
        checkpoints.remove(last)


class Environment(LightningEnvironment):
    """What Lightning knows of the processes, which train several methods one after the other."""

    def teardown(self) -> None:
        """Keep the environment for the next method, which Lightning's own would clear."""


def build_trainer(settings: Settings, folder: Path, method: str) -> L.Trainer:
    """Lightning's trainer of a method: logs and pictures of the main one flat in the run folder,
    those of the others in `<folder>/<method>`, the board's events of all there; its last checkpoint
    at every validation.

    Raises:
        PermissionError: a callback or a logger that would write outside that folder.
    """
    main = method == next(iter(methods(settings)))
    board, last = folder if main else folder / method, checkpoints.unfinished(folder, method)
    board.mkdir(parents=True, exist_ok=True)
    hooks: list[Any] = [
        instantiate(node, board) for node in (settings["callbacks"] or {}).values() if node
    ]
    for hook in hooks:
        if isinstance(hook, callbacks.StepProgress | TensorBoardReview):
            hook.label = method
    hooks += [callbacks.Confined(folder), callbacks.Clock(), RandomNumbers(), KeepLast(last)]
    events = folder / method  # TensorBoard calls a run by its folder
    loggers = [
        instantiate(
            node, board, LOGGERS, save_dir=str(events if callbacks.is_tensorboard(node) else board)
        )
        for node in (settings["logger"] or {}).values()
        if node
    ]
    hooks += [LearningRateMonitor("step")] if loggers else []  # it refuses to be without
    options = {
        "enable_progress_bar": any(isinstance(hook, ProgressBar) for hook in hooks),
        **settings["trainer"],
    }
    fixed = {"callbacks": hooks, "logger": loggers, "default_root_dir": board}
    plugins: list[Any] = [checkpoints.DurableCheckpoints(folder)]
    if world() > 1 and options.get("strategy", "auto") == "auto":
        options["strategy"] = "ddp"
    if "LOCAL_RANK" in os.environ and "TORCHELASTIC_RUN_ID" not in os.environ:
        plugins.append(Environment())  # or SLURM's, in whose job the processes may be
    # `SceneData` shares the cases among the processes: each exactly once
    return L.Trainer(**options, **fixed, plugins=plugins, use_distributed_sampler=False)


@contextmanager
def started(folder: Path, trainer: Mapping[str, Any]) -> Iterator[None]:
    """Context in which the other processes of a run train beside this one; without effect for one
    device, and where a launcher such as torchrun has started them already.

    Args:
        folder: the run folder, with the settings in it.
        trainer: the settings `trainer`.

    Raises:
        ValueError: a strategy that is not one of `STRATEGIES`, or several machines without a
            launcher.
        RuntimeError: another process has failed.
    """
    count = 1 if world() > 1 else devices(trainer)
    if count == 1:
        yield
        return
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = str(probe.getsockname()[1])  # a free one
    shared = {"MASTER_ADDR": LOOPBACK, "MASTER_PORT": port, "WORLD_SIZE": str(count)}
    shared["OMP_NUM_THREADS"] = str(max(1, torch.get_num_threads() // count))
    environments = [shared | {"RANK": str(r), "LOCAL_RANK": str(r)} for r in range(count)]
    paths = {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    others = [
        subprocess.Popen(
            [sys.executable, "-m", "mvrecon.training.fit", str(folder)],
            env={**os.environ, **environment, **paths},
            stdin=subprocess.PIPE,  # each ends when its standard input does, that is, with this one
        )
        for environment in environments[1:]
    ]
    ended = threading.Event()
    for other in others:
        threading.Thread(target=_watch, args=(other, ended), daemon=True).start()
    try:
        with _environment(environments[0]), lost(others):
            yield
        _leave()
        failed = []
        for r, other in enumerate(others, 1):
            with suppress(subprocess.TimeoutExpired):  # it does not come to its end: no failure
                failed += [r] if other.wait(GRACE) else []
        if failed:
            raise RuntimeError(f"Processes {failed} of {count} have failed; see their errors")
    finally:
        ended.set()
        for other in others:
            other.kill()
            other.wait()
        _leave()


@contextmanager
def lost(others: Sequence[subprocess.Popen[bytes]]) -> Iterator[None]:
    """Context in which the error of a connection that was lost says which other process has ended,
    and how.

    Raises:
        RuntimeError: in place of the connection's; its notes stay.
    """
    try:
        yield
    except RuntimeError as error:
        for other in others:
            with suppress(subprocess.TimeoutExpired):
                other.wait(MOMENT)
        ends = [
            f"process {rank} (exit status {other.returncode})"
            for rank, other in enumerate(others, 1)
            if other.poll()
        ]
        if not ends:
            raise
        failure = RuntimeError(f"Before its end the training lost {', '.join(ends)}")
        for note in getattr(error, "__notes__", ()):
            failure.add_note(note)
        raise failure from error


def devices(trainer: Mapping[str, Any]) -> int:
    """Number of devices of this machine that the settings ask for.

    Raises:
        ValueError: as `started`.
    """
    strategy = trainer.get("strategy", "auto")
    if strategy not in STRATEGIES:
        raise ValueError(f"Expected trainer.strategy as one of {STRATEGIES}, got {strategy!r}")
    if world() == 1 and trainer.get("num_nodes", 1) > 1:
        raise ValueError(
            f"Got trainer.num_nodes={trainer['num_nodes']} in a single process; expected one "
            f"process for each device, started by torchrun or srun"
        )
    options = {key: trainer[key] for key in ("accelerator", "devices") if key in trainer}
    return L.Trainer(**options, logger=False, enable_checkpointing=False).num_devices


def _leave() -> None:
    if distributed.is_initialized():
        distributed.destroy_process_group()


def _watch(other: subprocess.Popen[bytes], ended: threading.Event) -> None:
    """End this process some time after another one has died: it may wait for that one for ever."""
    if other.wait() and not ended.wait(GRACE):
        os.write(2, b"Another process of the run has died; resume=<run folder> goes on\n")
        os._exit(1)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Context with variables of the environment, and this process's threads, as the others have
    them.
    """
    before, threads = {name: os.environ.get(name) for name in values}, torch.get_num_threads()
    os.environ.update(values)
    torch.set_num_threads(int(values["OMP_NUM_THREADS"]))
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def main(folder: Path) -> None:
    """Train every method of a run beside its first process, and end when that one does."""

    def end_with_the_first() -> None:
        os.read(0, 1)  # the standard input ends when the first process does, however that ends
        os._exit(1)

    threading.Thread(target=end_with_the_first, daemon=True).start()
    silence_libraries()
    settings = run_folder.read_settings(folder)
    import_plugins(settings["plugins"])
    fit_all(settings, build_data(settings), folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
