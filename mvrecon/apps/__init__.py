"""The command-line apps and their configuration."""

import sys
from pathlib import Path
from types import TracebackType

COMMAND = Path((sys.argv or [""])[0]).stem


def stopped(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Report Ctrl-C in one line, also while modules are imported, and other errors as Python."""
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write(f"{COMMAND}: stopped by Ctrl-C\n")
    else:
        sys.__excepthook__(kind, error, trace)


if COMMAND.startswith("mvrecon-"):  # not where Python imports the apps
    sys.excepthook = stopped
