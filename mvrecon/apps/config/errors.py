"""Errors of the apps as one line; HYDRA_FULL_ERROR=1 in the environment shows the traceback."""

import os
import re
import signal
import sys
import threading
import warnings
from _thread import interrupt_main
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial, wraps
from pathlib import Path, PurePosixPath
from traceback import walk_tb
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, errors

from mvrecon.apps.config.guard import as_typed, made
from mvrecon.core.registry import hint, in_plugin

#: The environment variable by which Hydra raises errors as they are.
FULL_ERROR = "HYDRA_FULL_ERROR"
#: What a user's settings, files and machine can cause; anything else is a fault of the program.
USER_ERRORS = (
    *(HydraException, errors.OmegaConfBaseException),
    *(ValueError, TypeError, LookupError, OSError, ImportError, RuntimeError, MemoryError),
    FloatingPointError,
)
#: Kinds of these that only a fault of the program raises.
PROGRAM_FAULTS = (KeyError, IndexError, RecursionError, NotImplementedError)

#: What OmegaConf adds to its messages for programmers.
OMEGACONF_DETAILS = re.compile(r"\s*(full_key|object_type|reference_type)\b.*")

#: Seconds after which a signal is raised again.
AGAIN_SECONDS = 0.01
#: A number in a sentence; digits within a name, such as that of a file, distinguish warnings.
NUMBER = re.compile(r"[^\w\s/\\]*\d[\d.,:e+x-]*[^\w\s/\\]*")

#: What installs choices: beginnings of their names, and the argument of pip install.
INSTALLED_BY = {
    "'mvrecon[sweep]'": ("hydra/launcher/joblib", "hydra/sweeper/optuna"),
    "'mvrecon[cluster]'": ("hydra/launcher/ray", "hydra/launcher/submitit_"),
    "plugins/mvrecon-spect": (
        *("experiment/dcspect_", "experiment/events", "projector/spect", "method/bsrem"),
        "camera/stir_",
    ),
}


@contextmanager
def one_line(app: str) -> Iterator[None]:
    """Context in which a user's error ends the process with status 1 and, like a warning, is one
    line. Of warnings that differ in their numbers alone, such as those of each step of a training,
    the first one is printed, and at the end how many followed.

    SIGTERM, and SIGHUP of a terminal that closes, end the process as Ctrl-C does: files that are
    not complete are removed, and the status is 128 plus the number of the signal; a training, in
    which Lightning handles SIGTERM, ends as of that after SIGHUP, too. Python ignores the error of
    a signal that arrives while an object is freed; it is raised again.

    Args:
        app: name of the app, with which the line begins.

    Raises:
        SystemExit: in place of the error, unless HYDRA_FULL_ERROR=1 asks for its traceback.
    """
    traceback_asked, shown = os.environ.get(FULL_ERROR), warnings.formatwarning
    given: Counter[tuple[str, ...]] = Counter()
    terminated: list[signal.Signals] = []

    def terminate(number: int, _: object) -> None:
        terminated.append(signal.Signals(number))
        raise KeyboardInterrupt(terminated[-1])

    def line(message: Warning | str, category: type[Warning], *_: object, **__: object) -> str:
        text = f"{app}: {category.__name__}: {message}\n"
        kind = tuple(word for word in text.split() if not NUMBER.fullmatch(word))
        given[kind] += 1
        return text if given[kind] == 1 else ""

    warnings.formatwarning = line
    os.environ[FULL_ERROR] = "1"  # Hydra's own report is several lines; so it raises the error
    try:
        with _handled(terminate):
            yield
    except KeyboardInterrupt as stop:
        by = next(reversed(terminated), signal.SIGINT)  # a task may raise its own in the end
        sys.stderr.write(f"{app}: stopped by {'Ctrl-C' if by == signal.SIGINT else by.name}\n")
        raise SystemExit(128 + by) from stop
    except (TaskFailed, *USER_ERRORS) as raised:
        error = raised.error if isinstance(raised, TaskFailed) else raised
        is_fault = isinstance(error, PROGRAM_FAULTS) and not isinstance(
            error, errors.OmegaConfBaseException
        )
        if traceback_asked == "1" or is_fault or not isinstance(error, USER_ERRORS):
            raise error from error.__cause__
        sys.stderr.write(f"{app}: {sentence(error)}\n")
        raise SystemExit(1) from error
    finally:
        if traceback_asked is None:
            del os.environ[FULL_ERROR]
        else:
            os.environ[FULL_ERROR] = traceback_asked
        warnings.formatwarning = shown
        if more := given.total() - len(given):
            sys.stderr.write(f"{app}: warnings that repeat these with other numbers: {more}\n")


