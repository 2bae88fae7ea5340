"""A small training that is killed, and begun again; a checkpoint whose writing is killed; a disk that is full.

All in a process without threads, whose children are forked; not from within an app of Hydra's.
"""

import errno
import os
import signal
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mvrecon.config import compose
from mvrecon.engine import fit, storage
from mvrecon.engine.checkpoints import finished, unfinished
from mvrecon.engine.module import ReconstructionModule
from mvrecon.testing.trouble import counted, different, raising, signalled

METHOD = "geometry_free"
#: Five steps an epoch, a checkpoint every two.
OPTIONS = (
    *("model=geometry_free", "model.width=4", "grid.shape=[8,8,8]", "grid.spacing=16.0", "camera.views=2"),
    *("camera.detector.pixels=[8,8]", "camera.detector.pixel_mm=32.0", "projector.backend=reference"),
    *("data.batch_size=1", "data.sizes={train: 5, val: 1, test: 1}", "data.workers=0", "callbacks=quiet"),
    *("~logger", "trainer.accelerator=cpu", "trainer.max_steps=7", "trainer.val_check_interval=2"),
)
KILLED = -signal.SIGKILL if os.name == "posix" else 0


def survival(folder: Path) -> dict[str, dict[str, str]]:
    """What went wrong in each of the three; empty: nothing."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    return {"saving": saving(folder), "training": training(folder), "disk": disk(folder)}


def child(task: Callable[[], object]) -> int:
    """How a forked process ended that did something: 0, 1 where it raised, or minus the signal."""
    process = os.fork()
    if process:
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    code = 1
    try:
        task()
        code = 0
    finally:
        os._exit(code)


def saving(folder: Path) -> dict[str, str]:
    """Killed at each flush and rename of a checkpoint's writing: the one before, or the new one, is read."""
    wrong, path = {}, folder / "saving" / "last.ckpt"
    for step in (0, 1):
        storage.write(path, _state(step))
    for k, (name, n) in enumerate([("fsync", 1), ("fsync", 2), ("replace", 1), ("replace", 2)], start=2):

        def write(name: str = name, n: int = n, k: int = k) -> None:
            counted(os, name, n, signalled(signal.SIGKILL))
            storage.write(path, _state(k))

        before, code = storage.read_newest(path)["global_step"], child(write)
        after = storage.read_newest(path)["global_step"]
        wrong[f"{name} {n}"] = "" if code == KILLED and after in (before, k) else f"exit {code}, {before} -> {after}"
        storage.write(path, _state(k))
    return wrong


def training(folder: Path) -> dict[str, str]:
    """Killed in the fifth step and begun again: the same bits as without, but for how long it took."""
    settings = compose(*OPTIONS)
    data = fit.build_data(settings)

    def run(name: str) -> None:
        fit.fit(METHOD, settings, data, folder / name)

    def killed() -> None:
        counted(ReconstructionModule, "training_step", 5, signalled(signal.SIGKILL))
        run("killed")

    codes = [child(lambda: run("whole")), child(killed)]
    begun = unfinished(folder / "killed", METHOD).exists()
    codes.append(child(lambda: run("killed")))
    if codes != [0, KILLED, 0] or not begun:
        return {"the lives": f"ended with {codes}, expected 0, {KILLED} and 0; a checkpoint: {begun}"}
    whole, again = (storage.read(finished(folder / name, METHOD)) for name in ("whole", "killed"))
    for state in (whole, again):
        del state["callbacks"]["Clock"]
    places = different(whole, again)
    return {"the bits": f"{len(places)} differ: {places[:3]}" if places else ""}


def disk(folder: Path) -> dict[str, str]:
    """A full disk, and a folder that is none: the error is raised, and the last checkpoint stays."""
    wrong, path = {}, folder / "disk" / "last.ckpt"
    storage.write(path, _state(1))

    def full() -> None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # the kernel then says that the file is too large
        resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500))
        storage.write(path, _state(2))

    def no_space() -> None:
        counted(os, "fsync", 1, raising(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
        storage.write(path, _state(2))

    def no_folder() -> None:
        storage.write(path / "below.ckpt", _state(2))

    for name, task in {"too large": full, "no space": no_space, "no folder": no_folder}.items():
        code, step = child(task), storage.read_newest(path)["global_step"]
        left = [file.name for file in path.parent.iterdir() if file.name != path.name]
        wrong[name] = "" if (code, step, left) == (1, 1, []) else f"exit {code}, step {step}, {left} left"
    return wrong


def _state(step: int) -> dict[str, Any]:
    return {"global_step": step, "state_dict": {"w": torch.full((64,), float(step))}}
