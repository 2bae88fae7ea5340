"""Plots of benchmarks; the only module that imports matplotlib."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

Points = Sequence[tuple[float, float]]
MARKERS = "osD^v<>PX*hd8p"


def pareto(
    panels: Mapping[str, tuple[Mapping[str, Points], Mapping[int, float]]], path: Path
) -> None:
    """Error against forward time with one marker per part, large for its largest volume; both axes
    are logarithmic.

    Args:
        panels: title -> (part -> (ms, error) for increasing volumes, voxels along an edge -> error
            floor).
        path: path of the PNG.
    """
    figure, axes = _figure(len(panels), "time of one projection of all views / ms")
    for ax, (title, (curves, floors)) in zip(axes, panels.items(), strict=True):
        for marker, (label, points) in zip(cycle(MARKERS), sorted(curves.items()), strict=False):
            (line,) = ax.plot(
                *zip(*points, strict=True), marker=marker, markersize=4, linewidth=0.6, alpha=0.7
            )
            ax.plot(
                *points[-1],
                marker=marker,
                markersize=9,
                linestyle="",
                color=line.get_color(),
                label=label,
            )
        for n, floor in floors.items():
            ax.axhline(floor, color="0.6", linewidth=0.8, linestyle="--")
            ax.annotate(
                f"floor, {n}³",
                (1.01, floor),
                xycoords=("axes fraction", "data"),
                ha="left",
                va="center",
                fontsize=9,
            )
        ax.set_ylabel(title)
    _save(figure, axes, path)


def scaling(panels: Mapping[str, Mapping[str, Points]], path: Path) -> None:
    """Time against the amount of work, one panel per kind of work; both axes are logarithmic.

    Args:
        panels: varied quantity -> label -> (amount, ms).
        path: path of the PNG.
    """
    figure, axes = _figure(len(panels), None)
    for ax, (axis, curves) in zip(axes, panels.items(), strict=True):
        for marker, (label, points) in zip(cycle(MARKERS), sorted(curves.items()), strict=False):
            ax.plot(
                *zip(*points, strict=True), marker=marker, markersize=4, linewidth=0.8, label=label
            )
        ax.set_xlabel(axis)
        ax.set_ylabel("time, ms")
    _save(figure, axes, path)


def speedups(panels: Mapping[str, Mapping[str, Sequence[tuple[str, float]]]], path: Path) -> None:
    """Speed-up, one panel per task, with a line at 1; the vertical axis is logarithmic.

    Args:
        panels: title -> baseline -> (scene, speed-up), with scenes in order of first occurrence.
        path: path of the PNG.
    """
    figure, axes = _figure(len(panels), None)
    for ax, (title, kinds) in zip(axes, panels.items(), strict=True):
        scenes = list(dict.fromkeys(scene for points in kinds.values() for scene, _ in points))
        for n, (marker, (label, points)) in enumerate(
            zip(cycle(MARKERS), kinds.items(), strict=False)
        ):
            beside = 0.3 * (n - (len(kinds) - 1) / 2)
            places = [(scenes.index(scene) + beside, times) for scene, times in points]
            ax.plot(
                *zip(*places, strict=True),
                marker=marker,
                markersize=5,
                linestyle="",
                alpha=0.7,
                label=label,
            )
        ax.axhline(1, color="0.3", linewidth=1)
        ax.set_xscale("linear")
        ax.set_xticks(range(len(scenes)), scenes, rotation=30, ha="right")
        ax.set_title(title)
        ax.set_ylabel("speed-up")
    _save(figure, axes, path)


def _figure(count: int, xlabel: str | None) -> tuple[Figure, list[Any]]:
    columns = min(2, count)
    rows = -(-count // columns)
    # as wide as a page, so that text keeps its size in print
    figure = Figure(figsize=(3.7 * columns, 3.3 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[count:]:
        spare.remove()
    for ax in axes[:count]:
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.grid(True, which="both", linewidth=0.3)
        if xlabel:
            ax.set_xlabel(xlabel)
    return figure, axes[:count]


def _label(axis: Any) -> None:
    """Label the powers of ten of a logarithmic axis, and intermediate ticks if there are few of
    them.
    """
    low, high = axis.get_view_interval()
    choices = (
        (30, (1,)),
        (10, (1, 2, 5)),
        (2.5, (1, 1.5, 2, 3, 5, 7)),
        (1, (1, 1.2, *range(2, 10))),
    )
    between = next(numbers for least, numbers in choices if high > least * low)
    axis.set_major_locator(LogLocator(subs=between))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def _save(figure: Figure, axes: Sequence[Any], path: Path) -> None:
    for axis in (axis for ax in axes for axis in (ax.xaxis, ax.yaxis)):
        if axis.get_scale() == "log":
            _label(axis)
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    figure.savefig(path, dpi=130, format="png")