@contextmanager
def _handled(terminate: Callable[[int, Any], None]) -> Iterator[None]:
    """Context in which SIGTERM has a handler, and SIGHUP whichever handler SIGTERM has when it
    arrives, as that of a training, unless they are handled or ignored already, as by nohup.
    """

    def hang_up(number: int, frame: Any) -> None:
        handler = signal.getsignal(signal.SIGTERM)
        if callable(handler):
            handler(number, frame)
        else:
            signal.raise_signal(signal.SIGTERM)

    handlers = {"SIGTERM": terminate, "SIGHUP": hang_up}
    main = threading.current_thread() is threading.main_thread()  # no other may set handlers
    before = {
        number: signal.signal(number, handler)
        for name, handler in handlers.items()
        if main
        and (number := getattr(signal, name, None))  # Windows has no SIGHUP
        and signal.getsignal(number) is signal.SIG_DFL
    }
    unraisable, sys.unraisablehook = sys.unraisablehook, partial(_again, sys.unraisablehook)
    try:
        yield
    finally:
        sys.unraisablehook = unraisable
        for number, handler in before.items():
            signal.signal(number, handler)


def _again(report: Callable[[Any], Any], ignored: Any) -> None:
    """Raise a signal again whose error Python ignores, as in a callback of a weak reference: it
    comes there often, as to what follows a long kernel. Other errors are reported.
    """
    stop = ignored.exc_value
    if not isinstance(stop, KeyboardInterrupt):
        return report(ignored)
    number = stop.args[0] if stop.args else signal.SIGINT
    threading.Timer(AGAIN_SECONDS, interrupt_main, [number]).start()  # not within this callback


class TaskFailed(BaseException):
    """A task's error on its way through Hydra, which would print it."""

    def __init__(self, error: Exception):
        super().__init__(error)
        self.error = error


def reported(task: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """A task whose error passes through Hydra unchanged; in a sweep it names the job, and the
    other jobs continue. The folders that were made for it are removed if they are empty.
    """

    @wraps(task)
    def run(config: DictConfig) -> Any:
        try:
            return task(config)
        except BaseException as error:
            sweeps = HydraConfig.get().mode == RunMode.MULTIRUN
            own = [Path(HydraConfig.get().runtime.output_dir)] if sweeps else made
            with suppress(OSError):  # one of them holds something
                for folder in own:
                    folder.rmdir()
            if not isinstance(error, Exception):
                raise
            if not sweeps:
                raise TaskFailed(error) from error
            error.add_note(f"in the job {' '.join(as_typed(HydraConfig.get()))}")
            raise

    return run


def sentence(error: BaseException) -> str:
    """An error's kind and message on one line, with the nearest known name, or the line of a plugin
    that raised it.
    """
    cause = error.__cause__ or error
    if isinstance(error, MissingConfigException) and error.options is not None:
        choice = PurePosixPath(str(error.missing_cfg_file))
        known = [PurePosixPath(option).name for option in error.options]
        for what, beginnings in INSTALLED_BY.items():
            others = [f"{choice.parent}/{name}" for name in known]
            if str(choice).startswith(beginnings) and not any(
                other.startswith(beginnings) for other in others
            ):
                return f"{choice} is not installed; pip install {what} brings it"
        return f"{choice.parent} has no choice {choice.name!r}{hint(choice.name, known)}"
    if isinstance(cause, errors.ConfigKeyError | errors.ConfigAttributeError):
        parent = cause.parent_node
        known = {str(key) for key in parent or ()} - {"hydra"}
        if not known:  # as the camera of an evaluation, which is the run's
            return f"{cause.full_key!r} has no value here yet; to set it: +{cause.full_key}=..."
        inside = [f"{part}.{cause.key}" for part in known if str(cause.key) in _keys(parent, part)]
        if inside and cause.full_key == cause.key:
            return f"There is no setting {cause.full_key!r}; did you mean {' or '.join(inside)}?"
        return f"There is no setting {cause.full_key!r}{hint(str(cause.key), known)}"
    if isinstance(error, HydraException):
        texts = [str(error), str(cause) if cause is not error else ""]
        return _joined([OMEGACONF_DETAILS.sub("", text) for text in texts])
    texts = [str(error), *getattr(error, "__notes__", ()), _plugin_line(error)]
    return f"{type(error).__name__}: {_joined(texts)}"


def _plugin_line(error: BaseException | None) -> str:
    """The innermost line of a plugin in an error's traceback, or in that of its cause; "" if none
    is there.
    """
    while error is not None:
        for frame, line in reversed(list(walk_tb(error.__traceback__))):
            if in_plugin(frame.f_globals.get("__name__", "")):
                file = frame.f_code.co_filename
                return f"raised in {file}, line {line} ({FULL_ERROR}=1 shows the traceback)"
        error = error.__cause__
    return ""


def _keys(settings: Any, part: str) -> set[str]:
    """The settings of a part, where it has any."""
    inner = None if OmegaConf.is_missing(settings, part) else settings._get_node(part)
    return {str(key) for key in inner} if isinstance(inner, DictConfig) else set()


def _joined(texts: list[str]) -> str:
    lines = (" ".join(text.split()) for text in texts)
    return "; ".join(re.sub(r"(?<!\.)\.$", "", line) for line in lines if line)
