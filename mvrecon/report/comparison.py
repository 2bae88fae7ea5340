"""The result table of a run on a terminal, and methods of several finished runs beside each
other: for a terminal, as Markdown, CSV and LaTeX, and as a picture of error against time.
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
from rich.console import Console
from rich.table import Table

from mvrecon.core.files.checks import Refused, file_errors, shown, yaml_of
from mvrecon.core.files.runs import EVALUATION, RESULTS, SETTINGS, flatten, read_results
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.report.metrics import sentence

#: Figures of merit that are compared; larger is better for those of `RISING`.
FIGURES, RISING = ("psnr", "ssim", "nrmse", "view_nrmse"), ("psnr", "ssim")
#: Settings that say nothing of what is compared, and the most that make up a run's name.
SILENT, NAMED = ("name", "label", "resume", "plugins", "checkpoint", "save"), 4
#: Characters of a value in a run's name, at most; values that are longer are numbered.
LONG = 32


@dataclass(frozen=True)
class Row:
    """One method of one run, judged on its test scenes.

    Args:
        run: what differs from the other runs.
        method: its label in the run.
        scenes: names of the test scenes, a patient each.
        figures: of merit by name, a value for each scene; nan where the volume has failed.
        failed: number of scenes whose volume holds NaN or infinity.
        ms: milliseconds of one reconstruction.
        train_seconds: of training.
        parameters: number of weights.
        peak_mb: memory that a reconstruction needs, in units of 2^20 bytes; nan: not known.
        folder: of the run.
    """

    run: str
    method: str
    scenes: tuple[str, ...]
    figures: Mapping[str, tuple[float, ...]]
    failed: int
    ms: float
    train_seconds: float
    parameters: int
    peak_mb: float
    folder: Path

    def mean(self, figure: str) -> float:
        """Mean of a figure over all scenes; nan where the method has failed in one."""
        values = self.figures[figure]
        return sum(values) / len(values) if values else math.nan


def read(places: Iterable[str | Path]) -> list[Row]:
    """The methods of all finished runs at some places: run folders, or folders with runs in them.

    Raises:
        FileNotFoundError: a place without a finished run.
        Refused: a file that is none of a run's.
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
    return rows


