"""One run: its data, its methods, and the training of every method that has weights to learn."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import LearningRateMonitor, ProgressBar

from mvrecon.core.machine import world
from mvrecon.core.parts import LOGGERS
from mvrecon.core.targets import instantiate
from mvrecon.data.module import SceneData
from mvrecon.kernels.threads import in_one_order
from mvrecon.training.callbacks import Clock, Confined, StepProgress, tell
from mvrecon.training.checkpoints import (
    DurableCheckpoints,
    finished,
    previous,
    read_newest,
    remove,
    unfinished,
)
from mvrecon.training.loggers import MetricsFile, TensorBoard, is_tensorboard
from mvrecon.training.module import ReconstructionModule, Settings, methods
from mvrecon.training.resume import KeepLast, RandomNumbers, report_checkpoint
from mvrecon.training.tensorboard import TensorBoardReview
from mvrecon.training.trained import begin_from


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
    done, last = finished(folder, method), unfinished(folder, method)
    models = methods(settings)
    if done.exists():
        return tell(f"{method}: its training has ended already, in {done}")
    L.seed_everything(settings["seed"], workers=True, verbose=False)
    module = build_module(settings, models[method], data.data_range)
    if not trainable(module):
        return
    begun = last.exists() or previous(last).exists()
    weights = settings.get("init_from")
    if weights and not begun and method == next(iter(models)):
        begin_from(weights, module)
        tell(f"{method}: beginning with the weights of {weights}")
    L.seed_everything(
        settings["seed"], workers=True, verbose=False
    )  # initial weights have used up random numbers
    trainer = build_trainer(settings, folder, method)
    step = read_newest(last)["global_step"] if begun else 0
    if begun:
        tell(f"{method}: going on from step {step} of {settings['trainer']['max_steps']}")
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoard | MetricsFile):
            logger.rewind(step)
    with in_one_order(settings["trainer"].get("deterministic", False)), report_checkpoint(last):
        trainer.fit(
            module, datamodule=data, ckpt_path=str(last) if begun else None, weights_only=True
        )
        trainer.save_checkpoint(done)
    if trainer.is_global_zero:
        remove(last)


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
    board, last = folder if main else folder / method, unfinished(folder, method)
    board.mkdir(parents=True, exist_ok=True)
    callbacks: list[Any] = [
        instantiate(node, board) for node in (settings["callbacks"] or {}).values() if node
    ]
    for callback in callbacks:
        if isinstance(callback, StepProgress | TensorBoardReview):
            callback.label = method
    callbacks += [Confined(folder), Clock(), RandomNumbers(), KeepLast(last)]
    events = folder / method  # TensorBoard calls a run by its folder
    loggers = [
        instantiate(node, board, LOGGERS, save_dir=str(events if is_tensorboard(node) else board))
        for node in (settings["logger"] or {}).values()
        if node
    ]
    callbacks += [LearningRateMonitor("step")] if loggers else []  # it refuses to be without
    options = {
        "enable_progress_bar": any(isinstance(c, ProgressBar) for c in callbacks),
        **settings["trainer"],
    }
    fixed = {"callbacks": callbacks, "logger": loggers, "default_root_dir": board}
    plugins: list[Any] = [DurableCheckpoints(folder)]
    if world() > 1 and options.get("strategy", "auto") == "auto":
        options["strategy"] = "ddp"
    if "LOCAL_RANK" in os.environ and "TORCHELASTIC_RUN_ID" not in os.environ:
        plugins.append(Environment())  # or SLURM's, in whose job the processes may be
    # `SceneData` shares the cases among the processes: each exactly once
    return L.Trainer(**options, **fixed, plugins=plugins, use_distributed_sampler=False)
