"""The other processes of a training on several devices: started, watched and ended here.

They are started as torchrun starts them, so that Lightning finds them there: one for each device,
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
from torch import distributed

from mvrecon.core.machine import silence_libraries, world
from mvrecon.core.registry import import_plugins
from mvrecon.training import fit, run_folder

#: Ways of Lightning to train on several devices that keep one file for each checkpoint.
STRATEGIES = ("auto", "ddp", "ddp_find_unused_parameters_true")
#: Seconds that the first process has to end by itself after another one has died.
GRACE = 60.0
#: Seconds in which a process that has died is known to be dead.
MOMENT = 1.0
LOOPBACK = "127.0.0.1"


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
            [sys.executable, "-m", "mvrecon.training.processes", str(folder)],
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
    fit.fit_all(settings, fit.build_data(settings), folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
