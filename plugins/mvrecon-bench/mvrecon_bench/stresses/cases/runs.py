"""Runs: two at once in a folder, a file that is read while it is written, kills, full disks, and what hangs."""

import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.durable import claimed
from mvrecon_bench.stresses.apart import apart, python
from mvrecon_bench.stresses.case import DoesNotApply, once
from mvrecon_bench.stresses.refusals import none_of
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.survival import survival


def need_posix() -> None:
    """Raise DoesNotApply where processes are not forked, killed and locked out as on POSIX."""
    if os.name != "posix":
        raise DoesNotApply("it needs a POSIX system")


@cache
def survived() -> Mapping[str, Mapping[str, str]]:
    """What went wrong in a process that was killed and begun again; once for all cases."""
    need_posix()
    with TemporaryDirectory() as folder:
        return apart(survival, Path(folder))


def kills_in_saving(subject: Subject) -> float:
    """SIGKILL at every flush and rename of a checkpoint's writing."""
    return none_of(survived()["saving"])


def kill_and_resume(subject: Subject) -> float:
    """SIGKILL in a training step; the run is begun again and compared with one that was not killed."""
    return none_of(survived()["training"])


def full_disk(subject: Subject) -> float:
    """No space, a file that may not grow, a folder that is none."""
    return none_of(survived()["disk"])


def two_writers(subject: Subject) -> float:
    """A second process is refused in a run folder, with the first one's number and machine; later it may have it."""
    need_posix()
    code = "import sys, pathlib; from mvrecon.durable import claimed\nwith claimed(pathlib.Path(sys.argv[1])): pass"
    with TemporaryDirectory() as folder:
        with claimed(Path(folder)):
            refused = python("-c", code, folder)
        later = python("-c", code, folder)
    named = f"is in use by process {os.getpid()} on" in refused.stderr and "hydra.run.dir" in refused.stderr
    wrong = {
        "at once": "" if refused.returncode == 1 and named else f"exit {refused.returncode}: {refused.stderr[-200:]}",
        "later": "" if later.returncode == 0 else f"exit {later.returncode}: {later.stderr[-200:]}",
    }
    return none_of(wrong)


def reader_while_writing(subject: Subject) -> float:
    """While a file is written anew, and after, readers see one edition whole: the old one, and then the new one."""
    seen: dict[str, list[int]] = {}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"

        def edition(number: int) -> Iterator[Stored]:
            for k in range(3):
                if number:
                    seen[f"while volume {k} is written"] = editions(VolumeFile(path))
                yield Stored(f"pt_{k}", np.full((4, 6, 6), number, np.int16), (1.0, 1.0, 1.0))

        def editions(file: VolumeFile) -> list[int]:
            return sorted({int(value) for k in range(len(file)) for value in np.unique(file.read(k).ct)})

        write_volumes(path, edition(0))
        held = VolumeFile(path)
        seen["before"] = editions(held)
        write_volumes(path, edition(1))
        seen["of one that was open"], seen["of one that is opened"] = editions(held), editions(VolumeFile(path))
    new = seen.pop("of one that is opened")
    wrong = {name: "" if found == [0] else f"{found} is seen" for name, found in seen.items()}
    return none_of({**wrong, "after": "" if new == [1] else f"{new} is seen"})


HANGING = """
import signal, sys, time
from mvrecon_bench.stresses.case import once
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.verdict import judge
from mvrecon_bench.stresses.watchdog import watched

def hang(subject):
    while True:
        pass

row = judge(once(77, "x", "y", hang), Subject("mvrecon"), 0.2)
sys.stdout.write(f"{row['verdict']} {row['note']}\\n")
sys.stdout.flush()
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})  # as compiled code, which no signal reaches
with watched(0.2, 0.3):
    time.sleep(60)
"""


def hanging(subject: Subject) -> float:
    """A case that does not end is a failure; one that hangs where no Python runs ends the app with a traceback."""
    need_posix()
    done = python("-c", HANGING)
    told = "FAIL TimeoutError: still at work after 0.2 s" in done.stdout
    loud = done.returncode == 1 and "Timeout" in done.stderr and "most recent call first" in done.stderr
    wrong = {
        "in Python": "" if told else f"{done.stdout!r} {done.stderr[-200:]}",
        "beyond it": "" if loud else f"exit {done.returncode}: {done.stderr[-200:]!r}",
    }
    return none_of(wrong)


CASES = (
    once(65, "two processes in one run folder", "the second is refused, the first named", two_writers),
    once(65, "a file that is read while it is written", "one edition, whole", reader_while_writing),
    once(67, "kills while a checkpoint is written", "a whole one is read", kills_in_saving),
    once(68, "a kill, and on from there", "the bits of a run that was not killed", kill_and_resume),
    once(69, "a full disk", "told, and the last checkpoint stays", full_disk),
    once(77, "cases that hang", "told, or a loud exit", hanging),
)
