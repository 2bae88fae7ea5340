"""`mvrecon-compare`: compares finished runs, or the runs of a sweep, in one table.

Examples:

    mvrecon-compare outputs/quickstart/2026-01-31_12-00-00
    mvrecon-compare outputs/sweep outputs/eval --reference sirt --metric ssim --out paper

Differences are paired by test scene, with 95 % intervals. The table also has the time of a
reconstruction in ms, peak memory in MB, and seconds of training.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from rich.console import Console

from mvrecon.apps.command_line import command_line
from mvrecon.apps.config.errors import one_line
from mvrecon.core.files.atomic import check_writable, write_text
from mvrecon.core.files.runs import RESULTS
from mvrecon.core.registry import hint
from mvrecon.report import comparison
from mvrecon.report.comparison import COMPARED_FIGURES, read

#: Files of the table.
TABLE_FILES = ("compare.md", "compare.csv", "compare.tex", "pareto.svg")
#: Columns of a terminal that the table is made for.
TERMINAL_COLUMNS = 150


def compare(
    places: Sequence[str | Path],
    reference: str | None = None,
    metric: str = "psnr",
    out: str | Path | None = None,
) -> comparison.Cells:
    """The table of all methods of finished runs; with `out` also written there as `compare.md`,
    `compare.csv`, `compare.tex` and, error against time, `pareto.svg`.

    Args:
        places: run folders, or folders with runs in them.
        reference: label of the method that the others are compared with; None: the first.
        metric: figure of merit whose paired differences are shown, one of `COMPARED_FIGURES`.
        out: folder of the tables.

    Raises:
        FileNotFoundError: a place without a finished run.
        LookupError: no method of that label.
        Refused: a file that is not a run's.
        OSError: a file of `out` that cannot be written; none is.
    """
    if out is not None:
        for name in TABLE_FILES:
            check_writable(Path(out) / name)
    rows = read(places)
    labels = {row.method for row in rows}
    if reference is not None and reference not in labels:
        raise LookupError(f"No method is labelled {reference!r}{hint(reference, labels)}")
    first = next(row for row in rows if reference in (None, row.method))
    table = comparison.cells(rows, first, metric)
    if out is not None:
        texts = (
            comparison.markdown(table),
            comparison.comma_separated(rows, first),
            comparison.latex(table),
            comparison.picture(rows, metric),
        )
        for name, text in zip(TABLE_FILES, texts, strict=True):
            write_text(Path(out) / name, text)
    return table


def show(table: comparison.Cells) -> None:
    """Print the table, never squeezed: a terminal that is too narrow for it wraps its lines."""
    console = Console(width=max(Console().width, TERMINAL_COLUMNS))
    console.print(comparison.terminal(table))


class SweepTable(Callback):
    """Compares the runs of a sweep at its end, in its folder and on the terminal."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """The table, if any run of the sweep has results."""
        folder = Path(config.hydra.sweep.dir)
        if next(folder.rglob(RESULTS), None) is not None:
            show(compare([folder], out=folder))
            Console().print(f"Kept in {folder}", soft_wrap=True, markup=False)


def parser() -> argparse.ArgumentParser:
    """The command line of `mvrecon-compare`."""
    made = command_line("mvrecon-compare", __doc__)
    made.add_argument("runs", nargs="+", metavar="RUN", help="Run folders, or folders of sweeps.")
    made.add_argument(
        "--reference",
        metavar="METHOD",
        help="Compares the others with this method, of the first run that has it (default: the "
        "first method of the first run).",
    )
    made.add_argument(
        "--metric",
        choices=COMPARED_FIGURES,
        default="psnr",
        help="Shows the paired differences of this metric; PSNR is in dB (default: %(default)s).",
    )
    made.add_argument(
        "--out",
        metavar="FOLDER",
        help="Also writes compare.md, compare.csv, compare.tex and pareto.svg into this folder.",
    )
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `mvrecon-compare`."""
    options = parser().parse_args(arguments)
    with one_line("mvrecon-compare"):
        show(compare(options.runs, options.reference, options.metric, options.out))


if __name__ == "__main__":
    main()
