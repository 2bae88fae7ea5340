"""Methods of several runs in one table: for a terminal, as Markdown, CSV and LaTeX."""

import csv
import io
import math
import re
import statistics
from collections.abc import Sequence
from typing import NamedTuple

from rich import box
from rich.table import Table

from mvrecon.report.comparison.rows import Row


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
