"""The result table on a terminal."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mvrecon.core.files.runs import Results
from mvrecon.core.parts import METRICS
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.report.metrics import declared
from mvrecon.report.quality import sentence

TERMINAL_COLUMNS = 120


def table(results: Results) -> Table:
    """Build the result table for a terminal: mean over the scenes, and the standard deviation
    below; for a failing method the number of its failed volumes.
    """
    count, seen = len(results["scenes"]), results["seen_in_training"]
    scenes = "scenes" if count > 1 else "scene"
    if seen is None:
        scenes += ", not known whether seen in training"
    elif seen:
        scenes += f", {len(seen)} of them seen in training"
    else:
        scenes = f"unseen {scenes}"
    scenes += ", mean ± standard deviation" if count > 1 else ""
    title = escape(f"{results['name']}: {count} {scenes}")
    shown = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    shown.add_column("method", no_wrap=True)
    shown.add_column("parameters", justify="right", no_wrap=True)
    rows = results["methods"].values()
    known = {n: declared(n) for n in METRICS.names() if all(n in row for row in rows)}
    columns = dict(sorted(known.items(), key=lambda column: not column[1].higher_is_better))
    for metric in columns.values():
        shown.add_column(escape(metric.heading.replace(" ", "\n")), justify="right")
    shown.add_column("ms per\nvolume", justify="right")
    shown.add_column("training\ns", justify="right")
    for label, row in results["methods"].items():
        if failed := row.get("failed"):
            cells = [f"{len(failed)} of {len(results['scenes'])}\nfailed"] * len(columns)
        else:
            cells = [_cell(row[name], metric.format) for name, metric in columns.items()]
        seconds = f"{row['train_seconds']:.0f}" if row["train_steps"] else "-"
        shown.add_row(
            escape(label), f"{row['parameters']:,}", *cells, f"{row['ms_per_volume']:.1f}", seconds
        )
    return shown


def show(results: Results, folder: Path) -> None:
    """Print the table without squeezing: narrow terminals wrap its lines."""
    console = Console(width=max(Console().width, TERMINAL_COLUMNS))
    console.print(table(results))
    for line in remarks(results):
        console.print(line, soft_wrap=True, markup=False)
    console.print(f"Kept in {folder}", soft_wrap=True, markup=False)


def remarks(results: Results) -> list[str]:
    """Remarks on the measurement for readers of the table: an imperfect detector, failed volumes,
    and cases shared by several sets.
    """
    lines, got = [], results.get("acquisition")
    if got and (errors := _detector_errors(got)):
        lines.append(f"The views' detector: {errors}")
    run = results.get("acquisition_of_run", got)
    # a run's settings omit defaults
    if got and Acquisition.of(run) != Acquisition.of(got):
        lines.append(f"The run's detector was another: {_detector_errors(run or {}) or 'perfect'}")
    for label, row in results.get("methods", {}).items():
        if failed := row.get("failed"):
            names = ", ".join(failed)
            lines.append(f"{label} failed, by an error, or NaN or infinity in the volume: {names}")
        elif words := sentence(row.get("quality", {})):
            lines.append(f"{label}: {words}")
        if "auc" in (cameras := row.get("cameras", {})):
            lines.append(
                f"{label} detects disturbed cameras with an AUC of {cameras['auc']:.3f}; "
                f"shifts of {cameras['true_shift_rms_px']:.3f} pixels and gains of "
                f"{cameras['true_gain_rms']:.2%} are found with errors of "
                f"{cameras['shift_rms_px']:.3f} pixels and {cameras['gain_rms']:.2%} "
                f"(root mean square)"
            )
    if results.get("overlap"):
        lines.append("data.overlap: training, validation and test share their cases")
    return lines


def _detector_errors(acquisition: Mapping[str, Any]) -> str:
    """The non-zero options of a detector that have an effect."""
    needs = {"scatter_mm": "scatter", "integrating": "kv"}
    silent = {"fine", "rays", "closed_form", "duration_s"} | {
        option for option, other in needs.items() if not acquisition.get(other)
    }
    errors = acquisition.get("disturbed") or {}
    usual = {"probability": 1, **({"views": 1} if errors.get("lost") else {})}
    disturbed = {f"disturbed.{k}": v for k, v in errors.items() if v != usual.get(k)}
    shown = {**acquisition, "disturbed": 0, **disturbed}
    return ", ".join(f"{k} {v:g}" for k, v in shown.items() if v and k not in silent)


def _cell(figure: Any, form: str) -> str:
    mean, spread = format(figure["mean"], form), figure["std"]
    return mean if math.isnan(spread) else f"{mean}\n± {spread:{form}}"
