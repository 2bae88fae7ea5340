"""Lives of one training: each forked from a process without threads, broken off in one way, and
begun again.

`python -m tests.training.lives PLAN.json` runs a plan's lives and prints, one line of JSON each,
how they ended. A plan holds `options` (the command line of mvrecon-train) and `runs` (folder ->
what befalls each life; a last one follows that nothing befalls). `python -m tests.training.lives
COUNT SEED` kills COUNT times at random and compares the weights.
"""

import errno
import json
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.faults.fault_injection import counted, different, raising, signalled

METHOD, STEPS = "geometry_free", 14
#: A run of a second: five steps an epoch, a checkpoint every three, averaged weights, a falling
#: rate.
OPTIONS = (
    "method=geometry_free",
    "callbacks=ema",
    "logger=csv",
    "~callbacks.progress",
    "~callbacks.board",
    "method.widths=[4,8]",
    "method.precision=float32",
    "grid.size=[8,8,8]",
    "grid.spacing=16.0",
    "camera.n_views=3",
    "camera.detector.pixels=[12,12]",
    "camera.detector.pixel_mm=22.0",
    "data.batch_size=2",
    "data.sizes={train: 10, val: 2, test: 1}",
    "projector.backend=reference",
    "trainer.accelerator=cpu",
    f"trainer.max_steps={STEPS}",
    "trainer.val_check_interval=3",
)


def play(
    folder: Path, runs: dict[str, list[dict[str, Any]]], *options: str
) -> dict[str, list[dict[str, Any]]]:
    """Run lives in a process of their own; how each life of each run ended, with what it said."""
    plan = folder / "plan.json"
    plan.write_text(
        json.dumps(
            {"options": [*OPTIONS, *options], "runs": {str(folder / k): v for k, v in runs.items()}}
        )
    )
    root = Path(__file__).parents[2]
    command = [sys.executable, "-m", "tests.training.lives", str(plan)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    ended: dict[str, list[dict[str, Any]]] = {name: [] for name in runs}
    for line in filter(lambda line: line.startswith('{"run"'), done.stdout.splitlines()):
        life = json.loads(line)
        ended[life["run"]].append(life)
    return ended


def state(folder: Path) -> dict[str, Any]:
    """Everything that the finished training left, but for how long it took."""
    from mvrecon.training.checkpoints import finished, read

    found = read(finished(folder, METHOD))
    del found["callbacks"]["Clock"]
    return found


def befall(what: str, n: int) -> None:
    """Arrange for what shall happen in this process."""
    import torch

    from mvrecon.data.dataset import SceneDataset
    from mvrecon.training.module import ReconstructionModule

    kill = signalled(signal.SIGKILL)
    places = {
        "step": (ReconstructionModule, "training_step", kill),
        "stepped": (torch.optim.AdamW, "step", kill),
        "validation": (ReconstructionModule, "validation_step", kill),
        "sync": (os, "fsync", kill),
        "rename": (os, "replace", kill),
        "term": (ReconstructionModule, "training_step", signalled(signal.SIGTERM)),
        "hang up": (ReconstructionModule, "training_step", signalled(signal.SIGHUP)),
        "term of a job": (ReconstructionModule, "training_step", end_of_job),
        "term in validation": (ReconstructionModule, "validation_step", signalled(signal.SIGTERM)),
        "no space": (os, "fsync", raising(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))),
        "no memory": (
            ReconstructionModule,
            "training_step",
            raising(MemoryError("no memory left")),
        ),
        "no memory to save": (torch, "save", raising(MemoryError("no memory left"))),
        "dead worker": (SceneDataset, "__getitem__", lambda: os._exit(3)),
    }
    if what in places:
        owner, name, happens = places[what]
        return counted(owner, name, n, happens)
    if what in (
        "byte",
        "full",
    ):  # no file may grow beyond n bytes: the kernel kills, or says that it is so
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL if what == "byte" else signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        return resource.setrlimit(resource.RLIMIT_FSIZE, (n, n))
    if what == "nan":
        return spoiled(ReconstructionModule, n)
    if what == "read-only":
        if os.geteuid() == 0:  # whom no permission holds
            os.setresgid(65534, 65534, 65534)
            os.setresuid(65534, 65534, 65534)
        return None
    raise LookupError(what)


def end_of_job() -> None:
    """SIGTERM to this process and its workers, as from a scheduler."""
    for process in [*multiprocessing.active_children(), multiprocessing.current_process()]:
        os.kill(process.pid or os.getpid(), signal.SIGTERM)


def spoiled(module: Any, n: int) -> None:
    """Make the gradient of the n-th step nan, though its loss is finite."""
    step, calls = module.training_step, []

    def called(self, batch, batch_idx):
        loss = step(self, batch, batch_idx)
        calls.append(1)
        if len(calls) == n:
            next(self.method.parameters()).register_hook(lambda gradient: gradient * float("nan"))
        return loss

    module.training_step = called


