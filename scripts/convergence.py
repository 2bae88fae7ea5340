"""Error of classical methods against iterations on the test cases of an experiment, as CSV:
python scripts/convergence.py EXPERIMENT OUT.csv --cases 1

Goes on where an earlier call broke off: methods that OUT.csv holds are left out.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mvrecon.config import compose
from mvrecon.data.module import TEST
from mvrecon.engine.fit import build_data
from mvrecon.engine.module import build_projector
from mvrecon.files.atomic import written_whole
from mvrecon.metrics import nrmse
from mvrecon.parts import RECONSTRUCTORS
from mvrecon.projectors.operator import Projector
from mvrecon.reconstruct.problem import Iterate

#: Iterations at which the error is looked at.
AT = (1, 3, 10, 30, 100, 300, 1000, 2000, 3000, 6000, 10000)


class Run(NamedTuple):
    """A method, its options, and its number of iterations; none for a method without."""

    method: str
    options: dict[str, float] = {}
    iterations: int | None = None

    @property
    def label(self) -> str:
        """Name in the table."""
        return " ".join([self.method, *(f"{key}={value:g}" for key, value in self.options.items())])


RUNS = (
    Run("fbp"),
    Run("sirt", {}, 300),
    Run("cgls", {}, 300),
    Run("fista_tv", {"weight": 1e-5}, 300),
    Run("fista_tv", {"weight": 1e-6}, 1000),
    Run("fista_tv", {"weight": 1e-7}, 3000),
    Run("fista_tv", {"weight": 1e-8}, 10000),
)


def rows(run: Run, A: Projector, views: Tensor, truth: Tensor) -> list[dict[str, Any]]:
    """One row for each number of iterations."""
    table: list[dict[str, Any]] = []
    start = time.perf_counter()

    def look(volume: Tensor, number: int, residual: Tensor) -> None:
        errors = [nrmse(x, t) for x, t in zip(volume, truth, strict=True)]
        table.append(
            {
                "method": run.label,
                "iterations": number,
                "nrmse": sum(errors) / len(errors),
                "nrmse_max": max(errors),
                "view_nrmse": (residual.norm() / views.norm()).item(),
                "seconds": time.perf_counter() - start,
                "cases": len(errors),
            }
        )

    def monitor(iterate: Iterate) -> None:
        if iterate.number in AT:
            look(iterate.volume, iterate.number, iterate.residual)

    method = RECONSTRUCTORS.get(run.method)
    if run.iterations is None:
        volume = method(A, views, **run.options)
        look(volume, 0, views - A(volume))
    else:
        method(A, views, iterations=run.iterations, monitor=monitor, **run.options)
    return [
        {key: f"{v:.4g}" if isinstance(v, float) else v for key, v in row.items()} for row in table
    ]


def main() -> None:
    """Compose the experiment, make its test cases, run every method that the CSV lacks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("experiment", help="name of an experiment of mvrecon-train")
    parser.add_argument("out", type=Path, help="CSV file to write or go on with")
    parser.add_argument("--cases", type=int, default=1, help="how many test cases")
    given = parser.parse_args()
    settings = compose(f"experiment={given.experiment}")
    data = build_data(settings)
    A = build_projector(*(settings[key] for key in ("grid", "camera", "projector")))
    samples = [
        data.scenes["test"].sample(index, TEST, data.grid, data.cameras)
        for index in data.indices("test")[: given.cases]
    ]
    views, truth = (
        torch.stack([getattr(s, name) for s in samples]) for name in ("views", "volume")
    )
    table = list(csv.DictReader(given.out.open(encoding="utf-8"))) if given.out.exists() else []
    for run in RUNS:
        if run.label in {row["method"] for row in table}:
            continue
        table += rows(run, A, views, truth)
        with written_whole(given.out) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, table[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)


if __name__ == "__main__":
    main()
