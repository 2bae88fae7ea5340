"""The result table on a terminal."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

COLUMNS = {
    "psnr": ("PSNR\ndB", "{:.2f}"),
    "ssim": ("SSIM\n", "{:.3f}"),
    "nrmse": ("NRMSE\n", "{:.3f}"),
    "psnr_inside": ("PSNR\ninside", "{:.2f}"),
    "ssim_inside": ("SSIM\ninside", "{:.3f}"),
    "nrmse_inside": ("NRMSE\ninside", "{:.3f}"),
    "view_nrmse": ("view\nNRMSE", "{:.3f}"),
}


def table(found: Mapping[str, Any]) -> Table:
    """The result table for a terminal: mean over the scenes, and the standard deviation below it."""
    title = f"{found['name']}: {len(found['scenes'])} unseen scenes, mean ± standard deviation over scenes"
    shown = Table(title=title, title_justify="left")
    shown.add_column("method\n")
    shown.add_column("parameters\n", justify="right")
    for heading, _ in COLUMNS.values():
        shown.add_column(heading, justify="right")
    shown.add_column("ms per\nvolume", justify="right")
    shown.add_column("training\ns", justify="right")
    for label, row in found["methods"].items():
        cells = [
            f"{form.format(row[name]['mean'])}\n± {form.format(row[name]['std'])}"
            for name, (_, form) in COLUMNS.items()
        ]
        seconds = f"{row['train_seconds']:.0f}" if row["train_steps"] else "-"
        shown.add_row(label, f"{row['parameters']:,}", *cells, f"{row['ms_per_volume']:.1f}", seconds)
    return shown


def show(found: Mapping[str, Any], folder: Path) -> None:
    """Print the table, at least 120 columns wide where no terminal says otherwise."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(table(found))
    console.print(f"Kept in {folder}", soft_wrap=True)
