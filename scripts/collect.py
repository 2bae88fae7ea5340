"""Puts the table of a run into a CSV file: python scripts/collect.py RUN_FOLDER OUT.csv"""

import argparse
import json
from pathlib import Path
from typing import Any

from mvrecon.core.files.runs import write_rows

FIGURES = ("psnr", "ssim", "nrmse", "psnr_inside", "ssim_inside", "nrmse_inside", "view_nrmse")


def rows(results: dict[str, Any]) -> list[dict[str, Any]]:
    """One row a method: means and standard deviations over the test scenes, time, parameters,
    seed.
    """
    table = []
    for method, figures in results["methods"].items():
        row: dict[str, Any] = {
            "method": method,
            "parameters": figures["parameters"],
            "seed": results["seed"],
            "failed": len(figures.get("failed", ())),
        }
        for name in FIGURES:
            row |= {name: figures[name]["mean"], f"{name}_std": figures[name]["std"]}
        row |= {key: figures[key] for key in ("ms_per_volume", "train_steps", "train_seconds")}
        table.append({key: round(v, 5) if isinstance(v, float) else v for key, v in row.items()})
    return table


def main() -> None:
    """Read results.json of a run folder, write the CSV file whole."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run folder with results.json")
    parser.add_argument("out", type=Path, help="CSV file to write")
    given = parser.parse_args()
    table = rows(json.loads((given.run / "results.json").read_text(encoding="utf-8")))
    write_rows(given.out, table)


if __name__ == "__main__":
    main()
