"""Puts the tables of runs into a CSV file: python scripts/docs/collect.py RUN_FOLDER... OUT.csv

With `--cases` it writes a row for each method and test case.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from mvrecon.core.files.runs import write_rows

FIGURES = ("psnr", "ssim", "nrmse", "psnr_inside", "ssim_inside", "nrmse_inside", "view_nrmse")
#: Columns of `cases`, and their names in results.json.
QUALITY = {
    "auc": "wrong_cameras_auc",
    "coverage_68": "coverage_68",
    "coverage_95": "coverage_95",
}


def rows(results: dict[str, Any]) -> list[dict[str, Any]]:
    """One row a method: means and standard deviations over the test scenes, time, parameters,
    seed, device.
    """
    table = []
    for method, figures in results["methods"].items():
        row: dict[str, Any] = {
            "method": method,
            "parameters": figures["parameters"],
            "seed": results["seed"],
            "device": results["device"],
            "failed": len(figures.get("failed", ())),
        }
        for name in FIGURES:
            row |= {name: figures[name]["mean"], f"{name}_std": figures[name]["std"]}
        row |= {key: figures[key] for key in ("ms_per_volume", "train_steps", "train_seconds")}
        table.append({key: round(v, 5) if isinstance(v, float) else v for key, v in row.items()})
    return table


def cases(results: dict[str, Any]) -> list[dict[str, Any]]:
    """One row a method and test case; `lost` counts the views that alignment has found lost, `auc`
    is how well the weights of cameras rank the faulty ones, `coverage_68` and `_95` are the shares
    of the body's voxels in the intervals of sigma.
    """
    acquisition, table = results["acquisition"], []
    faults = (acquisition["disturbed"] or {}) | {"photons": acquisition["photons"]}
    described = (
        ", ".join(f"{name} {float(value):g}" for name, value in faults.items() if value) or "none"
    )
    for method, figures in results["methods"].items():
        psnr, ssim, inside = (figures[name]["values"] for name in ("psnr", "ssim", "psnr_inside"))
        gains = figures.get("cameras", {}).get("gain", [()] * len(psnr))
        quality = {
            name: figures["quality"].get(key, {}).get("values", [None] * len(psnr))
            for name, key in QUALITY.items()
        }
        table += [
            {
                "method": method,
                "faults": described,
                "seed": results["seed"],
                "steps": figures["train_steps"],
                "seconds": round(figures["train_seconds"]),
                "case": case,
                "lost": sum(gain == 0 for gain in gains[case]),
                "psnr": round(psnr[case], 4),
                "ssim": round(ssim[case], 5),
                "psnr_inside": round(inside[case], 4),
            }
            | {
                name: None if values[case] is None else round(values[case], 4)
                for name, values in quality.items()
            }
            for case in range(len(psnr))
        ]
    return table


def main() -> None:
    """Read results.json of each run folder, write the CSV file whole."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders with results.json")
    parser.add_argument("out", type=Path, help="CSV file to write")
    parser.add_argument("--cases", action="store_true", help="a row for each test case")
    given = parser.parse_args()
    make = cases if given.cases else rows
    found = [json.loads((run / "results.json").read_text(encoding="utf-8")) for run in given.runs]
    write_rows(given.out, [row for results in found for row in make(results)])


if __name__ == "__main__":
    main()
