"""Does a network solve the inverse problem of few views?

`python experiments/09_sparse_view/study.py` makes results.csv and convergence.png; what the CSV
holds is not made again, and a training goes on where it broke off. `--large` adds total variation
at 512^2 pixels from 128 views.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import classical
import figure
import learned

from mvrecon.files.atomic import written_whole
from mvrecon.files.tables import read_rows

HERE = Path(__file__).parent
COLUMNS = (
    "method",
    "size",
    "views",
    "seed",
    "counted",
    "count",
    "nrmse",
    "view_nrmse",
    "nrmse_consistent",
    "seconds",
    "cases",
    "parameters",
)


def write(table: list[dict[str, Any]], out: Path) -> None:
    """The table as CSV, numbers to four digits."""
    with written_whole(out) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in table:
            writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()})


def main() -> None:
    """Every run that the table lacks, then the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "results.csv", help="CSV to go on with")
    parser.add_argument("--outputs", type=Path, default=Path("outputs/sparse_view"))
    parser.add_argument("--large", action="store_true", help="512^2 pixels from 128 views, too")
    options = parser.parse_args()
    out: Path = options.out
    table = read_rows(out)
    known = {(row["method"], row["size"], row["seed"]) for row in table}
    for run in classical.RUNS + (classical.LARGE_RUNS if options.large else ()):
        if (run.label, str(run.scan.size), "") not in known:
            table += classical.rows(run)
            write(table, out)
    size = str(classical.SMALL.size)
    for training in learned.TRAININGS:
        if (training.label, size, str(training.seed)) not in known:
            table += learned.rows(training, options.outputs)
            write(table, out)
    figure.draw(read_rows(out), out.with_name("convergence.png"))


if __name__ == "__main__":
    main()
