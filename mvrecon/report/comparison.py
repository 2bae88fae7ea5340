"""Comparison of methods across finished runs: tables for a terminal, Markdown, CSV and LaTeX, and a
picture of error against time.
"""

import csv
import io
import math
import re
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.table import Table

from mvrecon.core.files.checks import Refused, file_errors, shown, yaml_of
from mvrecon.core.files.runs import EVALUATION, RESULTS, SETTINGS, Results, flatten, read_results

#: Figures of merit to compare.
COMPARED_FIGURES = ("psnr", "ssim", "nrmse", "view_nrmse")
#: Settings to ignore, and the maximum number of settings in a run's name.
IGNORED_SETTINGS = ("name", "label", "resume", "plugins", "checkpoint", "save")
MAX_NAMED_SETTINGS = 4
#: Settings that determine the test scenes.
SCENE_SETTINGS = ("scene", "test_scene", "data", "checkpoint")
#: Relative difference of a case's truth between machines, at most.
MAX_TRUTH_DIFFERENCE = 1e-4
#: Maximum characters of a value in a run's name; longer values are numbered.
MAX_VALUE_CHARACTERS = 32


@dataclass(frozen=True)
class Row:
    """One method of one run, with its figures on the test scenes.

    Args:
        run: name of the run, its differences from the others.
        method: label of the method in the run.
        scenes: names of the test scenes, a patient each.
        truths: mean and root mean square of each true volume; empty in tables of earlier versions.
        measured: settings of the test scenes and the grid.
        data_range: range of the true values, of which PSNR and SSIM are; nan: unknown.
        figures: figures of merit by name, a value for each scene; nan for a failed volume.
        failed: number of scenes whose volume holds NaN or infinity.
        ms: milliseconds of one reconstruction.
        train_seconds: duration of training, in s.
        parameters: number of weights.
        peak_mb: memory of a reconstruction, in units of 2^20 bytes; nan: unknown.
        folder: folder of the run.
    """

    run: str
    method: str
    scenes: tuple[str, ...]
    truths: tuple[tuple[float, ...], ...]
    measured: Mapping[str, Any]
    data_range: float
    figures: Mapping[str, tuple[float, ...]]
    failed: int
    ms: float
    train_seconds: float
    parameters: int
    peak_mb: float
    folder: Path

    def mean(self, metric: str) -> float:
        """Mean of a figure over all scenes; nan if the method has failed in one."""
        values = self.figures[metric]
        return sum(values) / len(values) if values else math.nan


def read(places: Iterable[str | Path]) -> list[Row]:
    """Read the methods of all finished runs at some paths: run folders, or folders with runs in
    them.

    Raises:
        FileNotFoundError: a path without a finished run.
        Refused: a file that is not a run's; tables without a method.
    """
    folders: dict[Path, None] = {}
    for place in places:
        found = sorted(Path(place).expanduser().rglob(RESULTS))
        if not found:
            raise FileNotFoundError(
                f"Expected a finished run (with {RESULTS}) in {place}, got none"
            )
        folders |= dict.fromkeys(path.parent for path in found)
    rows: list[Row] = []
    for folder, name in zip(folders, _names(list(folders)), strict=True):
        table = read_results(folder)
        with file_errors(folder / RESULTS, "is no table of results"):
            rows += rows_of(table, name, folder)
    if not rows:
        raise Refused(f"{', '.join(map(str, folders))}: expected tables of methods, got none")
    return rows


def rows_of(table: Results, run: str, folder: Path) -> Iterator[Row]:
    """The methods of a result table, under a run's name."""
    stated = {"test_scene": table["scene"]} if "scene" in table else {}
    settings = {**_settings(folder), **_by_name(stated)}
    measured = {k: v for k, v in settings.items() if k.split(".")[0] in SCENE_SETTINGS}
    truths = tuple((_number(mean), _number(rms)) for mean, rms in table.get("truths", ()))
    of_scenes = [table["scenes"], truths or table["scenes"]]
    for label, row in table["methods"].items():
        figures = {key: tuple(map(_number, row[key]["values"])) for key in COMPARED_FIGURES}
        if (lengths := {*map(len, (*of_scenes, *figures.values()))}) != {len(table["scenes"])}:
            raise ValueError(f"expected a value for each scene, got {sorted(lengths)} values")
        yield Row(
            run=run,
            method=str(label),
            scenes=tuple(map(str, table["scenes"])),
            truths=truths,
            measured={"grid": table.get("grid"), **measured},
            data_range=_number(table.get("data_range")),
            figures=figures,
            failed=sum(map(math.isnan, figures["ssim"])),  # a finite volume always has an SSIM
            ms=_number(row["ms_per_volume"]),
            train_seconds=_number(row["train_seconds"]),
            parameters=int(row["parameters"]),
            peak_mb=_number(row.get("peak_mb")),
            folder=folder,
        )


