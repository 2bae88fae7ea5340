"""One run: its data, its methods, the training of every method with trainable weights, and the
worker processes of distributed training.

Workers are started as by torchrun, which Lightning detects: one for each device, its rank in the
environment. The first process is the user's; it alone holds the lock of the run folder and writes
the result table. The others read their settings from the run folder.
"""

import inspect
import os
import socket
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, TypedDict

import lightning.pytorch as L
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import LearningRateMonitor, ProgressBar
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch import distributed

from mvrecon.core.machine import silence_libraries, world
from mvrecon.core.parts import LOGGERS, METRICS, Options
from mvrecon.core.quantities import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from mvrecon.core.registry import import_plugins
from mvrecon.data.dataset import Batch, single_cases
from mvrecon.data.module import SceneData
from mvrecon.kernels.threads import in_one_order
from mvrecon.methods.method import Solver
from mvrecon.training import callbacks, checkpoints, run_folder
from mvrecon.training.loop import WholeSteps, optimizer_steps
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.resume import (
    KeepLast,
    RandomNumbers,
    check_resumable,
    complete,
    kept,
    report_checkpoint,
)
from mvrecon.training.settings import TrainSettings
from mvrecon.training.targets import instantiate
from mvrecon.training.tensorboard import TensorBoardReview
from mvrecon.training.trained import begin_from, check_trained

#: Lightning's distributed strategies that keep a single checkpoint file.
STRATEGIES = ("auto", "ddp", "ddp_find_unused_parameters_true")
#: Precisions on a CPU. In bfloat16, oneDNN's derivatives in the weights of convolutions other than
#: those of `unet`, as of 3x3 pixels with strides of 2, read memory that nothing has written.
FULL_PRECISIONS = ("32-true", "64-true")
#: Seconds for the first process to end after another one has died.
GRACE_SECONDS = 60.0
#: Seconds after which a dead process has been reaped.
REAP_SECONDS = 1.0
LOOPBACK = "127.0.0.1"


class TrainerOptions(TypedDict, total=False):
    """Options of Lightning's Trainer that mvrecon interprets, with their ranges, and those that it
    gives itself.

    Args:
        callbacks: those of the setting callbacks.
        logger: those of the setting logger.
        plugins: mvrecon's own plugins of Lightning.
        default_root_dir: the folder of the run.
        use_distributed_sampler: never, as the cases are shared among the processes already.
    """

    callbacks: None
    logger: None
    plugins: None
    default_root_dir: None
    use_distributed_sampler: None

    max_steps: PositiveInt | Literal[-1]
    max_epochs: PositiveInt | Literal[-1]
    num_nodes: PositiveInt
    devices: PositiveInt | Literal[-1] | str | Sequence[NonNegativeInt]
    accumulate_grad_batches: PositiveInt
    check_val_every_n_epoch: PositiveInt | None
    gradient_clip_val: NonNegativeFloat | None
    val_check_interval: PositiveInt | PositiveFloat | None
    log_every_n_steps: NonNegativeInt


class Assumptions(TypedDict, total=False):
    """Settings of a method beside its own options.

    Args:
        assume: options of the projector for this method only.
    """

    assume: Mapping[str, Any] | None


def build_data(settings: TrainSettings) -> SceneData:
    """Build the training, validation and test scenes of a run.

    Raises:
        ValueError: no test cases for the result table.
    """
    if settings.data["sizes"].get("test") == 0:
        raise ValueError("Expected data.sizes.test of at least 1 for the result table, got 0")
    scenes = {"train": settings.scene, "test": settings.test_scene or settings.scene}
    keys = ("grid", "camera", "projector", "acquisition")
    measurement = {key: getattr(settings, key) for key in keys}
    return SceneData(scenes, measurement, seed=settings.seed, **settings.data)


def build_module(
    settings: TrainSettings, method: Options, data_range: float
) -> ReconstructionModule:
    """Build a method of a run with initial weights.

    Its key `assume` holds options of the projector for this method only: its assumptions on the
    measurement.
    """
    geometry = {key: getattr(settings, key) for key in ("grid", "camera", "projector")}
    own = {key: value for key, value in method.items() if key != "assume"}
    geometry["projector"] = {**geometry["projector"], **(method.get("assume") or {})}
    if rigs := settings.data.get("rigs", 0):
        geometry["rigs"] = rigs
    return ReconstructionModule(geometry, own, settings.loss, settings.optimizer, data_range)


def trainable(module: L.LightningModule) -> bool:
    """Whether a method has trainable weights."""
    return any(p.requires_grad and p.numel() for p in module.parameters())


