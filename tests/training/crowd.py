"""Processes at once on the same files: `python -m tests.training.crowd KIND FOLDER`."""

import json
import os
import sys
import time
from collections.abc import Callable
from datetime import datetime
from importlib import import_module
from pathlib import Path

from mvrecon.training.settings import TrainSettings

READERS, REWRITES, RUNS = 8, 12, 4


def together(tasks: list[Callable[[], str]], folder: Path) -> list[tuple[int, str]]:
    """Run tasks in forked processes at the same moment; the exit and the answer, or the error, of
    each.
    """
    children, start = [], time.monotonic() + 0.3
    for k, task in enumerate(tasks):
        child = os.fork()
        if not child:
            answer, code = "", 1
            try:
                time.sleep(max(0.0, start - time.monotonic()))
                answer, code = task(), 0
            except BaseException as error:
                answer = f"{type(error).__name__}: {error}"
            (folder / f"{k}.answer").write_text(answer)
            os._exit(code)
        children.append(child)
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    return [(code, (folder / f"{k}.answer").read_text()) for k, code in enumerate(codes)]


def readers(folder: Path) -> list[tuple[int, str]]:
    """Eight processes read a volume file anew and anew while another replaces it; each edition is
    all one number.
    """
    import numpy as np

    from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes

    path = folder / "heads.h5"

    def write(edition: int) -> str:
        ct = np.full((6, 8, 8), edition, np.int16)
        write_volumes(path, [Stored(f"{edition}-{k}", ct, (1.0, 1.0, 1.0)) for k in range(3)])
        return str(edition)

    def rewrite() -> str:
        for edition in range(1, REWRITES):
            write(edition)
            time.sleep(0.02)
        return "done"

    def read() -> str:
        seen: list[int] = []
        while not seen or seen[-1] < REWRITES - 1:
            file = VolumeFile(path)
            volumes = [file.read(k) for k in range(len(file))]
            values = {int(v) for volume in volumes for v in np.unique(volume.ct)}
            names = {volume.name for volume in volumes}
            assert len(values) == 1 and names == {f"{min(values)}-{k}" for k in range(3)}, (
                values,
                names,
            )
            seen.append(values.pop())
        assert seen == sorted(seen), seen
        return str(len(seen))

    write(0)
    return together([rewrite, *[read] * READERS], folder)


def training(folder: Path, same: bool) -> list[tuple[int, str]]:
    """Four runs of a sweep at once: in folders of their own below one folder, or all in the
    same.
    """
    import torch

    from mvrecon.apps import train
    from mvrecon.apps.config import compose
    from tests.training.lives import METHOD, OPTIONS

    torch.set_num_threads(1)

    def run(k: int) -> Callable[[], str]:
        settings = TrainSettings(**compose(*OPTIONS, f"seed={k}"))

        def task() -> str:
            found = train.train(settings, folder / "sweep" / ("same" if same else str(k)))
            return f"{found['seed']} {found['methods'][METHOD]['psnr']['mean']}"

        return task

    return together([run(k) for k in range(RUNS)], folder)


def app(name: str, *options: str) -> Callable[[], str]:
    """An app as its command line starts it, but for the clock, which stands still."""
    import hydra.core.utils

    class Noon:
        """One moment."""

        @staticmethod
        def now() -> datetime:
            """The moment."""
            return datetime(2026, 1, 1, 12)

    def task() -> str:
        hydra.core.utils.datetime = Noon
        sys.argv = [f"mvrecon-{name}", *options, "hydra/job_logging=none"]
        import_module(f"mvrecon.apps.{name}").main()
        return ""

    return task


def apps(folder: Path) -> list[tuple[int, str]]:
    """Two trainings, two evaluations of the first, and two simulations, each pair at once and in
    the same second.
    """
    from tests.training.lives import OPTIONS, warmed

    warmed(*OPTIONS)
    for name in ("train", "eval", "simulate"):
        import_module(f"mvrecon.apps.{name}")
    os.chdir(folder)
    run = "checkpoint=outputs/train/2026-01-01_12-00-00"
    simulation = [*(o for o in OPTIONS if o.startswith(("grid", "camera"))), "cases=[0]"]
    pairs = [
        [app("train", *OPTIONS, "trainer.max_steps=3", f"seed={k}") for k in (1, 2)],
        [app("eval", run, f"+data.sizes.test={k}") for k in (1, 2)],
        [app("simulate", *simulation, f"seed={k}") for k in (1, 2)],
    ]
    return [answer for pair in pairs for answer in together(pair, folder)]


KINDS = {"readers": readers, "apps": apps}

if __name__ == "__main__":
    kind, place = sys.argv[1], Path(sys.argv[2])
    found = KINDS[kind](place) if kind in KINDS else training(place, kind == "folder")
    sys.stdout.write(json.dumps(found) + "\n")