def seen(folder: Path) -> dict[str, Any]:
    """Instead of a life, a look at what it would go on from."""
    from mvrecon.training.checkpoints import previous, read_newest, unfinished

    last = unfinished(folder, METHOD)
    begun = last.exists() or previous(last).exists()
    parts = [path.name for path in folder.rglob("*.part")]
    return {
        "exit": 0,
        "said": f"step {read_newest(last)['global_step'] if begun else 0}",
        "parts": parts,
    }


def permitted(folder: Path, mode: int) -> None:
    """Let anyone write anywhere in a run folder, but set the mode of the folder of its last
    checkpoint.
    """
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o777 if path.is_dir() else 0o666)
    (folder / "checkpoints" / METHOD).chmod(mode)


def live(options: list[str], settings: Any, folder: Path, fate: dict[str, Any]) -> dict[str, Any]:
    """One life, as `mvrecon-train` (where the fate says "app") or straight away: how it ended."""
    from mvrecon.apps import train

    if fate.get("what") == "look":
        return seen(folder)
    if fate.get("what") == "read-only":
        permitted(folder, 0o555)
    said = folder.with_suffix(".stderr")
    child = os.fork()
    if child:
        if fate.get("what") == "time":
            time.sleep(fate["n"])
            os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
        if fate.get("what") == "read-only":
            permitted(folder, 0o755)
        return {"exit": os.waitstatus_to_exitcode(status), "said": said.read_text()}
    sys.stdout.flush()
    for stream in (1, 2):
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666), stream)
    if fate and fate["what"] != "time":
        befall(fate["what"], fate.get("n", 0))
    if fate.get("app"):
        sys.argv = ["mvrecon-train", *options, f"hydra.run.dir={folder}", "hydra/job_logging=none"]
        train.main()
    train.train(settings, folder)
    raise SystemExit(0)


def warmed(*options: str) -> Any:
    """The settings of a training, after one look at all that it needs, so that processes forked
    from this one import and compile nothing.
    """
    import lightning.pytorch.callbacks  # noqa: F401
    import torch

    from mvrecon.apps.config import compose
    from mvrecon.training import evaluation, fit
    from mvrecon.training.settings import TrainSettings

    torch.set_num_threads(1)
    settings = TrainSettings(**compose(*options))
    data = fit.build_data(settings)
    module = fit.build_module(settings, settings.method, data.data_range)
    data.scenes["train"].sample(0, 0, data.grid, data.cameras)
    torch.optim.AdamW(evaluation.trainable(module) * [*module.parameters()])
    return settings


def main(plan: dict[str, Any]) -> None:
    """Live a plan."""
    settings = warmed(*plan["options"])
    for name, fates in plan["runs"].items():
        for fate in [*fates, {}]:
            began, ended = time.perf_counter(), live(plan["options"], settings, Path(name), fate)
            life = {
                "run": Path(name).name,
                **fate,
                **ended,
                "seconds": round(time.perf_counter() - began, 2),
            }
            sys.stdout.write(json.dumps(life) + "\n")
            sys.stdout.flush()


def deaths(rng: random.Random, count: int) -> list[dict[str, Any]]:
    """Random kills: at a step, in the optimiser, in a validation, at any moment, and in the writing
    of a checkpoint.
    """
    choices: dict[str, Any] = {
        "step": lambda: rng.randint(1, 4),
        "stepped": lambda: rng.randint(1, 4),
        "validation": lambda: 1,
        "sync": lambda: rng.randint(1, 10),
        "rename": lambda: rng.randint(1, 8),
        "byte": lambda: rng.randint(20_000, 60_000),
        "time": lambda: round(rng.uniform(0.2, 2.0), 3),
    }
    return [{"what": what, "n": choices[what]()} for what in rng.choices(list(choices), k=count)]


def campaign(count: int, seed: int) -> None:
    """Kill at random, six times a run, with and without worker processes; tell how many runs ended
    otherwise.
    """
    rng, killed, wrong = random.Random(seed), 0, []
    for workers in (0, 2):
        runs = {f"run{k}": deaths(rng, 6) for k in range(count // 12)} | {"whole": []}
        with tempfile.TemporaryDirectory() as folder:
            ended = play(Path(folder), runs, f"data.workers={workers}")
            killed += sum(life["exit"] < 0 for lives in ended.values() for life in lives)
            whole = state(Path(folder) / "whole")
            wrong += [
                f"{name}, {workers} workers"
                for name in runs
                if different(state(Path(folder) / name), whole)
            ]
    sys.stdout.write(json.dumps({"seed": seed, "kills": killed, "runs that differ": wrong}) + "\n")


if __name__ == "__main__":
    if len(sys.argv) == 3:
        campaign(*map(int, sys.argv[1:]))
    else:
        main(json.loads(Path(sys.argv[1]).read_text()))
