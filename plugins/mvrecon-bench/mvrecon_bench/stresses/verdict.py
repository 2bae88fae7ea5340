"""The verdict on a case and a part: measured figure against tolerance, within a time limit."""

import faulthandler
import math
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from mvrecon_bench.rows import Row, reason
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.subject import Subject

PASS, FAIL, LEFT_OUT = "pass", "FAIL", "n/a"
#: Columns of a table of verdicts, and their meaning.
COLUMNS = {
    "number": "of the case in the plan",
    "part": "the tested part, with its options",
    "case": "name of the case",
    "holds": "the property; `measured` is the deviation from it",
    "measured": "worst error or count of violations",
    "tolerance": "largest permitted value; 0: bitwise equal, or no violation",
    "verdict": f"{PASS}, {FAIL}, or {LEFT_OUT} where the case does not apply to the part",
    "note": "reason for a failure or for not applying",
    "device": "of the test",
    "dtype": "of volumes and views",
    "seconds": "run time",
}
#: Time limit of a case in seconds, and additional seconds for calls into compiled code, which
#: cannot be interrupted.
LIMIT, GRACE = 120.0, 30.0


def judge(case: Case, subject: Subject, limit_s: float = LIMIT) -> Row:
    """Run a case on a subject. An exception of the part is caught and becomes the note of a
    failure.

    A case that exceeds `limit_s` also fails; if it hangs in compiled code, the process exits, see
    `watched`.
    """
    start, measured, note = time.perf_counter(), math.nan, ""
    allowed = case.allowed(subject.dtype)
    try:
        with watched(limit_s), warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
            warnings.simplefilter("ignore")
            measured = float(case.measure(subject))
        verdict = PASS if measured <= allowed else FAIL  # NaN does not pass
    except (DoesNotApply, ImportError) as why:  # or a library is not installed
        verdict, note = LEFT_OUT, str(why)
    except (Exception, SystemExit) as error:  # plugins may raise anything; the plan goes on
        verdict, note = FAIL, reason(error)
    return identity(case, subject) | {
        "holds": case.holds,
        "measured": measured,
        "tolerance": allowed,
        "verdict": verdict,
        "note": note,
        "seconds": round(time.perf_counter() - start, 3),
    }


def identity(case: Case, subject: Subject) -> Row:
    """The columns that identify a row."""
    dtype = str(subject.dtype).removeprefix("torch.")
    row = {"number": case.number, "part": subject.label, "case": case.name}
    return row | {"device": subject.device, "dtype": dtype}


@contextmanager
def watched(seconds: float = LIMIT, grace: float = GRACE) -> Iterator[None]:
    """Limit the duration of a block in seconds.

    Python code is interrupted by a POSIX alarm in the main thread. If control never returns to
    Python (a loop in compiled code, a lock, another operating system, another thread), the process
    exits `grace` seconds later with the tracebacks of all threads on stderr. In nested blocks only
    the inner limit applies.

    Raises:
        TimeoutError: the block exceeded the limit.
    """

    def late(*_: Any) -> None:
        raise TimeoutError(f"still at work after {seconds:g} s")

    alarm = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGALRM, late) if alarm else None
    if sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(seconds + grace, exit=True, file=sys.__stderr__)
    try:
        if alarm:
            signal.setitimer(signal.ITIMER_REAL, seconds)
        yield
    finally:
        if alarm:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        faulthandler.cancel_dump_traceback_later()
