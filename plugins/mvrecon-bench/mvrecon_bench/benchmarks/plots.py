"""Plots of benchmarks."""

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

Points = Sequence[tuple[float, float]]
#: Part -> (ms, error) for increasing volumes, and voxels along an edge -> error floor.
Pareto = tuple[Mapping[str, Points], Mapping[int, float]]
MARKERS = "osD^v<>PX*hd8p"
#: Names of parts and options as legends show them.
LEGEND = {
    "drr": "mvrecon",
    "rtk": "RTK",
    "astra": "ASTRA",
    "rays_per_pixel=2": "2 x 2 rays per pixel",
    "compile_mode=auto": "(compiled)",
}


def pareto(panels: Mapping[str, Pareto], path: Path) -> None:
    """Error against forward time with one marker per part, large for its largest volume; a panel
    for each title, both axes logarithmic.
    """

    def draw(ax: Any, title: str, panel: Pareto) -> None:
        curves, floors = panel
        for marker, (label, points) in zip(cycle(MARKERS), sorted(curves.items()), strict=False):
            style = {"marker": marker, "label": _legend(label)}
            (line,) = ax.plot(*zip(*points, strict=True), marker=marker, ms=4, lw=0.6, alpha=0.7)
            ax.plot(*points[-1], ms=9, linestyle="", color=line.get_color(), **style)
        for n, floor in floors.items():
            ax.axhline(floor, color="0.6", lw=0.8, linestyle="--")
            place = {"xycoords": ("axes fraction", "data"), "ha": "left", "va": "center"}
            ax.annotate(f"floor, {n}³", (1.01, floor), fontsize=9, **place)
        ax.set(xlabel="time of one projection of all views / ms", ylabel=title)

    _figure(panels, path, draw)


def scaling(panels: Mapping[str, Mapping[str, Points]], path: Path, title: str) -> None:
    """Time against the amount of work by label, one panel per kind of work; both axes are
    logarithmic. The title states the work that all start from.
    """

    def draw(ax: Any, axis: str, curves: Mapping[str, Points]) -> None:
        for marker, (label, points) in zip(cycle(MARKERS), sorted(curves.items()), strict=False):
            ax.plot(*zip(*points, strict=True), marker=marker, ms=4, lw=0.8, label=_legend(label))
        ax.set(xlabel=axis, ylabel="time, ms")

    _figure(panels, path, draw, title)


def speedups(panels: Mapping[str, Mapping[str, Sequence[tuple[str, float]]]], path: Path) -> None:
    """Speed-up over each baseline by scene, one panel per task, with a line at 1; the vertical axis
    is logarithmic.
    """

    def draw(ax: Any, title: str, kinds: Mapping[str, Sequence[tuple[str, float]]]) -> None:
        scenes = list(dict.fromkeys(scene for points in kinds.values() for scene, _ in points))
        markers = zip(cycle(MARKERS), kinds.items(), strict=False)
        for n, (marker, (label, points)) in enumerate(markers):
            beside = 0.3 * (n - (len(kinds) - 1) / 2)
            places = [(scenes.index(scene) + beside, times) for scene, times in points]
            style = {"marker": marker, "ms": 5, "linestyle": "", "alpha": 0.7, "label": label}
            ax.plot(*zip(*places, strict=True), **style)
        ax.axhline(1, color="0.3", lw=1)
        ax.set(xscale="linear", title=title, ylabel="speed-up")
        ax.set_xticks(range(len(scenes)), scenes, rotation=30, ha="right")

    _figure(panels, path, draw)


def _legend(label: str) -> str:
    """A label of a part and its options as legends show it."""
    return " ".join(LEGEND.get(word, word) for word in label.split())


def _figure(
    panels: Mapping[str, Any], path: Path, draw: Callable[[Any, str, Any], None], title: str = ""
) -> None:
    if not panels:
        return
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    # as wide as a page, so that text keeps its size in print
    figure = Figure(figsize=(3.7 * columns, 3.3 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for ax, (name, panel) in zip(axes, panels.items(), strict=False):
        ax.set(xscale="log", yscale="log")
        ax.grid(True, which="both", linewidth=0.3)
        draw(ax, name, panel)
        for axis in (ax.xaxis, ax.yaxis):
            if axis.get_scale() == "log":
                _label(axis)
    for spare in axes[len(panels) :]:
        spare.remove()
    if title:
        figure.suptitle(title)
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    figure.savefig(path, dpi=130, format="png")


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