def rows_of(table: Mapping[str, Any], run: str, folder: Path) -> Iterator[Row]:
    """The methods of a table of results, under a run's name."""
    for label, row in table["methods"].items():
        figures = {key: tuple(map(_number, row[key]["values"])) for key in FIGURES}
        yield Row(
            run=run,
            method=str(label),
            scenes=tuple(map(str, table["scenes"])),
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
    """Each run as its sweep calls it; else by the settings that differ, or by its folder where none
    does. Where a value is too long for a name, all of that setting's are numbered.
    """
    of_sweep = [folder.name for folder in folders]
    if len(set(of_sweep)) == len(folders) > 1 and all("=" in name for name in of_sweep):
        return of_sweep
    settings = [_settings(folder) for folder in folders]
    keys = dict.fromkeys(key for s in settings for key in s)
    differing = [key for key in keys if len({repr(s.get(key)) for s in settings}) > 1]
    parts = tuple(key.removesuffix("name") for key in differing if key.endswith(".name"))
    # not the options of a part that differs itself
    telling = [key for key in differing if key.endswith(".name") or not key.startswith(parts)]
    named: list[list[str]] = [[] for _ in folders]
    for key in telling[:NAMED]:
        texts = [str(s.get(key)) for s in settings]
        if max(map(len, texts)) > LONG:
            numbers = {text: f"#{k}" for k, text in enumerate(dict.fromkeys(texts), 1)}
            texts = [numbers[text] for text in texts]
        for name, s, text in zip(named, settings, texts, strict=True):
            if key in s:
                name.append(f"{key.removesuffix('.name')}={text}")
    return [", ".join(name) or folder.name for name, folder in zip(named, folders, strict=True)]


def _settings(folder: Path) -> dict[str, Any]:
    """Settings of a run by their full names, such as "method.name"."""
    path = next(
        (folder / name for name in (EVALUATION, SETTINGS) if (folder / name).is_file()), None
    )
    settings = yaml_of(path) if path else {}
    if not isinstance(settings, Mapping):
        raise Refused(f"{path}: expected settings by name, got {shown(settings)}")
    kept = {key: value for key, value in settings.items() if key not in SILENT}
    return {".".join(map(str, keys)): value for keys, value in flatten(kept)}


class Interval(NamedTuple):
    """A mean with the bounds of its confidence interval; bounds are nan for fewer than two values,
    and where the mean is not finite.
    """

    mean: float
    low: float
    high: float


def mean_interval(values: Sequence[float], level: float = 0.95) -> Interval:
    """The mean of independent values and the interval that holds their expectation with a
    probability of `level`, for values of a normal distribution (Student 1908).

    No value is left out: the mean is nan where one is, and for none.
    """
    mean = sum(values) / len(values) if values else math.nan
    if len(values) < 2 or not math.isfinite(mean):
        return Interval(mean, math.nan, math.nan)
    error = statistics.stdev(values) / math.sqrt(len(values))
    half = t_quantile(level, len(values) - 1) * error
    return Interval(mean, mean - half, mean + half)


def t_quantile(level: float, freedom: int) -> float:
    """The t for which |T| < t has a probability of `level`, T of Student's distribution with
    `freedom` degrees of freedom.

    Raises:
        ValueError: a level that is not between 0 and 1, or no degree of freedom.
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


DIGITS = {"psnr": 2, "ssim": 4, "nrmse": 4, "view_nrmse": 4}
LATEX = re.compile(r"([&%$#_{}])")


class Cells(NamedTuple):
    """Headings and rows of texts."""

    head: list[str]
    body: list[list[str]]


def difference(row: Row, reference: Row, figure: str) -> Interval:
    """Mean difference of a figure to the reference on the scenes that both were judged on, paired
    scene by scene, with its 95 % confidence interval over the scenes; nan where one of the two has
    failed in such a scene.
    """
    of_reference = dict(zip(reference.scenes, reference.figures[figure], strict=True))
    pairs = zip(row.scenes, row.figures[figure], strict=True)
    both = [(v, of_reference[scene]) for scene, v in pairs if scene in of_reference]
    return mean_interval([0.0 if v == other else v - other for v, other in both])  # inf, too


def cells(rows: Sequence[Row], reference: Row, figure: str = "psnr") -> Cells:
    """The table as texts: means over the scenes, or how many of a method's volumes have failed; the
    differences of one figure to the reference, milliseconds of a reconstruction, its memory,
    weights and seconds of training.
    """
    names = ["PSNR dB", "SSIM", "NRMSE", "view NRMSE"]
    change = f"{figure} - reference (95 %)"
    head = ["run", "method", *names, change, "ms", "MB", "weights", "training s"]
    body = []
    for row in rows:
        means = [_text(row.mean(name), digits) for name, digits in DIGITS.items()]
        if row.failed:
            means = [f"{row.failed} of {len(row.scenes)} failed"] * len(means)
        same = row is reference
        apart = "reference" if same else _interval(difference(row, reference, figure), figure)
        costs = [_text(row.ms, 1), _text(row.peak_mb, 0), str(row.parameters)]
        body.append([row.run, row.method, *means, apart, *costs, _text(row.train_seconds, 0)])
    return Cells(head, body)


def terminal(table: Cells) -> Table:
    """For a terminal."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for k, heading in enumerate(table.head):
        shown.add_column(heading, justify="left" if k < 2 else "right", overflow="fold")
    for row in table.body:
        shown.add_row(*(cell.replace("[", r"\[") for cell in row))
    return shown


def markdown(table: Cells) -> str:
    """As Markdown."""
    rule = ["---", "---", *["---:"] * (len(table.head) - 2)]
    lines = [[cell.replace("|", r"\|") for cell in row] for row in (table.head, rule, *table.body)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def comma_separated(rows: Sequence[Row], reference: Row) -> str:
    """As CSV with all digits: a line for each method, with the bounds of every difference."""
    file = io.StringIO()
    parts = ("mean", "difference", "low", "high")
    heads = [f"{figure} {part}" for figure in DIGITS for part in parts]
    costs = ["ms", "peak_mb", "parameters", "train_seconds", "folder"]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["run", "method", "scenes", "failed", *heads, *costs])
    for row in rows:
        numbers = [
            v for name in DIGITS for v in (row.mean(name), *difference(row, reference, name))
        ]
        ends = [row.ms, row.peak_mb, row.parameters, row.train_seconds, row.folder]
        writer.writerow([row.run, row.method, len(row.scenes), row.failed, *numbers, *ends])
    return file.getvalue()


def latex(table: Cells) -> str:
    """As LaTeX's tabular, without a package."""
    lines = [" & ".join(_latex(cell) for cell in row) + r" \\" for row in table.body]
    head = " & ".join(_latex(cell) for cell in table.head) + r" \\ \hline"
    columns = "ll" + "r" * (len(table.head) - 2)
    return "\n".join([rf"\begin{{tabular}}{{{columns}}}", head, *lines, r"\end{tabular}", ""])


def _latex(text: str) -> str:
    plain = text.replace("\\", "/").replace("~", " ").replace("^", " ")
    return LATEX.sub(r"\\\1", plain)


def _text(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _interval(by: Interval, figure: str) -> str:
    if math.isnan(by.mean):
        return "-"
    digits = DIGITS[figure]
    bounds = f" ({by.low:+.{digits}f} to {by.high:+.{digits}f})"
    return f"{by.mean:+.{digits}f}" + ("" if math.isnan(by.low) else bounds)


def front(rows: Sequence[Row], figure: str) -> list[Row]:
    """The methods that no other one beats in both time and error, the fastest first; never one that
    has failed in a scene.
    """
    best, chosen = math.inf, []
    for row in sorted(rows, key=lambda row: (row.ms, _loss(row, figure))):
        if _loss(row, figure) < best:
            best = _loss(row, figure)
            chosen.append(row)
    return chosen


def picture(rows: Sequence[Row], figure: str = "psnr") -> str:
    """Every method at its milliseconds (logarithmic) and its figure of merit where that is finite,
    with a line along those that none other beats in both; SVG.

    Raises:
        ValueError: no method with a time and a figure.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    timed = [row for row in rows if row.ms > 0]
    shown = [row for row in timed if math.isfinite(row.mean(figure))]
    if not shown:
        raise ValueError(f"Expected methods with a time and a {figure}, got none")
    drawing = Figure((8, 4.5), layout="constrained")
    axes = drawing.add_subplot(xscale="log", xlabel="time of a reconstruction, ms", ylabel=figure)
    best = [row for row in front(timed, figure) if row in shown]
    axes.plot([r.ms for r in best], [r.mean(figure) for r in best], "--", color="#cc4444")
    for row in shown:
        at = row.ms, row.mean(figure)
        axes.plot(*at, "o", color="#2266cc", gid="method")
        label = f"{row.method} ({row.run})" if len({r.run for r in rows}) > 1 else row.method
        axes.annotate(label, at, (5, 3), textcoords="offset points", fontsize=8, parse_math=False)
    file = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "mvrecon"}):
        FigureCanvasSVG(drawing).print_svg(file, metadata={"Date": None})
    return file.getvalue()


def _loss(row: Row, figure: str) -> float:
    mean = row.mean(figure)
    if math.isnan(mean):
        return math.inf
    return -mean if figure in RISING else mean


WIDTH = 114
COLUMNS = {
    "psnr": ("PSNR\ndB", "{:.2f}"),
    "ssim": ("SSIM\n", "{:.3f}"),
    "nrmse": ("NRMSE\n", "{:.3f}"),
    "psnr_inside": ("PSNR\ninside", "{:.2f}"),
    "ssim_inside": ("SSIM\ninside", "{:.3f}"),
    "nrmse_inside": ("NRMSE\ninside", "{:.3f}"),
    "view_nrmse": ("view\nNRMSE", "{:.3f}"),
}


def table(results: Mapping[str, Any]) -> Table:
    """The result table for a terminal: mean over the scenes, and the standard deviation below
    it; in their place, how many volumes of a method have failed.
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
    title = f"{results['name']}: {count} {scenes}"
    shown = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    shown.add_column("method\n", no_wrap=True)
    shown.add_column("parameters\n", justify="right", no_wrap=True)
    brought = {name: (f"{name}\n", "{:.4g}") for name in results.get("brought", ())}
    columns = COLUMNS | brought
    for heading, _ in columns.values():
        shown.add_column(heading, justify="right")
    shown.add_column("ms per\nvolume", justify="right")
    shown.add_column("training\ns", justify="right")
    for label, row in results["methods"].items():
        if failed := row.get("failed"):
            cells = [f"{len(failed)} of {len(results['scenes'])}\nfailed"] * len(columns)
        else:
            cells = [_cell(row[name], form) for name, (_, form) in columns.items()]
        seconds = f"{row['train_seconds']:.0f}" if row["train_steps"] else "-"
        shown.add_row(
            label, f"{row['parameters']:,}", *cells, f"{row['ms_per_volume']:.1f}", seconds
        )
    return shown


def show(results: Mapping[str, Any], folder: Path) -> None:
    """Print the table, never squeezed: a terminal that is too narrow for it wraps its lines."""
    console = Console(width=max(Console().width, WIDTH))
    console.print(table(results))
    for line in remarks(results):
        console.print(line, soft_wrap=True)
    console.print(f"Kept in {folder}", soft_wrap=True)


def remarks(results: Mapping[str, Any]) -> list[str]:
    """What a reader of the table must know of the measurement: a detector that is not perfect,
    volumes that have failed, and cases that are in two sets.
    """
    lines, got = [], results.get("acquisition")
    if got and (errors := _detector_errors(got)):
        lines.append(f"The views' detector: {errors}")
    run = results.get("acquisition_of_run", got)
    # a run's settings leave out what is usual
    if got and Acquisition.of(run) != Acquisition.of(got):
        lines.append(f"The run's detector was another: {_detector_errors(run) or 'perfect'}")
    for label, row in results.get("methods", {}).items():
        if failed := row.get("failed"):
            lines.append(f"{label} failed, with NaN or infinity in the volume: {', '.join(failed)}")
        elif words := sentence(row.get("quality", {})):
            lines.append(f"{label}: {words}")
        if "auc" in (cameras := row.get("cameras", {})):
            lines.append(
                f"{label} tells which cameras are disturbed: AUC {cameras['auc']:.3f}; shifts "
                f"to {cameras['shift_rms_px']:.3f} pixels of {cameras['true_shift_rms_px']:.3f}, "
                f"gains to {cameras['gain_rms']:.2%} of {cameras['true_gain_rms']:.2%} "
                f"(root mean square)"
            )
    if results.get("overlap"):
        lines.append("data.overlap: training, validation and test share their cases")
    return lines


def _detector_errors(acquisition: Mapping[str, Any]) -> str:
    """The options of a detector that are not zero, without those that do nothing."""
    silent = {"fine", "closed_form"} | ({"scatter_mm"} if not acquisition["scatter"] else set())
    errors = acquisition.get("disturbed") or {}
    usual = {"probability": 1, **({"views": 1} if errors.get("lost") else {})}
    disturbed = {f"disturbed.{k}": v for k, v in errors.items() if v != usual.get(k)}
    shown = {**acquisition, "disturbed": 0, **disturbed}
    return ", ".join(f"{k} {v:g}" for k, v in shown.items() if v and k not in silent)


def _cell(figure: Mapping[str, Any], form: str) -> str:
    mean, spread = figure["mean"], figure["std"]
    return (
        form.format(mean) if math.isnan(spread) else f"{form.format(mean)}\n± {form.format(spread)}"
    )