def _number(value: float | str | None) -> float:
    """A number of a table, in which nan is null, and infinity a text."""
    return math.nan if value is None else float(value)


def _names(folders: Sequence[Path]) -> list[str]:
    """Name each run by its sweep's overrides, without ++; else by its differing settings, or its
    folder without any; the path of the folder tells equal names apart. If a value is too long for a
    name, the setting's values are numbered.
    """
    of_sweep = [folder.name for folder in folders]
    if len(set(of_sweep)) == len(folders) > 1 and all("=" in name for name in of_sweep):
        return [re.sub(r"(^|,)\+\+", r"\1", name) for name in of_sweep]
    settings = [_settings(folder) for folder in folders]
    keys = dict.fromkeys(key for s in settings for key in s)
    differing = [key for key in keys if len({repr(s.get(key)) for s in settings}) > 1]
    parts = tuple(key.removesuffix("name") for key in differing if key.endswith(".name"))
    # without options of a part that differs itself
    telling = [key for key in differing if key.endswith(".name") or not key.startswith(parts)]
    named: list[list[str]] = [[] for _ in folders]
    for key in telling[:MAX_NAMED_SETTINGS]:
        texts = [str(s.get(key)) for s in settings]
        if max(map(len, texts)) > MAX_VALUE_CHARACTERS:
            numbers = {text: f"#{k}" for k, text in enumerate(dict.fromkeys(texts), 1)}
            texts = [numbers[text] for text in texts]
        for name, s, text in zip(named, settings, texts, strict=True):
            if key in s:
                name.append(f"{key.removesuffix('.name')}={text}")
    names = [", ".join(name) or folder.name for name, folder in zip(named, folders, strict=True)]
    return [
        name if names.count(name) == 1 else f"{name} ({folder})"
        for name, folder in zip(names, folders, strict=True)
    ]


def _settings(folder: Path) -> dict[str, Any]:
    """Settings of a run by their full names, such as "method.name"."""
    path = next(
        (folder / name for name in (EVALUATION, SETTINGS) if (folder / name).is_file()), None
    )
    settings = yaml_of(path) if path else {}
    if not isinstance(settings, Mapping):
        raise Refused(f"{path}: expected settings by name, got {shown(settings)}")
    return _by_name({key: v for key, v in settings.items() if key not in IGNORED_SETTINGS})


