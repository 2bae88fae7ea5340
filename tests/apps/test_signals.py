"""Signals end a command, wherever they arrive."""

import signal
import time
import weakref

import pytest

from mvrecon.apps.config.errors import one_line

NUMBERS = [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]


class Freed:
    """An object that calls a function when it is freed."""

    def __init__(self, call):
        self.call = call

    def __del__(self):
        self.call()


def by_reference(call):
    freed = Freed(lambda: None)
    weakref.finalize(freed, call)


def by_dictionary(call):
    class Key:
        pass

    key = Key()
    reference = weakref.ref(key, lambda _: call())
    del key
    assert reference() is None


@pytest.mark.parametrize("free", [Freed, by_reference, by_dictionary])
@pytest.mark.parametrize(("number", "status"), NUMBERS)
def test_a_signal_that_arrives_while_an_object_is_freed_ends_the_command(
    free, number, status, capsys
):
    """Python only prints the error of its handler there: 6 of 14 SIGTERMs at moments between 2.2
    and 4 s of mvrecon-reconstruct were ignored, each in a callback of a WeakKeyDictionary, and the
    run went on to its end with status 0. SIGHUP ended it with 143, as SIGTERM.
    """
    usual = {
        number: signal.signal(number, handler)
        for number, handler in [
            (signal.SIGINT, signal.default_int_handler),
            (signal.SIGTERM, signal.SIG_DFL),
            (signal.SIGHUP, signal.SIG_DFL),
        ]
    }
    try:
        with pytest.raises(SystemExit) as stop, one_line("app"):
            free(lambda: signal.raise_signal(number))
            for _ in range(500):
                time.sleep(0.01)
    finally:
        for each, handler in usual.items():
            signal.signal(each, handler)
    assert stop.value.code == status and "stopped by" in capsys.readouterr().err


def test_a_task_that_ends_early_by_itself_ends_as_the_signal_that_it_got(capsys):
    """As an iterative method, which keeps its last iterate: SIGTERM was reported as Ctrl-C."""
    usual = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit, match="143"), one_line("app"):
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)
            raise KeyboardInterrupt
    finally:
        signal.signal(signal.SIGTERM, usual)
    assert capsys.readouterr().err == "app: stopped by SIGTERM\n"
