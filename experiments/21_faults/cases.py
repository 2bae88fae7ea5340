"""Every test case of finished runs as a row:
python experiments/21_faults/cases.py RUN... --out cases.csv
"""

import argparse
import json
from pathlib import Path

from mvrecon.core.files.runs import write_rows


def main() -> None:
    """Read each run's results.json, write the CSV file whole."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders with results.json")
    parser.add_argument("--out", type=Path, required=True, help="CSV file to write")
    given = parser.parse_args()
    rows = []
    for run in given.runs:
        results = json.loads((run / "results.json").read_text(encoding="utf-8"))
        for method, figures in results["methods"].items():
            gains = figures["cameras"]["gain"]
            for case, gain in enumerate(gains):
                rows.append(
                    {
                        "method": method,
                        "seed": results["seed"],
                        "steps": figures["train_steps"],
                        "case": case,
                        "lost": sum(value == 0 for value in gain),
                        "psnr": round(figures["psnr"]["values"][case], 4),
                        "ssim": round(figures["ssim"]["values"][case], 5),
                    }
                )
    write_rows(given.out, rows)


if __name__ == "__main__":
    main()
