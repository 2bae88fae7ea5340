"""The run of a benchmark: rows that its table lacks are measured, then the report is written."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from mvrecon.training import run_folder
from mvrecon.training.callbacks import TensorBoard
from mvrecon_bench.benchmarks import machine
from mvrecon_bench.benchmarks.rows import Row, Rows

TABLE = "results.csv"


class Job(Protocol):
    """One row to be."""

    @property
    def row(self) -> Row:
        """The columns that identify this row."""
        ...


class Bench(Protocol):
    """One kind of benchmark.

    `columns`: name -> meaning and unit. `keys`: those that identify a row. `charts`:
    those that the board draws.
    """

    columns: Mapping[str, str]
    keys: Sequence[str]
    charts: Sequence[str]

    def groups(self) -> Sequence[Sequence[Any]]:
        """The jobs, in groups of what is measured together."""
        ...

    def label(self, row: Row) -> str:
        """A row's part, short."""
        ...

    def measure(
        self, jobs: Sequence[Any], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """A row for each of the jobs of one group; `rows` are those there are, `say` tells what is
        being done.
        """
        ...

    def report(self, rows: Sequence[Row], folder: Path) -> Mapping[str, str]:
        """Write the pictures (PNG) into the folder; the Markdown texts by name."""
        ...


def run(bench: Bench, folder: Path) -> list[Row]:
    """All rows of a benchmark, old and new.

    The folder then holds `results.csv`, a Markdown file for each text of the report, its pictures,
    `versions.txt`, and all of it on the board (TensorBoard).
    """
    machine.write_versions(folder)
    table = Rows(folder / TABLE, list(bench.columns), bench.keys)
    board = TensorBoard(str(folder))
    groups = [[job for job in group if job.row not in table] for group in bench.groups()]
    bars = (
        TextColumn("{task.description}"),
        BarColumn(16),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*bars, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=sum(map(len, groups)))
        for jobs in filter(None, groups):
            for row in bench.measure(
                jobs, table.rows, lambda text: progress.update(task, description=text)
            ):
                draw(board, bench, table.append(row), len(table.rows))
                progress.advance(task)
    report(bench, table.rows, folder, board)
    return table.rows


def draw(board: TensorBoard, bench: Bench, row: Row, step: int) -> None:
    """A row's figures as scalars, at the row's number in the table."""
    for name in bench.charts:
        if isinstance(figure := row.get(name), float):
            board.experiment.add_scalar(f"{name}/{bench.label(row)}", figure, step)


def report(bench: Bench, rows: Sequence[Row], folder: Path, board: TensorBoard) -> None:
    """Write the report's files, and show them on the board."""
    import numpy as np
    from PIL import Image

    for name, text in bench.report(rows, folder).items():
        run_folder.write(folder / f"{name}.md", text)
        board.experiment.add_text(name, text, len(rows))
    for path in sorted(folder.glob("*.png")):
        with Image.open(path) as picture:
            board.experiment.add_image(
                path.stem, np.asarray(picture.convert("RGB")), len(rows), dataformats="HWC"
            )
    board.save()
    board.finalize("success")