def check(settings: TrainSettings, data: SceneData, folder: Path, again: bool = False) -> None:
    """Build all parts of a run, compute its cases, and read the weights and checkpoints that it
    needs, before anything is written.

    With several devices each process computes its own training cases, later.

    Args:
        settings: settings of the run.
        data: what `build_data` returns.
        folder: folder of the run.
        again: whether finished methods are trained further.

    Raises:
        LookupError, TypeError, ImportError: a part that is missing, or a wrong option.
        ValueError: what the parts raise.
        FileNotFoundError, Refused: weights or data that cannot be read, or a checkpoint that lacks
            what a training resumes from.
    """
    for name in METRICS.names():
        METRICS.get(name)
    check_trained(settings.methods().values())
    training, without_weights = False, {}
    for number, (method, model) in enumerate(settings.methods().items()):
        module = build_module(settings, model, data.data_range)
        if not trainable(module):
            without_weights[method] = module
            continue
        done, last = checkpoints.finished(folder, method), checkpoints.unfinished(folder, method)
        state, begun = None, last.exists() or checkpoints.previous(last).exists()
        if done.exists() or begun:
            state = checkpoints.read(done) if done.exists() else checkpoints.read_newest(last)
        elif number == 0 and settings.init_from:
            begin_from(settings.init_from, module)
        further = again or not done.exists()
        if state is not None and further:
            path = done if done.exists() else last
            check_resumable(path, state, kept(settings, method))
        training |= further
        module.build_optimizer()
        build_trainer(settings, folder, method)
    if training and world() == 1 and devices(settings.trainer) == 1:
        data.setup("fit")
    data.setup("test")
    (case, *_) = single_cases(next(iter(data.test_dataloader())))
    for method, module in without_weights.items():
        try:
            _tried(module, case)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{method}: {error}") from error


@torch.no_grad()
def _tried(module: ReconstructionModule, case: Batch) -> None:
    """Reconstruct a case by a method without weights, in one iteration where the method takes
    their number.
    """
    method = module.method
    if isinstance(method, Solver) and "iterations" in inspect.signature(method.solve).parameters:
        method = Solver(method.solve, {**method.options, "iterations": 1})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the evaluation gives them
        method(case["views"], module.operator(case))


def fit_all(settings: TrainSettings, data: SceneData, folder: Path) -> None:
    """Train every method of a run, one after the other; see `fit`."""
    for method in settings.methods():
        fit(method, settings, data, folder)


def fit(method: str, settings: TrainSettings, data: SceneData, folder: Path) -> None:
    """Train one method of a run and write `checkpoints/<method>.ckpt`; skipped if that file exists
    or the method has no trainable weights.

    Resumes from the method's last checkpoint, if any; on the CPU the result is then bitwise that of
    an uninterrupted run with as many threads, or with `trainer.deterministic` with any number.
    Every method starts from the same seed and gets the same scenes in the same order; the main one
    starts with the weights of `init_from`, a run or a file, if given.

    Raises:
        FloatingPointError: a loss that is not finite.
        InterruptedError: stopped before its end, as by `trainer.max_time`; a resumed training gets
            as much time again.
        ValueError: weights of `init_from` of another method.
        DamagedCheckpoint: neither the last checkpoint nor the one before it can be read.
        SystemExit: on SIGTERM, after the checkpoint of that step is written.
    """
    done, last = checkpoints.finished(folder, method), checkpoints.unfinished(folder, method)
    models = settings.methods()
    if done.exists():
        return callbacks.tell(f"{method}: training has finished already, see {done}")
    L.seed_everything(settings.seed, workers=True, verbose=False)
    module = build_module(settings, models[method], data.data_range)
    if not trainable(module):
        return
    begun = last.exists() or checkpoints.previous(last).exists()
    weights = settings.init_from
    if weights and not begun and method == next(iter(models)):
        begin_from(weights, module)
        callbacks.tell(f"{method}: starting with the weights of {weights}")
    # building the weights has consumed random numbers
    L.seed_everything(settings.seed, workers=True, verbose=False)
    trainer = build_trainer(settings, folder, method)
    logs_of(settings, folder, method).mkdir(parents=True, exist_ok=True)
    step = checkpoints.read_newest(last)["global_step"] if begun else 0
    if begun:
        steps = settings.trainer["max_steps"]
        callbacks.tell(f"{method}: resuming at step {step}" + f" of {steps}" * (steps > 0))
    for logger in trainer.loggers:
        if isinstance(logger, callbacks.TensorBoard | callbacks.MetricsFile):
            logger.rewind(step)
    in_order = in_one_order(settings.trainer.get("deterministic", False))
    with in_order, report_checkpoint(last), misconfigured():
        trainer.fit(
            module, datamodule=data, ckpt_path=str(last) if begun else None, weights_only=True
        )
        if not complete(trainer):
            raise InterruptedError(
                f"The training of {method} has stopped after {trainer.global_step} of "
                f"{optimizer_steps(trainer):.0f} steps"
            )
        trainer.save_checkpoint(done)
    if trainer.is_global_zero:
        checkpoints.remove(last)


class Environment(LightningEnvironment):
    """Lightning's process environment, kept while several methods are trained in turn."""

    def teardown(self) -> None:
        """Keep the environment for the next method; Lightning's own clears it."""


def logs_of(settings: TrainSettings, folder: Path, method: str) -> Path:
    """The folder of a method's logs: of the main one the run folder, of others one in it."""
    return folder if method == next(iter(settings.methods())) else folder / method


