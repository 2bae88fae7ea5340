"""A time limit for a case: a hanging case is stopped and fails."""

import faulthandler
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

#: Time limit of a case in seconds, and additional seconds for calls into compiled code, which
#: cannot be interrupted.
LIMIT, GRACE = 120.0, 30.0


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
