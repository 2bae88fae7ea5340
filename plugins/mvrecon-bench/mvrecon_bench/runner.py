"""Run a benchmark: measure the missing rows of its table, then write the report."""

import os
import platform
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from mvrecon.core.files.atomic import claimed, write_text
from mvrecon.core.files.runs import SETTINGS
from mvrecon.report.comparison import Cells, markdown
from mvrecon.training import run_folder
from mvrecon.training.callbacks import TensorBoard
from mvrecon_bench.rows import Bench, Row, Rows, check_header, figure

TABLE = "results.csv"
#: Distributions of the other compared libraries.
PEERS = (
    *("itk-rtk", "nanodrr", "diffdrr", "astra-toolbox", "mbirtorch", "scikit-image"),
    *("mvrecon-peers", "matplotlib"),
)


def run(bench: Bench, folder: Path, settings: dict[str, Any] | None = None) -> list[Row]:
    """Run or resume a benchmark and return all rows, old and new.

    The folder contains `results.csv`, `table.md`, plots, `config.yaml`, `versions.txt`, and
    TensorBoard logs of everything.

    Raises:
        RuntimeError: another process uses the folder.
        FileExistsError: the folder is another run's.
        ValueError: its table has other columns.
        PermissionError: it contains anything but files and folders.
    """
    columns = list(bench.columns)
    if (folder / TABLE).is_file():
        check_header(folder / TABLE, columns)
    elif (folder / SETTINGS).is_file():
        raise FileExistsError(
            f"{folder} is another run's folder, with {SETTINGS} but without {TABLE}; choose "
            f"another one by hydra.run.dir=..."
        )
    with claimed(folder):
        table = Rows(folder / TABLE, columns, bench.keys)  # first: it marks the folder as its own
        if settings is not None:
            run_folder.start(folder, settings)
        versions = "".join(f"{name} {version}\n" for name, version in machine().items())
        write_text(folder / run_folder.VERSIONS, versions)
        board = TensorBoard(str(folder))
        groups = [[job for job in group if job.row not in table] for group in bench.groups()]
        bars = TextColumn("{task.description}"), BarColumn(16), MofNCompleteColumn()
        console = Console(stderr=True)
        with Progress(*bars, TimeElapsedColumn(), console=console, transient=True) as progress:
            task = progress.add_task("", total=sum(map(len, groups)))

            def say(text: str) -> None:
                progress.update(task, description=text)

            for jobs in filter(None, groups):
                for new in bench.measure(jobs, say):
                    row = table.append(new)
                    for name in bench.charts:
                        if isinstance(figure := row.get(name), float):
                            name = f"{name}/{bench.label(row)}"
                            board.experiment.add_scalar(name, figure, len(table.rows))
                    progress.advance(task)
        report(bench, table.rows, folder, board)
    return table.rows


def report(bench: Bench, rows: Sequence[Row], folder: Path, board: TensorBoard) -> None:
    """Write the report's files and log them to TensorBoard."""
    import numpy as np
    from PIL import Image

    text = markdown_of(bench, rows, bench.summary(rows, folder))
    write_text(folder / "table.md", text)
    board.experiment.add_text("table", text, len(rows))
    for path in sorted(folder.glob("*.png")):
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGB"))
            board.experiment.add_image(path.stem, pixels, len(rows), dataformats="HWC")
    board.save()
    board.finalize("success")


def markdown_of(bench: Bench, rows: Sequence[Row], summary: str) -> str:
    """Tables of the measured rows, then skipped rows and the legend of columns."""
    groups: dict[str, list[Row]] = {}
    left_out: Counter[tuple[str, str]] = Counter()
    for row in rows:
        if (status := row.get("status", "ok")) != "ok":
            left_out[bench.label(row), status] += 1
            continue
        title = ", ".join(f"{name} {figure(row, name, 'g')}" for name in bench.sections)
        groups.setdefault(f"\n## {title or 'Rows'}\n\n", []).append(row)
    text = f"# {bench.title}\n{summary}"
    for title, members in groups.items():
        cells = [[figure(row, *one) for one in bench.shown.items()] for row in members]
        lines = [(bench.label(row), *cell) for row, cell in zip(members, cells, strict=True)]
        text += title + markdown(Cells(("", *bench.shown), lines), 1)
    if left_out:
        lines = [(part, status, str(count)) for (part, status), count in left_out.items()]
        text += f"\n## Left out\n\n{markdown(Cells(('part', 'status', 'cases'), lines))}"
    legend = markdown(Cells(("column", "meaning"), list(bench.columns.items())))
    return f"{text}\n## Columns of results.csv\n\n{legend}"


def machine() -> dict[str, str]:
    """Processor, threads, GPU, and versions of the libraries compared."""
    has_gpu = torch.cuda.is_available()
    return {
        **run_folder.versions(others=PEERS),
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "gpu": torch.cuda.get_device_name() if has_gpu else "none",
    }


def processor() -> str:
    """The processor's model."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or platform.machine())