@contextmanager
def misconfigured() -> Iterator[None]:
    """Context in which what Lightning refuses in trainer, callbacks or logger is an error of the
    settings.

    Raises:
        ValueError: in place of Lightning's own.
    """
    try:
        yield
    except MisconfigurationException as error:
        raise ValueError(f"trainer, callbacks or logger: {error}") from error


@misconfigured()
def build_trainer(settings: TrainSettings, folder: Path, method: str) -> L.Trainer:
    """Build Lightning's trainer of a method: logs and pictures of the main method go to the run
    folder, others' to `<folder>/<method>`, TensorBoard's events always there; the last checkpoint
    is written at every validation.

    Raises:
        PermissionError: a callback or a logger that would write outside that folder.
        ValueError: half precision on a CPU; options that Lightning refuses.
    """
    logs, last = logs_of(settings, folder, method), checkpoints.unfinished(folder, method)
    hooks: list[Any] = [
        instantiate(node, logs) for node in (settings.callbacks or {}).values() if node
    ]
    for hook in hooks:
        if isinstance(hook, callbacks.StepProgress | TensorBoardReview):
            hook.label = method
    hooks += [
        callbacks.Confined(folder),
        callbacks.Clock(),
        RandomNumbers(),
        KeepLast(last, kept(settings, method)),
    ]
    events = folder / method  # TensorBoard names a run by its folder
    loggers = [
        instantiate(
            node, logs, LOGGERS, save_dir=str(events if callbacks.is_tensorboard(node) else logs)
        )
        for node in (settings.logger or {}).values()
        if node
    ]
    hooks += [LearningRateMonitor("step")] if loggers else []  # raises without loggers
    options: dict[str, Any] = {
        "enable_progress_bar": any(isinstance(hook, ProgressBar) for hook in hooks),
        **settings.trainer,
    }
    every, steps = options.get("val_check_interval"), options.get("max_steps", -1)
    if isinstance(every, int) and steps > 0:  # a short run has one validation and its pictures
        batches = steps * options.get("accumulate_grad_batches", 1)
        options["val_check_interval"] = min(every, batches)
    plugins: list[Any] = [checkpoints.DurableCheckpoints(folder)]
    if world() > 1 and options.get("strategy", "auto") == "auto":
        options["strategy"] = "ddp"
    if "LOCAL_RANK" in os.environ and "TORCHELASTIC_RUN_ID" not in os.environ:
        plugins.append(Environment())  # or SLURM's, if the processes are in its job
    options |= {"callbacks": hooks, "logger": loggers, "plugins": plugins}
    options |= {"default_root_dir": logs, "use_distributed_sampler": False}
    trainer = L.Trainer(**options)
    if trainer.strategy.root_device.type == "cpu" and trainer.precision not in FULL_PRECISIONS:
        raise ValueError(
            f"Got trainer.precision={trainer.precision} on a CPU, where the gradients of some "
            f"convolutions in half precision are arbitrary; expected one of {FULL_PRECISIONS}, or "
            f"a GPU. method.precision=auto uses bfloat16 where it is right"
        )
    trainer.fit_loop.epoch_loop = WholeSteps(trainer, trainer.min_steps, trainer.max_steps)
    return trainer


@contextmanager
def started(folder: Path, trainer: Mapping[str, Any]) -> Iterator[None]:
    """Context in which the worker processes of a run train beside this one; no-op for one device,
    or if a launcher such as torchrun has started them.

    Args:
        folder: the run folder, with the settings in it.
        trainer: the settings `trainer`.

    Raises:
        ValueError: a strategy not in `STRATEGIES`, or several machines without a launcher.
        RuntimeError: a worker has failed.
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
            stdin=subprocess.PIPE,  # closes with this process, which ends the worker
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
            with suppress(subprocess.TimeoutExpired):  # still running: no failure
                failed += [r] if other.wait(GRACE_SECONDS) else []
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
    """Context that explains the error of a lost connection by the process that ended.

    Raises:
        RuntimeError: instead of the connection's error, with its notes.
    """
    try:
        yield
    except RuntimeError as error:
        for other in others:
            with suppress(subprocess.TimeoutExpired):
                other.wait(REAP_SECONDS)
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
    """Number of devices of this machine in the settings.

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
    """Kill this process some time after another one has died, for which it may wait forever."""
    if other.wait() and not ended.wait(GRACE_SECONDS):
        os.write(2, b"Another process of the run has died; continue by resume=<run folder>\n")
        os._exit(1)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Context with environment variables, and this process's number of threads set as the
    workers'.
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
    """Train every method of a run beside its first process, and end with it."""

    def end_with_the_first() -> None:
        os.read(0, 1)  # standard input closes when the first process ends, for whatever reason
        os._exit(1)

    threading.Thread(target=end_with_the_first, daemon=True).start()
    silence_libraries()
    settings = run_folder.read_settings(folder)
    import_plugins(settings.plugins)
    fit_all(settings, build_data(settings), folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
