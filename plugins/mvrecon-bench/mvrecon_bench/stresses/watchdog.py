"""A time limit for a case: what hangs is stopped and fails."""

import faulthandler
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

#: Seconds that a case may take, and that a call into compiled code has more, in which no Python is
#: interrupted.
LIMIT, GRACE = 120.0, 30.0


@contextmanager
def watched(seconds: float = LIMIT, grace: float = GRACE) -> Iterator[None]:
    """Let a block take so many seconds and no more.

    Where Python is at work it is interrupted, by POSIX's alarm in the main thread. What never comes
    back to Python (a loop in compiled code, a lock, another system, another thread) ends the
    process `grace` seconds later with the traceback of every thread on stderr. Within another block
    of this kind only the inner limit holds.

    Raises:
        TimeoutError: it took longer.
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
