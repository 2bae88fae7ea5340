"""Progress of a reconstruction on stderr: one bar over its phases, or a line for each step."""

import logging
import time
from typing import Any

from rich import progress
from rich.console import Console

#: INFO: the bar; DEBUG: a line for each step; above: neither.
logger = logging.getLogger("mvrecon.progress")
#: Levels by the flags of the command line.
LEVELS = {"--quiet": logging.WARNING, "-q": logging.WARNING}
LEVELS |= {"--verbose": logging.DEBUG, "-v": logging.DEBUG}


class Bar:
    """Context with the bar of a run: the phase, its steps, the residual, time taken and left.

    Nothing is drawn outside the context, and where stderr is not a terminal.
    """

    def __init__(self) -> None:
        console = Console(stderr=True)
        shown = logger.getEffectiveLevel() == logging.INFO and console.is_terminal
        self._bars = progress.Progress(
            progress.TextColumn("{task.description}"),
            progress.BarColumn(24),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[residual]}"),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not shown,
        )
        self._task = self._bars.add_task("preparing", total=None, residual="")
        self._begin = time.perf_counter()

    def __enter__(self) -> "Bar":
        self._bars.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bars.stop()

    def phase(self, name: str, total: int | None = None) -> None:
        """Begin a phase of so many steps; None: their number is not known."""
        self._bars.remove_task(self._task)
        self._task = self._bars.add_task(name, total=total, residual="")
        logger.debug("%s, after %.1f s", name, time.perf_counter() - self._begin)

    def __call__(self, done: int, residual: float | None = None) -> None:
        """Show the steps that are done, and |y - A x| / |y|."""
        words = "" if residual is None else f"residual {residual:.3g}"
        self._bars.update(self._task, completed=done, residual=words)
        logger.debug("%d %s", done, words)
