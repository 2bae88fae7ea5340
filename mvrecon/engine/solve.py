"""One reconstruction of a measured scan: the method, its progress, its time and memory."""

import time
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from inspect import signature
from typing import Any

from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from torch import Tensor

from mvrecon.engine.scan import Scan
from mvrecon.files.memory import peak
from mvrecon.parts import RECONSTRUCTORS, STREAMED
from mvrecon.reconstruct.held_out import held_out
from mvrecon.reconstruct.left_out import left_out_residual
from mvrecon.reconstruct.stopping import Curve, combined, discrepancy

#: Views whose residual is computed at a time.
BLOCK = 32


@dataclass
class Outcome:
    """A reconstruction.

    Args:
        volume: in the unit of the views per mm.
        seconds: of the method.
        peak_bytes: most memory of the process so far; None where the system does not tell.
        residuals: |y - A x| after each iteration, in the unit of the views; empty where the
            method does not iterate.
        chosen: iterations and weight that views which were left out have chosen.
    """

    volume: Float[Tensor, "d h w"]
    seconds: float
    peak_bytes: int | None
    residuals: list[float] = field(default_factory=list)
    chosen: dict[str, Any] = field(default_factory=dict)


def check(settings: Mapping[str, Any]) -> None:
    """Check the settings `reconstructor`, `stop` and `choose` before any view is read.

    Raises:
        LookupError, TypeError: no such method, or no such option of it.
        ValueError: a rule to stop or to choose for a method that does not iterate.
    """
    name = settings["reconstructor"]["name"]
    RECONSTRUCTORS.check(settings["reconstructor"])
    ruled = settings["choose"] or settings["stop"]["sigma"] is not None
    if ruled and not _iterates(name):
        raise ValueError(f"{name} does not iterate: expected choose=null and stop.sigma=null")


def solve(scan: Scan, settings: Mapping[str, Any], device: str = "cpu") -> Outcome:
    """The volume of a scan by the method that the settings `reconstructor`, `stop` and `choose`
    describe.

    Raises:
        ValueError: what the method raises.
    """
    name, options = settings["reconstructor"]["name"], dict(settings["reconstructor"])
    del options["name"]
    start = time.perf_counter()
    curve, chosen = Curve(), {}
    if name in STREAMED.names():
        volume = _streamed(scan, name, options)
    elif not _iterates(name):
        views = scan.measured.whole().views[None, None].to(device)
        volume = RECONSTRUCTORS.build(name, scan.operator().to(device), views, **options)
    else:
        volume, chosen = _iterated(scan, settings, options, curve, device)
    seconds = time.perf_counter() - start
    return Outcome(volume[0, 0].cpu(), seconds, peak(), curve.residuals, chosen)


def residual(scan: Scan, volume: Float[Tensor, "d h w"]) -> float:
    """|y - A x| / |y| over the measured pixels, views read in blocks."""
    squares, total = 0.0, 0.0
    for first in range(0, len(scan.cameras), BLOCK):
        last = min(first + BLOCK, len(scan.cameras))
        part = scan.measured.read(first, last)
        rest = part.views - scan.operator(slice(first, last))(volume[None, None])[0, 0]
        squares += (rest[part.mask].double()).square().sum().item()
        total += (part.views[part.mask].double()).square().sum().item()
    return (squares / total) ** 0.5 if total else float("nan")


def left_out(scan: Scan, settings: Mapping[str, Any], device: str = "cpu") -> list[float]:
    """The relative error of each view as the method predicts it from the others."""
    options = dict(settings["reconstructor"])
    method = partial(RECONSTRUCTORS.build, options.pop("name"), **options)
    views = scan.measured.whole().views[None, None].to(device)
    return left_out_residual(method, scan.operator().to(device), views)[0].tolist()


def _iterated(
    scan: Scan,
    settings: Mapping[str, Any],
    options: dict[str, Any],
    curve: Curve,
    device: str,
) -> tuple[Tensor, dict[str, Any]]:
    name = settings["reconstructor"]["name"]
    A, views = scan.posed(device)
    if rule := settings["choose"]:
        choice = held_out(RECONSTRUCTORS.get(name), A, views, options=options, **rule)
        trials = [{"weight": t.weight, "errors": t.errors} for t in choice.trials]
        chosen = {"iterations": choice.iterations, "weight": choice.weight, "trials": trials}
        return choice.volume, chosen
    with _bar(name, options.get("iterations")) as advance:
        monitors = [curve, lambda iterate: advance(iterate.number)]
        if settings["stop"]["sigma"] is not None:
            monitors.append(discrepancy(settings["stop"]["sigma"]))
        monitor = combined(*monitors)
        return RECONSTRUCTORS.build(name, A, views, monitor=monitor, **options), {}


def _streamed(scan: Scan, name: str, options: dict[str, Any]) -> Tensor:
    saturated = floored = 0
    with _bar(name, len(scan.cameras)) as advance:

        def read(first: int, last: int) -> Tensor:
            nonlocal saturated, floored
            part = scan.measured.read(first, last)
            saturated, floored = saturated + part.saturated, floored + part.floored
            advance(last)
            return part.views

        volume = STREAMED.build(name, read, scan.cameras, scan.grid, **options)
    scan.measured.warn_of_values(saturated, floored)
    return volume


def _iterates(name: str) -> bool:
    """Whether a method shows its iterates to a monitor."""
    parameters = signature(RECONSTRUCTORS.get(name)).parameters.values()
    return any(p.name == "monitor" or p.kind is p.VAR_KEYWORD for p in parameters)


@contextmanager
def _bar(name: str, total: int | None):
    """Context with a progress bar on stderr; gives the function that moves it."""
    columns = (TextColumn("{task.description}"), BarColumn(24), MofNCompleteColumn())
    bars = Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True)
    with bars:
        task = bars.add_task(name, total=total)
        yield lambda done: bars.update(task, completed=done)
