"""Run a benchmark: measure the missing rows of its table, then write the report."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from mvrecon.core.files.runs import SETTINGS
from mvrecon.training import run_folder
from mvrecon.training.callbacks import TensorBoard
from mvrecon_bench.benchmarks import machine
from mvrecon_bench.benchmarks.rows import Row, Rows, check_header

TABLE = "results.csv"


class Bench(Protocol):
    """One kind of benchmark.

    `columns`: name -> meaning and unit. `keys`: columns that identify a row. `charts`: columns
    plotted in TensorBoard.
    """

    columns: Mapping[str, str]
    keys: Sequence[str]
    charts: Sequence[str]

    def groups(self) -> Sequence[Sequence[Any]]:
        """The jobs, see `rows.Job`, in groups that are measured together."""
        ...

    def label(self, row: Row) -> str:
        """Short label of a row's part."""
        ...

    def measure(
        self, jobs: Sequence[Any], rows: Sequence[Row], say: Callable[[str], None]
    ) -> Iterator[Row]:
        """Yield a row for each job of a group; `rows` are existing rows, `say` reports progress."""
        ...

    def report(self, rows: Sequence[Row], folder: Path) -> Mapping[str, str]:
        """Write the plots (PNG) to the folder and return the Markdown texts by name."""
        ...


def run(bench: Bench, folder: Path) -> list[Row]:
    """Run a benchmark and return all rows, old and new.

    The folder contains `results.csv`, a Markdown file for each text of the report, plots,
    `versions.txt`, and TensorBoard logs of everything.
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


def check(bench: Bench, folder: Path) -> None:
    """Check that a folder is new or of such a benchmark, without writing anything.

    Raises:
        FileExistsError: it is another run's.
        ValueError: its table has other columns.
    """
    if (folder / TABLE).is_file():
        check_header(folder / TABLE, list(bench.columns))
    elif (folder / SETTINGS).is_file():
        raise FileExistsError(
            f"{folder} is another run's folder, with {SETTINGS} but without {TABLE}; choose "
            f"another one by hydra.run.dir=..."
        )


def draw(board: TensorBoard, bench: Bench, row: Row, step: int) -> None:
    """Log a row's figures as scalars, with its row number as step."""
    for name in bench.charts:
        if isinstance(figure := row.get(name), float):
            board.experiment.add_scalar(f"{name}/{bench.label(row)}", figure, step)


def report(bench: Bench, rows: Sequence[Row], folder: Path, board: TensorBoard) -> None:
    """Write the report's files and log them to TensorBoard."""
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
