"""The study's figure: error against iterations, length of training, and unrolled iterations."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

Row = Mapping[str, str]
#: Networks that differ in their unrolled iterations alone.
UNROLLED = {"itnet_1": 1, "itnet_2": 2, "itnet": 4, "itnet_8": 8}


def draw(table: list[Row], out: Path) -> None:
    """Write the figure."""
    picture = Figure(figsize=(13, 4.2), layout="constrained")
    left, middle, right = picture.subplots(1, 3)
    for name, size in dict.fromkeys(
        (row["method"], row["size"]) for row in table if row["counted"] == "iterations"
    ):
        lines = [row for row in table if (row["method"], row["size"]) == (name, size)]
        marker = "o" if len(lines) == 1 else None
        points = [(max(1, int(row["count"])), float(row["nrmse"])) for row in lines]
        left.plot(*zip(*points, strict=True), marker=marker, label=f"{name}, {size}$^2$")
    trained = [row for row in table if row["counted"] == "steps"]
    for name in dict.fromkeys(row["method"] for row in trained):
        curve(middle, name, (row for row in trained if row["method"] == name))
    last = max((int(row["count"]) for row in trained), default=0)
    unrolled = [row for row in trained if row["method"] in UNROLLED and int(row["count"]) == last]
    counted = [{**row, "count": UNROLLED[row["method"]]} for row in unrolled]
    curve(right, f"itnet, {last} steps", counted)
    curve(right, "and CGLS from it", ({**row, "nrmse": row["nrmse_consistent"]} for row in counted))
    words = ("iterations, without training", "training steps", "unrolled iterations")
    for axes, label in zip((left, middle, right), words, strict=True):
        axes.set(xscale="log", yscale="log", xlabel=label, ylabel="relative RMSE")
        axes.grid(True, which="both", alpha=0.3)
        axes.legend(fontsize=7)
    for axes, ticks in (
        (middle, sorted({int(row["count"]) for row in trained})),
        (right, sorted({int(row["count"]) for row in counted})),
    ):
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.xaxis.set_minor_locator(NullLocator())
    picture.savefig(out, dpi=110)


def curve(axes: Any, label: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """The mean over seeds as a line, each seed as a point."""
    errors: dict[int, list[float]] = {}
    for row in rows:
        errors.setdefault(int(row["count"]), []).append(float(row["nrmse"]))
    if not errors:
        return
    counts = sorted(errors)
    (line,) = axes.plot(counts, [mean(errors[count]) for count in counts], label=label)
    points = [(count, error) for count in counts for error in errors[count]]
    axes.plot(*zip(*points, strict=True), ".", color=line.get_color())