def _by_name(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their full names; none of an empty mapping."""
    return {".".join(map(str, keys)): value for keys, value in flatten(settings) if keys}


class Interval(NamedTuple):
    """A mean and its confidence interval; nan bounds for fewer than two values, or a mean that is
    not finite.
    """

    mean: float
    low: float
    high: float


def mean_interval(values: Sequence[float]) -> Interval:
    """Return the mean of independent normal values and its 95 % confidence interval (Student 1908).

    The mean is nan if any value is, and for no value.
    """
    mean = sum(values) / len(values) if values else math.nan
    if len(values) < 2 or not math.isfinite(mean):
        return Interval(mean, math.nan, math.nan)
    error = statistics.stdev(values) / math.sqrt(len(values))
    half = t_quantile(0.95, len(values) - 1) * error
    return Interval(mean, mean - half, mean + half)


def t_quantile(level: float, freedom: int) -> float:
    """Return the t for which |T| < t has a probability of `level`, with Student's T of `freedom`
    degrees of freedom.

    Raises:
        ValueError: a level outside (0, 1), or less than one degree of freedom.
    """
    if not 0 < level < 1 or freedom < 1:
        raise ValueError(f"Expected 0 < level < 1 and freedom >= 1, got {level} and {freedom}")
    low, high = 0.0, math.pi / 2  # of atan(t / sqrt(freedom))
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _probability(middle, freedom) < level else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def _probability(angle: float, freedom: int) -> float:
    """P(|T| < t) for t = sqrt(freedom) tan(angle): a finite sum (Abramowitz & Stegun 1964, 26.7.3
    and 26.7.4).
    """
    odd, term, total = freedom % 2, 1.0, 0.0
    for k in range((freedom - odd) // 2):
        total += term
        term *= math.cos(angle) ** 2 * (2 * k + 1 + odd) / (2 * k + 2 + odd)
    if odd:
        return 2 / math.pi * (angle + math.sin(angle) * math.cos(angle) * total)
    return math.sin(angle) * total


LATEX_SPECIAL = re.compile(r"([&%$#_{}])")


class Cells(NamedTuple):
    """Headings and rows of texts."""

    head: Sequence[str]
    body: Sequence[Sequence[str]]


def difference(row: Row, reference: Row, metric: str) -> Interval:
    """Mean paired difference of a figure to the reference over their common scenes, with its 95 %
    confidence interval; nan if one of the two has failed in such a scene.

    Raises:
        Refused: as `common_scenes`.
    """
    own, others = row.figures[metric], reference.figures[metric]
    both = [(own[i], others[j]) for i, j in common_scenes(row, reference)]
    return mean_interval([0.0 if v == other else v - other for v, other in both])  # inf, too


def common_scenes(row: Row, reference: Row) -> list[tuple[int, int]]:
    """Positions of the scenes that two methods have in common.

    None are where the figures are of different data ranges: twice the range alone is 6 dB. Scenes
    of one table, or of two with the same test scenes, are in the same order. Others are recognised
    by their names and, on the same grid, by their true volumes, else by equal settings of the
    scenes where both tables have some: patients of two sites may have one name.

    Raises:
        Refused: several scenes of one name, which a table of an earlier version does not tell
            apart.
    """
    if row.folder == reference.folder:
        return [(k, k) for k in range(len(row.scenes))]
    ranges = row.data_range, reference.data_range
    if not any(map(math.isnan, ranges)) and not math.isclose(*ranges):
        return []
    known = row.truths and reference.truths
    told_apart = known and row.measured["grid"] == reference.measured["grid"]
    if not told_apart and (row.scenes, row.measured) == (reference.scenes, reference.measured):
        return [(k, k) for k in range(len(row.scenes))]
    one, other = _scenes(row), _scenes(reference)
    pairs: list[tuple[int, int]] = []
    for i, name in enumerate(row.scenes):
        same = [j for j, theirs in enumerate(reference.scenes) if theirs == name]
        if told_apart:
            same = [j for j in same if _close(row.truths[i], reference.truths[j])]
        elif len(same) > 1 or (same and row.scenes.count(name) > 1):
            raise Refused(
                f"{row.folder} and {reference.folder}: several test scenes are named "
                f"{shown(name)}, and the tables do not tell them apart; expected tables on one "
                f"grid that mvrecon-eval has written anew"
            )
        elif one and other and one != other:
            same = []
        taken = {j for _, j in pairs}  # a case that is there twice is paired in order
        pairs += [(i, j) for j in same if j not in taken][:1]
    return pairs


def _scenes(row: Row) -> dict[str, Any]:
    """The settings of the test scenes alone, as far as the table tells them."""
    key = "test_scene" if row.measured.get("test_scene.name") else "scene"
    return {k.partition(".")[2]: v for k, v in row.measured.items() if k.split(".")[0] == key}


def _close(one: Sequence[float], other: Sequence[float]) -> bool:
    return all(
        math.isclose(a, b, rel_tol=MAX_TRUTH_DIFFERENCE) for a, b in zip(one, other, strict=True)
    )


def cells(rows: Sequence[Row], reference: Row, metric: str = "psnr") -> Cells:
    """Build the table as texts: means over the scenes, or the number of failed volumes; the
    differences of one figure to the reference, milliseconds of a reconstruction, its memory,
    weights and seconds of training.
    """
    from mvrecon.report.metrics import declared  # imports torch

    shown = {name: declared(name) for name in COMPARED_FIGURES}
    names = [one.heading for one in shown.values()]
    change = f"{metric} - reference (95 %)"
    head = ["run", "method", *names, change, "ms", "MB", "weights", "training s"]
    body = []
    for row in rows:
        means = [_text(row.mean(name), one.format) for name, one in shown.items()]
        if row.failed:
            means = [f"{row.failed} of {len(row.scenes)} failed"] * len(means)
        same = row is reference
        form = shown[metric].format
        apart = "reference" if same else _interval(difference(row, reference, metric), form)
        costs = [_text(row.ms, ".1f"), _text(row.peak_mb, ".0f"), str(row.parameters)]
        body.append([row.run, row.method, *means, apart, *costs, _text(row.train_seconds, ".0f")])
    return Cells(head, body)


def terminal(table: Cells) -> Table:
    """Format for a terminal."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for k, heading in enumerate(table.head):
        shown.add_column(heading, justify="left" if k < 2 else "right", overflow="fold")
    for row in table.body:
        shown.add_row(*(cell.replace("[", r"\[") for cell in row))
    return shown


def markdown(table: Cells, texts: int = 2) -> str:
    """Format as Markdown; all columns but the first `texts` are set to the right."""
    rule = ["---"] * texts + ["---:"] * (len(table.head) - texts)
    lines = [[cell.replace("|", r"\|") for cell in row] for row in (table.head, rule, *table.body)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def comma_separated(rows: Sequence[Row], reference: Row) -> str:
    """Format as CSV in full precision: a line for each method, with the bounds of all
    differences.
    """
    file = io.StringIO()
    parts = ("mean", "difference", "low", "high")
    heads = [f"{metric} {part}" for metric in COMPARED_FIGURES for part in parts]
    costs = ["ms", "peak_mb", "parameters", "train_seconds", "folder"]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["run", "method", "scenes", "failed", *heads, *costs])
    for row in rows:
        numbers = [
            v
            for name in COMPARED_FIGURES
            for v in (row.mean(name), *difference(row, reference, name))
        ]
        ends = [row.ms, row.peak_mb, row.parameters, row.train_seconds, row.folder]
        writer.writerow([row.run, row.method, len(row.scenes), row.failed, *numbers, *ends])
    return file.getvalue()


def latex(table: Cells) -> str:
    """Format as a LaTeX tabular, without packages."""
    lines = [" & ".join(_latex(cell) for cell in row) + r" \\" for row in table.body]
    head = " & ".join(_latex(cell) for cell in table.head) + r" \\ \hline"
    columns = "ll" + "r" * (len(table.head) - 2)
    return "\n".join([rf"\begin{{tabular}}{{{columns}}}", head, *lines, r"\end{tabular}", ""])


def _latex(text: str) -> str:
    plain = text.replace("\\", "/").replace("~", " ").replace("^", " ")
    return LATEX_SPECIAL.sub(r"\\\1", plain)


def _text(value: float, form: str) -> str:
    return "-" if math.isnan(value) else f"{value:{form}}"


def _interval(by: Interval, form: str) -> str:
    if math.isnan(by.mean):
        return "-"
    bounds = f" ({by.low:+{form}} to {by.high:+{form}})"
    return f"{by.mean:+{form}}" + ("" if math.isnan(by.low) else bounds)


def front(rows: Sequence[Row], metric: str) -> list[Row]:
    """The Pareto front: methods that no other beats in both time and error, fastest first; excludes
    those that have failed in a scene.
    """
    best, chosen = math.inf, []
    for row in sorted(rows, key=lambda row: (row.ms, _loss(row, metric))):
        if _loss(row, metric) < best:
            best = _loss(row, metric)
            chosen.append(row)
    return chosen


def picture(rows: Sequence[Row], metric: str = "psnr") -> str:
    """Plot every method's finite figure of merit against its milliseconds (logarithmic), with the
    Pareto front as a line; SVG. Without any, as of runs whose volumes all failed, it is empty.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    timed = [row for row in rows if row.ms > 0]
    shown = [row for row in timed if math.isfinite(row.mean(metric))]
    drawing = Figure((8, 4.5), layout="constrained")
    axes = drawing.add_subplot(xscale="log", xlabel="time of a reconstruction, ms", ylabel=metric)
    best = [row for row in front(timed, metric) if row in shown]
    axes.plot([r.ms for r in best], [r.mean(metric) for r in best], "--", color="#cc4444")
    for row in shown:
        at = row.ms, row.mean(metric)
        axes.plot(*at, "o", color="#2266cc", gid="method")
        label = f"{row.method} ({row.run})" if len({r.run for r in rows}) > 1 else row.method
        axes.annotate(label, at, (5, 3), textcoords="offset points", fontsize=8, parse_math=False)
    file = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "mvrecon"}):
        FigureCanvasSVG(drawing).print_svg(file, metadata={"Date": None})
    return file.getvalue()


def _loss(row: Row, metric: str) -> float:
    from mvrecon.report.metrics import declared  # imports torch

    mean = row.mean(metric)
    if math.isnan(mean):
        return math.inf
    return -mean if declared(metric).higher_is_better else mean
